"""Fixtures of the service's tests: the real system and tracker, a tiny strict identifier, a store in a folder."""

from __future__ import annotations

import os

# Before NumPy and torch are there: tests share the cores as processes (`-n auto`), and the operations here are too
# small to split: threads of a linear algebra library would only wait for each other.
for _library in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_library, "1")

import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from sprung.model.system import MANCHESTER_DBC, System, load_system
from sprung.model.tracking.tracker import Tracker
from sprung.service.fleet import local_postgres as postgres_tests
from sprung.service.monitoring.compute import Compute
from sprung.service.monitoring.engine import Engine, make_tracker
from sprung.service.monitoring.pipeline import Pipeline
from sprung.service.store import Store, open_store
from tests.service_fakes import FakeIdentifier

# a process for every file that a test reads would cost a second each; tests/service/processes/test_apart.py has them
os.environ.setdefault("SPRUNG_ISOLATE_READING", "false")


@pytest.fixture(scope="session")
def system() -> System:
    return load_system()


@pytest.fixture
def identifier(system: System) -> FakeIdentifier:
    return FakeIdentifier(system)


@pytest.fixture(scope="session")
def tracker(system: System) -> Tracker:
    return make_tracker(system)


@pytest.fixture
def engine(system: System, identifier: FakeIdentifier, tracker: Tracker) -> Engine:
    return Engine(system, identifier, tracker, MANCHESTER_DBC)


@pytest.fixture(scope="session")
def empty_store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A store's file with nothing in it but the newest schema: a copy is made in a fifth of the time."""
    path = tmp_path_factory.mktemp("store") / "empty.db"
    open_store(f"sqlite:///{path}").close()
    return path


@pytest.fixture
def data_dir(tmp_path: Path, empty_store: Path) -> Path:
    """A service's folder whose store is there already."""
    shutil.copy(empty_store, tmp_path / "sprung.db")
    return tmp_path


@pytest.fixture
def store(tmp_path: Path, empty_store: Path) -> Iterator[Store]:
    opened = open_store(f"sqlite:///{shutil.copy(empty_store, tmp_path / 'test.db')}")
    yield opened
    opened.close()


@pytest.fixture(scope="session")
def postgres() -> Iterator[postgres_tests.PostgresServer]:
    """A PostgreSQL server of this run's own."""
    if reason := postgres_tests.missing():
        pytest.skip(reason)
    with postgres_tests.server() as running:
        yield running


@pytest.fixture(scope="session")
def postgres_template(postgres: postgres_tests.PostgresServer) -> str:
    """Name of a database with nothing in it but the newest schema."""
    url = postgres.database()
    open_store(url).close()
    return url.rpartition("/")[2]


@pytest.fixture(params=["sqlite", "postgresql"])
def any_store(request: pytest.FixtureRequest, tmp_path: Path, empty_store: Path) -> Iterator[Store]:
    """The store, once on every database."""
    if request.param == "sqlite":
        url = f"sqlite:///{shutil.copy(empty_store, tmp_path / 'test.db')}"
    else:
        url = request.getfixturevalue("postgres").database(request.getfixturevalue("postgres_template"))
    opened = open_store(url)
    yield opened
    opened.close()


@pytest.fixture
def compute() -> Iterator[Compute]:
    running = Compute(queue_size=4)
    yield running
    running.close()


@pytest.fixture
def pipeline(engine: Engine, store: Store, compute: Compute) -> Pipeline:
    return Pipeline(engine, store, compute)

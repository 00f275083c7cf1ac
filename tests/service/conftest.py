"""A service that is asked in this process: the modules say what is particular to theirs."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from fastapi.testclient import TestClient

from sprung.model.system import System
from sprung.service.app import create_app
from sprung.service.core import Core, build_core
from sprung.service.monitoring.engine import Engine
from sprung.service.settings import Settings
from tests.served import worsen


@pytest.fixture
def core(engine: Engine, data_dir: Path) -> Core:
    return build_core(Settings(data_dir=data_dir), engine)


@pytest.fixture
def client(core: Core) -> Iterator[TestClient]:
    with TestClient(create_app(core), raise_server_exceptions=False) as running:
        yield running


@pytest.fixture
def broken(client: TestClient, core: Core, system: System) -> str:
    """A vehicle whose parameters have all grown by a third."""
    return worsen(core, system)


@pytest.fixture
def reading_here(monkeypatch: pytest.MonkeyPatch) -> None:
    """Uploads are read in this process: one of their own costs each test seconds; test_apart.py has them."""
    monkeypatch.setattr("sprung.service.jobs.recordings.reading_limits", lambda settings, path: None)

"""Back-up and restoration of a PostgreSQL store by its own programs, as docs/fleet.md says."""

from __future__ import annotations

import subprocess
from pathlib import Path

import numpy as np

from sprung.model.system import System
from sprung.service.cli import main
from sprung.service.fleet import local_postgres
from sprung.service.monitoring.compute import Compute
from sprung.service.monitoring.engine import Engine
from sprung.service.monitoring.pipeline import Pipeline
from sprung.service.store import Store, history, open_store
from tests.service_fakes import make_window

VEHICLE = "car-17"


def follow(engine: Engine, store: Store, system: System, first: int, count: int, compute: Compute) -> None:
    Pipeline(engine, store, compute).process(VEHICLE, [make_window(system, first + i) for i in range(count)])


def told(store: Store) -> history.Series:
    with store.read() as connection:
        return history.series(connection, VEHICLE, 1, 0, 2**62, 0, 1000)


def test_what_pg_dump_wrote_goes_on_where_it_was(
    postgres: local_postgres.PostgresServer, engine: Engine, system: System, compute: Compute, tmp_path: Path
) -> None:
    """Dumped while the store is open; the restored one has the same history and folds the next windows the same way."""
    place = local_postgres.binaries()
    assert place is not None
    lived, empty = postgres.database(), postgres.database()
    before = open_store(lived)
    follow(engine, before, system, 0, 30, compute)
    target = tmp_path / "b.dump"
    plain = {url: url.replace("+psycopg", "") for url in (lived, empty)}
    subprocess.run([str(place / "pg_dump"), "-Fc", "-f", str(target), plain[lived]], check=True)
    subprocess.run([str(place / "pg_restore"), "-d", plain[empty], str(target)], check=True)
    assert main(["fleet", "migrate", "--store", empty]) == 0
    after = open_store(empty)
    for store in (before, after):
        follow(engine, store, system, 30, 10, compute)
    one, other = told(before), told(after)
    assert len(one.time) == 40
    np.testing.assert_array_equal(one.time, other.time)
    np.testing.assert_array_equal(one.mean, other.mean)
    np.testing.assert_array_equal(one.std, other.std)
    before.close()
    after.close()

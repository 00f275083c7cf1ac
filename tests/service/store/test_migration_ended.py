"""A service that is told to end while it migrates its store: nothing is half done, and the next start completes it."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest
from sqlalchemy import Engine, event

from sprung.benchmarks.trust_kills import KilledStep, fresh, started
from sprung.benchmarks.trust_steps import STEPS
from sprung.benchmarks.trust_zygote import DONE, Zygote
from sprung.service.store import open_store

SERVE = """
import os, signal, time
from sqlalchemy import Engine, event
from sprung.service.cli import main
count = 0
def told(*_):
    global count
    count += 1
    if count == {statement}:
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep({patience})  # a handler, if there is one, gets its turn
event.listen(Engine, "before_cursor_execute", told)
go()
main(["serve", "--port", "0", "--data-dir", "."])
"""


@pytest.fixture
def migration(tmp_path: Path) -> KilledStep:
    """A store of the first version, with vehicles, that the newest one opens."""
    return STEPS["migration"](tmp_path)


@pytest.fixture
def zygote() -> Iterator[Zygote]:
    found = Zygote()
    yield found
    found.close()


def statements(path: Path) -> int:
    """How many a migration of the store consists of; it is migrated then."""
    count = 0

    def counted(*_: object) -> None:
        nonlocal count
        count += 1

    event.listen(Engine, "before_cursor_execute", counted)
    try:
        open_store(f"sqlite:///{path}").close()
    finally:
        event.remove(Engine, "before_cursor_execute", counted)
    return count


def version(path: Path) -> str:
    with closing(sqlite3.connect(path)) as store:
        return str(store.execute("SELECT version_num FROM alembic_version").fetchone()[0])


@pytest.mark.parametrize("moments", [4, pytest.param(8, marks=pytest.mark.slow)])
def test_sigterm_within_a_migration_leaves_the_store_whole_and_the_next_start_completes_it(
    tmp_path: Path, migration: KilledStep, zygote: Zygote, moments: int
) -> None:
    count = statements(fresh(tmp_path / "alone", migration.prepare) / "sprung.db")
    newest = version(tmp_path / "alone" / "sprung.db")
    assert count > moments
    for statement in [1 + n * (count - 1) // (moments - 1) for n in range(moments)]:
        place = fresh(tmp_path / f"ended-{statement}", migration.prepare)
        code = SERVE.format(statement=statement, patience=5)
        process = started(KilledStep(code, migration.prepare, migration.judge), place, zygote)
        assert process.wait(60), f"still there after SIGTERM at statement {statement}"
        assert not (place / DONE).exists()
        assert not any(migration.judge(place, False).values()), f"SIGTERM at statement {statement}"
        assert version(place / "sprung.db") == "0001"
        open_store(f"sqlite:///{place}/sprung.db").close()
        assert version(place / "sprung.db") == newest
        assert not any(migration.judge(place, True).values())

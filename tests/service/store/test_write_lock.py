"""Whose turn it is to write, and what becomes of those who wait behind a transaction that does not end."""

from __future__ import annotations

import sqlite3
import threading
import time
from contextlib import ExitStack, closing
from pathlib import Path

import pytest
from sqlalchemy.exc import SQLAlchemyError

from sprung.service.core import build_core
from sprung.service.monitoring.engine import Engine
from sprung.service.settings import Settings
from sprung.service.store import open_store
from sprung.service.store import write_lock as module
from sprung.service.store.write_lock import WriteLock
from tests.service_fakes import eventually


def test_behind_a_transaction_that_does_not_end_only_few_wait(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each holds one of the threads that answer requests."""
    monkeypatch.setattr(module, "LOOK_SECONDS", 0.01)
    monkeypatch.setattr(module, "STUCK_SECONDS", 0.05)
    lock, refused, wrote = WriteLock(1), threading.Semaphore(0), threading.Semaphore(0)

    def write() -> None:
        try:
            with lock.held():
                wrote.release()
        except SQLAlchemyError:
            refused.release()

    threads = [threading.Thread(target=write) for _ in range(20)]
    with lock.held():
        for thread in threads:
            thread.start()
        for _ in range(20 - module.MOST_BEHIND):
            assert refused.acquire(timeout=10)
        eventually(lambda: sum(thread.is_alive() for thread in threads) == module.MOST_BEHIND)
        with pytest.raises(SQLAlchemyError, match="have not ended"), lock.held():
            pass
    for thread in threads:
        thread.join(10)
    assert [wrote.acquire(blocking=False) for _ in range(module.MOST_BEHIND + 1)] == [True] * module.MOST_BEHIND + [
        False
    ]


def test_a_turn_that_does_not_come_in_time_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "LOOK_SECONDS", 0.01)
    lock = WriteLock(2)
    with ExitStack() as held:
        held.enter_context(lock.held())
        held.enter_context(lock.held())
        with pytest.raises(SQLAlchemyError), lock.held(0.02):
            pass
    with lock.held(0.0), pytest.raises(ZeroDivisionError), lock.held(0.0):
        raise ZeroDivisionError
    with lock.held(0.0):
        pass


def test_a_process_that_ends_does_not_wait_for_a_store_that_another_one_holds(tmp_path: Path) -> None:
    """Each of those who still write would wait for the other's lock in turn."""
    path = tmp_path / "sprung.db"
    store = open_store(f"sqlite:///{path}")
    with closing(sqlite3.connect(path, isolation_level=None)) as other, closing(store):
        other.execute("BEGIN IMMEDIATE")
        begun = time.monotonic()
        store.leave_within(0.5)
        store.leave_within(60.0)  # said twice, it is not put off
        for _ in range(4):
            with pytest.raises(SQLAlchemyError, match="locked"), store.write():
                pass
        assert time.monotonic() - begun < 5.0
        other.execute("ROLLBACK")
        with store.write():
            pass


def test_the_service_says_so_to_its_store_when_it_is_told_to_end(engine: Engine, data_dir: Path) -> None:
    core = build_core(Settings(data_dir=data_dir, shutdown_seconds=1), engine)
    core.stop()
    assert core.stopping.is_set() and core.store._patience(60.0) <= 0.75
    core.store.close()

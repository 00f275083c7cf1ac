"""What the machine lacks is told as what it is: 507 and 503, not 500; not ready with the reason, alive, back again."""

from __future__ import annotations

import errno
import sqlite3
import threading
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest
from fastapi.testclient import TestClient
from sqlalchemy.exc import OperationalError

from sprung.service.app import create_app
from sprung.service.core import Core, build_core
from sprung.service.monitoring.engine import Engine
from sprung.service.processes.forked import ProcessStatus
from sprung.service.settings import Settings


@pytest.fixture
def core(engine: Engine, data_dir: Path, monkeypatch: pytest.MonkeyPatch) -> Core:
    monkeypatch.setattr("sprung.service.condition.FRESH_SECONDS", 0.0)
    monkeypatch.setattr("sprung.service.store.engine.PROBE_SECONDS", 0.2)
    return build_core(Settings(data_dir=data_dir, min_free_bytes=0), engine)


def test_a_store_that_another_process_locks_is_not_ready_and_comes_back(client: TestClient, tmp_path: Path) -> None:
    assert client.get("/health/ready").status_code == 200
    other = sqlite3.connect(tmp_path / "sprung.db", isolation_level=None)
    other.execute("BEGIN IMMEDIATE")
    answer = client.get("/health/ready")
    assert answer.status_code == 503 and "database is locked" in answer.json()["detail"]
    assert client.get("/health/live").status_code == 200
    other.execute("ROLLBACK")
    other.close()
    assert client.get("/health/ready").status_code == 200


def test_a_disk_that_fills_is_not_ready(client: TestClient, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sprung.service.condition.free_bytes", lambda folder: -1)
    answer = client.get("/health/ready")
    assert answer.status_code == 503 and "MB are free" in answer.json()["detail"]


def test_a_process_that_is_replaced_is_shown_and_the_service_is_ready(engine: Engine, data_dir: Path) -> None:
    """The service does its work meanwhile."""
    lost = Mock(status=ProcessStatus("tracks vehicles", works=False, restarts=2))
    core = build_core(Settings(data_dir=data_dir, min_free_bytes=0), engine, processes=[lost])
    with TestClient(create_app(core)) as client:
        answer = client.get("/health/ready")
        assert answer.status_code == 200
        assert answer.json()["processes"] == [{"name": "tracks vehicles", "works": False, "restarts": 2}]
        metrics = client.get("/metrics").text
    assert 'sprung_process_up{process="tracks vehicles"} 0.0' in metrics
    assert 'sprung_process_restarts_total{process="tracks vehicles"} 2.0' in metrics


@pytest.mark.parametrize(
    ("error", "status"),
    [
        (OSError(errno.ENOSPC, "No space left on device"), 507),
        (OSError(errno.EDQUOT, "Disk quota exceeded"), 507),
        (OSError(errno.EFBIG, "File too large"), 507),
        (OSError(errno.EMFILE, "Too many open files"), 503),
        (OSError(errno.EROFS, "Read-only file system"), 503),
        (OperationalError("INSERT", {}, sqlite3.OperationalError("database or disk is full")), 507),
        (OperationalError("INSERT", {}, sqlite3.OperationalError("database is locked")), 503),
        (OperationalError("INSERT", {}, sqlite3.OperationalError("attempt to write a readonly database")), 503),
        (MemoryError(), 503),
        (RuntimeError("can't start new thread"), 503),
        (RuntimeError("a mistake of ours"), 500),
    ],
)
def test_what_is_lacking_is_reported_as_what_it_is(
    client: TestClient,
    core: Core,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    error: Exception,
    status: int,
) -> None:
    reading = core.store.read

    def broken(*_: Any, **__: Any) -> Any:
        if threading.current_thread().name.startswith("sprung-"):  # housekeeping and jobs go on as they were
            return reading()
        raise error

    monkeypatch.setattr(core.store, "read", broken)
    answer = client.get("/vehicles")
    assert answer.status_code == status
    assert answer.headers["content-type"] == "application/problem+json"
    assert "retry-after" in answer.headers or status == 500
    said = [record.getMessage() for record in caplog.records if record.name == "sprung.api"]
    assert said and not any("sqlalche.me" in line or line.endswith(": ") for line in said)
    assert client.get("/health/live").status_code == 200

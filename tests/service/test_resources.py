"""What the machine lacks is told as what it is: 507 and 503, not 500; not ready with the reason, alive, back again."""

from __future__ import annotations

import errno
import shutil
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
from sprung.service.store import fleet


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


@pytest.mark.parametrize("how", ["folder moved", "file deleted", "another file"])
def test_a_store_that_is_no_longer_in_its_place_is_not_ready_and_acknowledges_nothing(
    engine: Engine, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, how: str
) -> None:
    """SQLite goes on with the file that it has opened; what is written there would be gone with the process."""
    monkeypatch.setattr("sprung.service.condition.FRESH_SECONDS", 0.0)
    place, away = tmp_path / "stores", tmp_path / "away"
    url = f"sqlite:///{place}/sprung.db"
    core = build_core(Settings(data_dir=tmp_path / "data", store=url, min_free_bytes=0), engine)
    note = {"text": "a note", "time": "2026-09-21T14:13:20Z"}
    with core.store.write() as connection:
        fleet.ensure_vehicle(connection, "a", 1)
    with TestClient(create_app(core), raise_server_exceptions=False) as client:
        assert client.post("/vehicles/a/notes", json=note).status_code == 201
        if how == "folder moved":
            place.rename(away)
        elif how == "file deleted":
            (place / "sprung.db").unlink()
        else:
            shutil.copy(place / "sprung.db", place / "copy.db")
            (place / "copy.db").replace(place / "sprung.db")
        refused = client.post("/vehicles/a/notes", json=note)
        assert refused.status_code == 503 and "Retry-After" in refused.headers
        ready = client.get("/health/ready")
        assert ready.status_code == 503 and "sprung.db is gone, or another file is in" in ready.json()["detail"]
        assert client.get("/health/live").status_code == 200
        core.store.close()  # of connections that are opened now none begins another store
        assert client.get("/vehicles").status_code == 503
        if how == "folder moved":
            assert not place.exists()
            away.rename(place)
            assert client.get("/health/ready").status_code == 200
            assert client.post("/vehicles/a/notes", json=note).status_code == 201


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

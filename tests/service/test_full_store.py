"""A store on a disk of its own that is full, for real: told by readiness and at the start; and other shortages."""

from __future__ import annotations

import errno
import logging
import subprocess
from asyncio import CancelledError
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest
from fastapi.testclient import TestClient

from sprung.model.system import System
from sprung.service.api import problems
from sprung.service.app import create_app
from sprung.service.core import build_core
from sprung.service.errors import UserError
from sprung.service.monitoring.engine import Engine
from sprung.service.observability.logs import foreseen
from sprung.service.settings import Settings
from sprung.service.store import open_store
from tests.service.pages.test_pages import BROWSER
from tests.service_fakes import make_window


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 8 MB."""
    folder = tmp_path / "small"
    folder.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", "size=8m", "tmpfs", str(folder)]
    try:
        mounted = subprocess.run(command, capture_output=True, text=True, check=False)
    except FileNotFoundError:
        pytest.skip("no file system can be mounted here")
    if mounted.returncode:
        pytest.skip(f"no file system can be mounted here: {mounted.stderr.strip()}")
    try:
        yield folder
    finally:
        subprocess.run(["umount", "--lazy", str(folder)], check=True)


def filled(folder: Path) -> Path:
    """A file that takes all that is left."""
    path = folder / "filler"
    with suppress(OSError), path.open("wb", buffering=0) as file:
        while file.write(b"x" * 4096):
            pass
    return path


def test_a_store_on_a_full_disk_of_its_own_is_not_ready_and_comes_back(
    engine: Engine, system: System, data_dir: Path, small_disk: Path
) -> None:
    settings = Settings(data_dir=data_dir, store=f"sqlite:///{small_disk}/s.db", min_free_bytes=0)
    core = build_core(settings, engine)
    with TestClient(create_app(core), raise_server_exceptions=False) as client:
        core.pipeline.process("a", [make_window(system, 0)])
        assert client.get("/health/ready").status_code == 200
        filler = filled(small_disk)
        core.condition._asked = -1e9  # not the answer of a second ago
        ready = client.get("/health/ready")
        assert ready.status_code == 503 and f"{small_disk}: 0 MB are free" in ready.json()["detail"]
        assert client.post("/vehicles/a/notes", json={"text": "x" * 2000}).status_code in (201, 507)
        assert client.get("/vehicles").status_code == 200 and client.get("/health/live").status_code == 200
        filler.unlink()
        core.condition._asked = -1e9
        assert client.get("/health/ready").status_code == 200


def test_a_start_on_a_full_disk_says_that_it_is_full(small_disk: Path) -> None:
    open_store(f"{small_disk}/s.db").close()
    filled(small_disk)
    with pytest.raises(UserError, match=r"cannot be opened \(.*; 0\.0 MB are free on its disk\)"):
        open_store(f"{small_disk}/s.db")


def test_a_page_that_cannot_be_read_for_want_of_files_is_an_error_for_programs(
    client: TestClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It was 500, without a word."""

    def short(*given: object, **more: object) -> str:
        raise OSError(errno.EMFILE, "Too many open files")

    monkeypatch.setattr(problems, "render", short)
    answer = client.get("/pages/vehicles/nobody", headers=BROWSER)
    assert answer.status_code == 404 and answer.json()["detail"] == "nothing is known of vehicle 'nobody'"


def test_shortages_and_requests_given_up_at_the_end_are_no_tracebacks_in_the_log() -> None:
    error = OSError(errno.EMFILE, "Too many open files")
    record = logging.LogRecord("asyncio", logging.ERROR, "", 0, "socket.accept() ...", None, (OSError, error, None))
    assert foreseen(record) and record.exc_info is None
    assert record.getMessage() == "no connection is accepted: Too many open files"
    record = logging.LogRecord("asyncio", logging.ERROR, "", 0, "Fatal read", None, (MemoryError, MemoryError(), None))
    assert foreseen(record) and record.exc_info is None and "no memory" in record.getMessage()
    given_up = (CancelledError, CancelledError(), None)
    assert not foreseen(logging.LogRecord("uvicorn.error", logging.ERROR, "", 0, "Exception", None, given_up))
    wrong = (ValueError, ValueError("x"), None)
    assert foreseen(logging.LogRecord("sprung", logging.ERROR, "", 0, "Exception", None, wrong))

"""Data that cannot be written: a folder without permission, and a file system that the kernel makes read-only under a
running service (as after a fault of the disk)."""

from __future__ import annotations

import ctypes
import json
import os
import shutil
import signal
import sqlite3
import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import pytest

from sprung.benchmarks.trust_clients import ask
from sprung.benchmarks.trust_ride import SYSTEM_FILE, RestlessRide
from tests.service_fakes import eventually

PR_CAPBSET_DROP, CAP_DAC_OVERRIDE = 24, 1
JSON = {"content-type": "application/json"}
DISK_MB = 64


def as_anybody() -> None:
    """Before a program starts: permissions count for it, also where it runs as root."""
    if os.geteuid() == 0:
        ctypes.CDLL(None).prctl(PR_CAPBSET_DROP, CAP_DAC_OVERRIDE)


def sprung(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "sprung", *arguments],
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
        preexec_fn=as_anybody,
    )


@pytest.fixture
def read_only(data_dir: Path) -> Iterator[Path]:
    """A data folder with a store, which nobody may write."""
    paths = [*data_dir.rglob("*"), data_dir]
    for path in paths:
        path.chmod(0o555 if path.is_dir() else 0o444)
    yield data_dir
    for path in reversed(paths):
        path.chmod(0o755)


@pytest.mark.parametrize(
    "arguments",
    [
        ("serve", "--port", "0", "--data-dir", "."),
        ("retention", "--store", "sprung.db"),
        ("token", "create", "feeder", "--store", "sprung.db"),
    ],
)
def test_a_folder_that_nobody_may_write_is_told_in_one_line(
    read_only: Path, arguments: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    before = {path: path.stat().st_mtime_ns for path in read_only.rglob("*")}
    monkeypatch.chdir(read_only)
    monkeypatch.setenv("SPRUNG_DATA_DIR", str(read_only))
    done = sprung(*arguments)
    assert (done.returncode, done.stdout) == (2, "")
    (line,) = done.stderr.splitlines()
    assert any(word in line for word in ("Permission denied", "readonly", "unable to open")), line
    assert {path: path.stat().st_mtime_ns for path in read_only.rglob("*")} == before


def fault_of(device: str) -> Path:
    """What makes the kernel take a file system for faulty."""
    return Path(f"/sys/fs/ext4/{device}/trigger_fs_error")


@contextmanager
def faulty_disk(folder: Path) -> Iterator[Path]:
    """An ext4 file system of its own, mounted on a folder, that becomes read-only with an error; its fault.

    Skips the test where there can be none.
    """
    if os.geteuid() != 0 or shutil.which("mkfs.ext4") is None:
        pytest.skip("an ext4 file system of its own needs root and mkfs.ext4")
    image = folder.with_suffix(".img")
    image.write_bytes(b"")
    os.truncate(image, DISK_MB * 1_000_000)
    subprocess.run(["mkfs.ext4", "-q", "-e", "remount-ro", str(image)], check=True)
    folder.mkdir()
    command = ["mount", "-o", "loop", str(image), str(folder)]
    mounted = subprocess.run(command, capture_output=True, text=True, check=False)
    if mounted.returncode:
        pytest.skip(f"no file system can be mounted here: {mounted.stderr.strip()}")
    try:
        source = subprocess.run(["findmnt", "-no", "SOURCE", str(folder)], capture_output=True, text=True, check=True)
        fault = fault_of(Path(source.stdout.strip()).name)
        if not fault.exists():
            pytest.skip("the kernel makes no faults of ext4")
        yield fault
    finally:
        subprocess.run(["umount", "--lazy", str(folder)], check=True)


@pytest.mark.slow
def test_a_disk_that_becomes_read_only_under_a_running_service(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What is read is answered, what would be stored is 503; not ready with the reason, alive, and it ends as told."""
    monkeypatch.setenv("SPRUNG_MIN_FREE_BYTES", "0")
    disk, ride = tmp_path / "disk", RestlessRide()
    windows = [ride.window(number, "windows") for number in range(4)]
    with faulty_disk(disk) as fault:
        command = ["serve", "--port", "0", "--data-dir", str(disk / "data"), "--system", str(SYSTEM_FILE)]
        with subprocess.Popen(
            [sys.executable, "-m", "sprung", *command], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
        ) as process:
            assert process.stdout is not None
            port = int(process.stdout.readline().split(" on ")[1].split()[0].rpartition(":")[2])

            def asked(method: str, path: str, body: object = None) -> tuple[int, dict[str, Any]]:
                return ask(port, method, path, b"" if body is None else json.dumps(body).encode(), JSON, 60.0)

            def told(method: str, path: str, body: object = None) -> int:
                return asked(method, path, body)[0]

            try:
                eventually(lambda: told("GET", "/health/ready") == 200)
                assert [told("POST", "/identify?track=true", one) for one in windows[:3]] == [200] * 3
                fault.write_text("1")
                eventually(lambda: told("GET", "/health/ready") == 503)
                assert "ead-only" in asked("GET", "/health/ready")[1]["detail"]
                assert told("POST", "/identify?track=true", windows[3]) == 503
                assert told("POST", "/vehicles/windows/notes", {"text": "seen"}) == 503
                for path in ("/vehicles", "/vehicles/windows", "/health/live"):
                    assert told("GET", path) == 200
                assert told("POST", "/identify", windows[3]) == 200
            finally:
                process.send_signal(signal.SIGTERM)
                process.communicate(timeout=60)
            assert process.returncode == 0
        shutil.copytree(disk / "data", tmp_path / "kept")
    with closing(sqlite3.connect(tmp_path / "kept" / "sprung.db")) as store:
        assert store.execute("PRAGMA integrity_check").fetchone() == ("ok",)
        assert store.execute("SELECT count(*) FROM windows").fetchone() == (3,)

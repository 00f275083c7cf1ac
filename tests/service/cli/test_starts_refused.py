"""`sprung serve` on what is no data folder of this version, and told to end while it starts: one line, no change."""

from __future__ import annotations

import os
import signal
import sqlite3
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import pytest

from sprung.service.cli import main
from sprung.service.lock import held
from sprung.service.store import open_store

MOMENTS = (0.1, 0.4, 0.8, 1.4, 2.0, 2.6, 3.5)  # s after a first start began


def random_bytes(folder: Path) -> None:
    (folder / "sprung.db").write_bytes(os.urandom(20_000))


def of_another_program(folder: Path) -> None:
    with closing(sqlite3.connect(folder / "sprung.db")) as store:
        store.execute("CREATE TABLE cars (plate TEXT)")
        store.execute("INSERT INTO cars VALUES ('a')")
        store.commit()


def with_a_table_of_the_same_name(folder: Path) -> None:
    with closing(sqlite3.connect(folder / "sprung.db")) as store:
        store.execute("CREATE TABLE vehicles (plate TEXT)")


def cut_off(folder: Path) -> None:
    path = folder / "sprung.db"
    open_store(f"sqlite:///{path}").close()
    os.truncate(path, path.stat().st_size // 2)


def a_folder(folder: Path) -> None:
    (folder / "sprung.db").mkdir()


def content(store: Path) -> object:
    """What is in it: opening a database may change how its journal is kept, and nothing else."""
    if not store.is_file():
        return None
    with closing(sqlite3.connect(store)) as opened:
        try:
            return list(opened.iterdump())
        except sqlite3.DatabaseError:
            return store.read_bytes()


@pytest.mark.parametrize("wrong", [random_bytes, of_another_program, with_a_table_of_the_same_name, cut_off, a_folder])
def test_a_store_that_is_none_of_ours_is_refused_in_one_line_and_left_as_it_is(
    wrong: Callable[[Path], None], tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sprung.service.cli.serve.set_up", lambda form, level: None)  # logs are this process's
    wrong(tmp_path)
    store = tmp_path / "sprung.db"
    before = content(store)
    assert main(["serve", "--port", "0", "--data-dir", str(tmp_path)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "sprung.db" in line
    assert content(store) == before


def test_a_data_folder_that_is_a_file_or_anothers_is_refused_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sprung.service.cli.serve.set_up", lambda form, level: None)
    (tmp_path / "file").write_text("no folder")
    with held(tmp_path / "taken"):
        for name in ("file", "taken"):
            assert main(["serve", "--port", "0", "--data-dir", str(tmp_path / name)]) == 2
            (line,) = capsys.readouterr().err.splitlines()
            assert str(tmp_path / name) in line


@pytest.mark.slow
@pytest.mark.parametrize("seconds", MOMENTS)
def test_sigterm_while_it_starts_for_the_first_time_ends_it_at_once(tmp_path: Path, seconds: float) -> None:
    command = [sys.executable, "-m", "sprung", "serve", "--port", "0", "--data-dir", str(tmp_path)]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True) as process:
        time.sleep(seconds)
        process.send_signal(signal.SIGTERM)
        _, errors = process.communicate(timeout=30)
    assert process.returncode in (0, -signal.SIGTERM)
    assert "Traceback" not in errors
    open_store(f"sqlite:///{tmp_path}/sprung.db").close()

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


@pytest.mark.parametrize(
    "command",
    [["retention", "--dry-run"], ["retention"], ["token", "list"], ["token", "rotate", "x"], ["token", "revoke", "x"]],
)
def test_a_store_that_is_not_there_is_not_begun_by_what_only_looks_or_deletes(
    command: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for way in (["--data-dir", str(tmp_path / "typo")], ["--store", f"sqlite:///{tmp_path / 'typo' / 'x.db'}"]):
        assert main([*command, *way]) == 2
        assert capsys.readouterr().err.endswith("there is none; give the --data-dir or --store of the service\n")
    assert not (tmp_path / "typo").exists()


def test_retention_and_tokens_take_the_folder_that_the_service_takes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["token", "create", "x", "--data-dir", str(tmp_path)]) == 0
    assert main(["token", "list", "--json", "--data-dir", str(tmp_path)]) == 0
    assert '"name": "x"' in capsys.readouterr().out
    assert main(["retention", "--dry-run", "--data-dir", str(tmp_path)]) == 0
    assert "would be forgotten" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("setting", "value"),
    [
        ("RETENTION_WINDOWS_DAYS", "inf"),
        ("RETENTION_MINUTES_DAYS", "1e18"),
        ("RETENTION_UPLOADS_DAYS", "200000"),
        ("BODY_IDLE_SECONDS", "inf"),
        ("HEADER_SECONDS", "nan"),
    ],
)
def test_settings_beyond_what_a_clock_can_show_are_refused_by_name(
    setting: str,
    value: str,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setenv(f"SPRUNG_{setting}", value)
    assert main(["token", "create", "x", "--data-dir", str(tmp_path)]) == 2
    assert f"SPRUNG_{setting}" in capsys.readouterr().err


def test_a_service_with_a_can_database_that_is_none_does_not_start(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "bus.dbc").write_bytes(bytes(100) + b"\xff")
    assert main(["serve", "--data-dir", str(tmp_path), "--port", "0", "--dbc", str(tmp_path / "bus.dbc")]) == 2
    assert "bus.dbc: not a CAN database that can be read" in capsys.readouterr().err


@pytest.mark.parametrize("command", [["replay", "x.csv"], ["serve"], ["edge", "x.csv"]])
def test_a_speed_without_end_is_refused(command: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*command, "--speed", "inf"]) == 2
    assert capsys.readouterr().err == "sprung: --speed: give 0 for as fast as possible\n"


def test_a_back_up_through_a_pipe_is_refused_rather_than_waited_for(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    os.mkfifo(tmp_path / "b.tar")
    assert main(["restore", str(tmp_path / "b.tar"), "--data-dir", str(tmp_path / "d")]) == 2
    assert "b.tar: is no file" in capsys.readouterr().err


def test_a_system_file_without_end_is_refused_unread(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for path in (Path("/dev/zero"), tmp_path / "large.yaml"):
        (tmp_path / "large.yaml").write_bytes(b"# long\n" * 300_000)
        assert main(["system", str(path)]) == 2
        assert "is no system file: it has more than 2 MB" in capsys.readouterr().err

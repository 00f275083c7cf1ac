"""Commands read files in a process of their own: one that does harm is one line, not the end of the command."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest

from sprung.model.system import MANCHESTER, System
from sprung.replay import UnreadableRecording
from sprung.service.cli import apart, main
from sprung.service.errors import UserError
from sprung.service.processes import worker
from sprung.service.settings import Settings
from sprung.service.sources import reading
from sprung.service.sources.loading import RecordRequest


@pytest.fixture(autouse=True)
def isolated(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SPRUNG_ISOLATE_READING", "true")


def request(path: Path, system: System) -> RecordRequest:
    return RecordRequest(path, system.channels, system.sample_rate, None, system.time, 0)


@pytest.mark.skipif(sys.platform != "linux", reason="the bound is one of Linux")
def test_a_file_that_needs_too_much_memory_is_refused(
    tmp_path: Path, system: System, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SPRUNG_WORKER_MEMORY_BYTES", "120000000")
    path = tmp_path / "long.csv"
    path.write_bytes(b"time,a\n0," + b"9" * 200_000_000 + b"\n")
    with pytest.raises((UserError, UnreadableRecording)):
        apart.load(request(path, system))


def test_reading_apart_gives_what_reading_here_gives(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "a.csv"
    path.write_text("time,acc\n" + "".join(f"{i / 100},{i % 7}\n" for i in range(500)))
    told = []
    for isolated in ("true", "false"):
        monkeypatch.setenv("SPRUNG_ISOLATE_READING", isolated)
        assert main(["inspect", str(path), "--json"]) == 0
        told.append(capsys.readouterr().out)
    assert told[0] == told[1] and '"acc"' in told[0]


def test_processor_time_goes_with_the_size_and_nobody_stands_back(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.touch()
    os.truncate(path, 10_000_000)
    limits = apart.own_limits(Settings(data_dir=tmp_path, worker_memory_bytes=7), path)
    assert limits is not None and limits.cpu_seconds == 160 and limits.niceness == 0 and limits.memory_bytes == 7
    assert apart.own_limits(Settings(data_dir=tmp_path, isolate_reading=False), path) is None


@pytest.mark.parametrize(
    "command", ["compare FILE FILE", "train --recordings FILE --out OUT", "simulate --inputs FILE --out OUT.csv"]
)
def test_no_command_reads_a_recording_in_its_own_process(
    command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def refused(*_: object) -> None:
        raise UserError("read apart")

    monkeypatch.setattr(worker, "Worker", refused)
    monkeypatch.setattr(reading, "Worker", refused)
    (tmp_path / "a.csv").write_text("time,acc\n0,1\n")
    given = command.replace("FILE", str(tmp_path / "a.csv")).replace("OUT", str(tmp_path / "out"))
    if command.startswith("simulate"):
        given += f" {MANCHESTER}"
    assert main(given.split()) == 2
    assert capsys.readouterr().err.splitlines()[-1] == "sprung: read apart"


def test_an_absent_file_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["inspect", str(tmp_path / "no.csv")]) == 2
    assert capsys.readouterr().err.splitlines() == [f"sprung: {tmp_path / 'no.csv'}: No such file or directory"]

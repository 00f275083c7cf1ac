"""`sprung fleet ...` as it is typed, with nothing in its place."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from sprung.model.system import System
from sprung.replay.writing import write_recording
from sprung.service.cli import main
from sprung.service.fleet import nats_broker

SECONDS = 4


@pytest.fixture
def place(system: System, tmp_path: Path) -> Path:
    folder = tmp_path / "recordings"
    folder.mkdir()
    values = 0.01 * np.random.default_rng(3).normal(size=(100 * SECONDS, len(system.channels)))
    path = folder / "a.mcap"
    write_recording(path, system.channels, values, system.sample_rate, 1_790_000_000_000_000_000, vehicle="north-1")
    return folder


def test_a_backfill_without_ray_reads_stores_and_goes_on(
    place: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Settings that say more than the model, such as groups of an organisation, change nothing."""
    monkeypatch.setenv("SPRUNG_DATA_DIR", str(tmp_path / "data"))
    monkeypatch.setenv("SPRUNG_OIDC_GROUPS", '{"works": ["read"]}')
    command = ["fleet", "backfill", str(place), "--on", "here", "--json"]
    assert main(command) == 0
    first = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert (first[0]["vehicle"], first[0]["windows"]) == ("north-1", 2 * SECONDS - 1)
    assert (first[1]["summary"]["vehicles"], first[1]["summary"]["problems"]) == (["north-1"], [])
    assert main(command) == 0
    again = json.loads(capsys.readouterr().out.splitlines()[-1])["summary"]
    assert (again["done_before"], again["windows"]) == (1, 0)
    (place / "broken.mcap").write_bytes(b"no recording")
    assert main(command) == 1
    assert "broken.mcap" in json.loads(capsys.readouterr().out.splitlines()[-1])["summary"]["problems"][0]


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        ("fleet backfill {0}/nowhere --on ray", "nowhere: no such folder"),  # Ray is not started for it
        ("fleet diagnose {0}/nowhere --on ray --out {0}/out", "nowhere: no such folder"),
        ("fleet backfill {0} --since 2026-03-01T00:00:00Z --until 2026-02-01T00:00:00Z", "is not after --since"),
        ("fleet backfill {0} --since yesterday", "--since yesterday: give an RFC 3339 time"),
        ("fleet backfill {0} --on moon", "--on moon: known are here, ray, auto"),
        ("fleet diagnose {0} --on here --out {0}/a.mcap", "a.mcap: is a file; a folder is needed"),
        ("fleet consume http://127.0.0.1", "give nats://HOST:PORT or kafka://HOST:PORT/TOPIC"),
        ("fleet consume nats://127.0.0.1:1", "no NATS server answers"),
        ("fleet consume kafka:///topic", "give an address as in kafka://HOST:9092/TOPIC"),
        ("edge --can nothing --server http://127.0.0.1:1", "give INTERFACE:CHANNEL"),
    ],
)
def test_what_cannot_be_done_is_one_line(
    arguments: str,
    told: str,
    place: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setenv("SPRUNG_DATA_DIR", str(tmp_path / "data"))
    monkeypatch.setattr(nats_broker, "FIRST_ANSWER_SECONDS", 0.3)
    assert main(arguments.format(place).split()) == 2
    captured = capsys.readouterr()
    assert told in captured.err
    assert "Traceback" not in captured.err
    assert len(captured.err.splitlines()) == 1 and captured.out == ""

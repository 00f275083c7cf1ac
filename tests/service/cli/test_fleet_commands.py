"""`sprung fleet ...` as it is typed, with nothing in its place."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from sprung.model.system import System
from sprung.replay.writing import write_recording
from sprung.service.cli import main

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

"""What once passed in silence is told: copies of samples, single zeros, pauses, files that end inside a line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from sprung.model.signals import FloatArray
from sprung.replay import open_recording
from sprung.replay.clock_messages import pauses, remarks
from sprung.replay.windowing import Windower
from tests.fuzz.seeds import TABLE
from tests.replay_files import LEFT, ROWS, START, database, write_can


def table(path: Path, time: FloatArray, left: FloatArray, right: FloatArray) -> list[str]:
    lines = [f"{START // 10**9 + t:.3f},{x:.4f},{y:.4f}" for t, x, y in zip(time, left, right, strict=True)]
    path.write_text("\n".join(["time,left,right", *lines]) + "\n")
    recording = open_recording(path, TABLE)
    windower = Windower(TABLE, 100.0, 100)
    windows = [w for block in recording.blocks() for w in windower.push(block)] + windower.flush()
    return [*recording.problems, *remarks(windower, len(windows)), *pauses(windower)]


SECONDS = np.arange(2000) / 100
NOISE: FloatArray = np.random.default_rng(1).normal(0, 1, 2000)
LEVEL: FloatArray = 9.81 + 0.01 * NOISE


def test_nothing_is_reported_of_a_recording_in_order(tmp_path: Path) -> None:
    assert table(tmp_path / "a.csv", SECONDS, np.round(NOISE), NOISE) == []  # round numbers pass through 0 often


def test_samples_that_are_there_twice_are_reported_with_count_and_place(tmp_path: Path) -> None:
    rows = np.sort(np.r_[np.arange(2000), np.arange(700, 710)])
    told = table(tmp_path / "a.csv", SECONDS[rows], NOISE[rows], LEVEL[rows])
    assert told == ["samples that are there twice: 20, the first after 7.00 s (left, right)"]


def test_zeros_that_stand_for_missing_values_are_reported(tmp_path: Path) -> None:
    wrong = LEVEL.copy()
    wrong[[300, 500, 900]] = 0.0
    told = table(tmp_path / "a.csv", SECONDS, NOISE, wrong)
    assert told == ["single values of 0 between others far from it: 3, the first after 3.00 s (right)"]


@pytest.mark.parametrize("mark", [-99.99, 4095.0, 255.0, -1000.0])
def test_a_value_that_comes_again_and_again_far_from_all_others_is_reported(tmp_path: Path, mark: float) -> None:
    wrong = NOISE.copy()
    wrong[[300, 500, 900, 1500]] = mark
    told = table(tmp_path / "a.csv", SECONDS, wrong, LEVEL)
    assert told == [f"left: 4 single values of {mark:g} between others far from it"]


def test_shocks_are_not_taken_for_marks(tmp_path: Path) -> None:
    shocks = NOISE.copy()
    shocks[[300, 500, 900, 1500]] = [80.0, -95.5, 101.25, 60.0]
    assert table(tmp_path / "a.csv", SECONDS, shocks, LEVEL) == []


def test_a_clock_that_leaps_ahead_and_a_pause_are_reported(tmp_path: Path) -> None:
    told = table(tmp_path / "a.csv", SECONDS + 5.5 * (SECONDS > 10), NOISE, LEVEL)
    assert told == ["nothing for more than 5 s, once: 5.51 s until 2026-09-21T14:13:35Z"]


@pytest.mark.parametrize("kind", [".log", ".asc"])
@pytest.mark.parametrize("cut", [0, 1, 9])
def test_a_log_that_ends_inside_a_line_is_incomplete(tmp_path: Path, kind: str, cut: int) -> None:
    path = tmp_path / f"a{kind}"
    write_can(path)
    whole = path.read_bytes().rstrip(b"\r\n") + b"\n"
    if kind == ".asc":
        whole = whole[: whole.rindex(b"\n", 0, whole.lower().rindex(b"end triggerblock")) + 1]
    path.write_bytes(whole[: len(whole) - cut])
    recording = open_recording(path, TABLE, dbc=database())
    samples = sum(len(block.time) for block in recording.blocks())
    assert samples >= 2 * ROWS - 2 and len(LEFT) == ROWS
    told = any("ends inside a line" in line for line in recording.problems)
    assert (told, recording.incomplete) == (cut > 0, cut > 0)

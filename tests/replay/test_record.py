"""Whole records on one grid, and replay in real time."""

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import pytest

from sprung.model.signals import Channel, FloatArray, SampleBlock
from sprung.replay.pacing import paced
from sprung.replay.record import load_record
from tests.replay_files import CHANNELS, START, STEP, VALUES, write_json

CSV_CHANNELS = [Channel("force", "N", 1.0, csv="force"), Channel("position", "m", 1e-6, csv="position")]


def write_table(path: Path, seconds: FloatArray, columns: Sequence[FloatArray]) -> None:
    rows = [",".join(f"{x:.9g}" for x in row) for row in np.column_stack([seconds, *columns])]
    path.write_text("time,force,position\n" + "\n".join(rows) + "\n")


def test_a_recording_becomes_one_record_with_nothing_changed(tmp_path: Path) -> None:
    write_json(tmp_path / "a.mcap")
    record = load_record(tmp_path / "a.mcap", CHANNELS, 100.0)
    assert record.start == START
    assert record.seconds == 3.0
    assert np.array_equal(record.values, VALUES)
    assert (record.lost, record.vehicle, record.problems) == (0, "tram-7", ())


def test_lost_samples_are_nan_and_counted_and_absent_channels_are_not(tmp_path: Path) -> None:
    seconds = np.arange(500) / 100.0
    keep = np.ones(500, dtype=bool)
    keep[[100, 200, 201]] = False
    write_table(tmp_path / "a.csv", seconds[keep], [np.sin(seconds[keep]), np.full(497, np.nan)])
    record = load_record(tmp_path / "a.csv", CSV_CHANNELS, 100.0)
    assert record.values.shape == (500, 2)
    assert np.flatnonzero(np.isnan(record.values[:, 0])).tolist() == [100, 200, 201]
    assert record.lost == 3
    assert record.problems == ("no values of position",)


def test_a_channel_of_another_rate_is_resampled(tmp_path: Path) -> None:
    seconds = np.arange(0, 20.0, 1 / 610.35)
    write_table(tmp_path / "a.csv", seconds, [np.sin(2 * np.pi * 3 * seconds), np.cos(2 * np.pi * 2 * seconds)])
    record = load_record(tmp_path / "a.csv", CSV_CHANNELS, 200.0)
    grid = record.start / 1e9 + np.arange(len(record.values)) / 200.0
    assert np.abs(record.values[20:-20, 0] - np.sin(2 * np.pi * 3 * grid[20:-20])).max() < 2e-3
    assert record.problems == (
        "2 channels: 610.4 Hz reduced to 200 Hz (linear-phase FIR, flat to 80 Hz, -80 dB from 100 Hz)",
    )


def test_rounded_time_stamps_do_not_move_samples(tmp_path: Path) -> None:
    """Six decimals at 610.35 Hz: the values are copied, not interpolated, all along a long record."""
    seconds = np.round(np.arange(30_000) / 610.35, 6)
    values = np.random.default_rng(1).normal(size=(2, 30_000)).round(6)
    write_table(tmp_path / "a.csv", seconds, list(values))
    record = load_record(tmp_path / "a.csv", CSV_CHANNELS, 610.35)
    assert np.array_equal(record.values, values.T)


def test_after_a_clock_jump_the_longest_stretch_is_kept_and_named(tmp_path: Path) -> None:
    seconds = np.r_[np.arange(100) / 100.0, 1e6 + np.arange(300) / 100.0]
    write_table(tmp_path / "a.csv", seconds, [np.arange(400.0), np.arange(400.0)])
    record = load_record(tmp_path / "a.csv", CSV_CHANNELS, 100.0)
    assert record.values[:, 0].tolist() == list(range(100, 400))
    assert record.start == 10**15
    assert "the clock jumps 1 times; the longest stretch is used, 200 samples are not" in record.problems


class SleptClock:
    """Stands still but for those who sleep."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        assert seconds > 0
        self.now += seconds


def blocks(seconds: float = 4.0) -> Iterator[SampleBlock]:
    times = START + np.arange(round(seconds * 100)) * STEP
    for part in np.array_split(times, 3):
        yield SampleBlock(part, np.zeros(len(part), dtype=np.int32), np.arange(len(part), dtype=float))


@pytest.mark.parametrize("speed", [1.0, 5.0])
def test_paced_replay_takes_the_recorded_time_over_the_speed(speed: float) -> None:
    clock = SleptClock()
    seen = []
    for block in paced(blocks(), speed, clock, clock.sleep):
        seen.append(len(block.time))
        recorded = (block.time[-1] - START) / 1e9
        assert clock.now - 100.0 <= recorded / speed + 1e-9
        assert clock.now - 100.0 >= (recorded - 0.06) / speed
    assert sum(seen) == 400
    assert max(seen) <= 6


def test_unpaced_replay_never_waits_and_bad_speeds_are_refused() -> None:
    assert len(list(paced(blocks(), 0.0, SleptClock(), None))) == 3  # type: ignore[arg-type]
    assert len(list(paced(blocks(), float("inf"), SleptClock(), None))) == 3  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="speed must be positive"):
        list(paced(blocks(), -1.0))


def test_a_long_pause_in_the_recording_is_not_waited_for() -> None:
    clock = SleptClock()
    pause = [SampleBlock(np.array([START + t]), np.zeros(1, dtype=np.int32), np.zeros(1)) for t in (0, 3600 * 10**9)]
    assert len(list(paced(pause, 1.0, clock, clock.sleep))) == 2
    assert clock.now - 100.0 <= 5.0

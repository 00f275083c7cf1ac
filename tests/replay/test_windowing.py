"""Windows from streams: what lies on the grid is untouched, what does not is resampled, and nothing is uncounted."""

import time
from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from sprung.model.signals import BoolArray, Channel, FloatArray, SampleBlock, Window
from sprung.replay.windowing import Windower

RATE = 100.0
START = 1_790_000_000_123_456_789
NAMES = ("road", "roof", "axle")
CHANNELS = [Channel(name, "m", 1e-3) for name in NAMES]


def truth(seconds: FloatArray, channel: int | NDArray[np.int32]) -> FloatArray:
    """A smooth signal with content at 1.3 Hz and 11 Hz, different in every channel."""
    return np.sin(2 * np.pi * 1.3 * seconds + channel) + 0.3 * np.sin(2 * np.pi * 11.0 * seconds + 2.0 * channel)


def stream(
    seconds_by_channel: Sequence[FloatArray],
    values: Sequence[FloatArray] | None = None,
    order: Sequence[FloatArray] | None = None,
) -> SampleBlock:
    """One block in time order (or in `order`, seconds of arrival by channel)."""
    time_s = np.concatenate(seconds_by_channel)
    channel = np.repeat(np.arange(len(seconds_by_channel)), [len(s) for s in seconds_by_channel]).astype(np.int32)
    value = np.concatenate(values) if values else truth(time_s, channel)
    arrival = np.argsort(np.concatenate(order) if order else time_s, kind="stable")
    stamps = START + np.rint(time_s * 1e9).astype(np.int64)
    return SampleBlock(stamps[arrival], channel[arrival], value[arrival])


def even(seconds: float = 4.0, rate: float = RATE, channels: int = 3) -> list[FloatArray]:
    return [np.arange(0.0, seconds - 1e-9, 1.0 / rate) for _ in range(channels)]


def windows_of(block: SampleBlock, **options: Any) -> tuple[Windower, list[Window]]:
    windower = Windower(CHANNELS, RATE, 100, 50, needed=[frozenset({"road"})], **options)
    return windower, windower.push(block) + windower.flush()


def expected(window: Window, channels: int = 3) -> FloatArray:
    """The truth on the window's own grid, in seconds since START."""
    seconds = (window.start - START) / 1e9 + np.arange(100) / RATE
    return np.stack([truth(seconds, channel) for channel in range(channels)], axis=1)


def same(a: Window, b: Window) -> bool:
    return (
        a.start == b.start
        and (a.outcome, a.reason, a.repaired_samples) == (b.outcome, b.reason, b.repaired_samples)
        and np.allclose(a.values, b.values, rtol=0.0, atol=1e-9, equal_nan=True)
    )


def cut(block: SampleBlock, ends: Iterable[int]) -> list[SampleBlock]:
    edges = [0, *ends, len(block.time)]
    return [SampleBlock(block.time[a:b], block.channel[a:b], block.value[a:b]) for a, b in pairwise(edges)]


def without(block: SampleBlock, mask: BoolArray) -> SampleBlock:
    return SampleBlock(block.time[~mask], block.channel[~mask], block.value[~mask])


def test_samples_on_the_grid_pass_unchanged() -> None:
    windower, windows = windows_of(stream(even()))
    assert [w.start for w in windows] == [START + i * 500_000_000 for i in range(7)]
    for window in windows:
        assert window.outcome == "used"
        seconds = (window.start - START) / 1e9 + np.arange(100) / RATE
        assert np.abs(window.values - expected(window)).max() < 1e-12, seconds
    assert (windower.account.expected, windower.account.lost) == (1200, 0)


def test_jitter_and_bus_order_within_a_quarter_period_do_not_smear() -> None:
    rng = np.random.default_rng(1)
    seconds = even()
    block = stream(seconds)
    skewed = replace(block, time=block.time + block.channel * 300_000 + rng.integers(0, 1_500_000, len(block.time)))
    _, windows = windows_of(skewed)
    for window in windows:
        seconds = np.round((window.start - START) / 1e9 * RATE) / RATE + np.arange(100) / RATE
        assert window.outcome == "used"
        assert np.abs(window.values[:, 1] - truth(seconds, 1)).max() < 1e-12


def test_windows_do_not_depend_on_how_samples_are_cut_into_blocks() -> None:
    rng = np.random.default_rng(2)
    seconds = even(6.0)
    seconds[1] = np.arange(0.0, 6.0, 1.0 / 730.0)  # faster, another rate
    seconds[2] = seconds[2] + 0.004  # another phase
    block = stream(seconds)
    block = replace(block, time=block.time + rng.integers(-400_000, 400_000, len(block.time)))
    block = without(block, rng.random(len(block.time)) < 0.003)
    _, whole = windows_of(block)
    assert {w.outcome for w in whole} >= {"repaired"}
    for _ in range(5):
        ends = np.sort(rng.choice(len(block.time), 40, replace=False)).tolist()
        windower = Windower(CHANNELS, RATE, 100, 50, needed=[frozenset({"road"})])
        parts = [w for piece in cut(block, ends) for w in windower.push(piece)] + windower.flush()
        assert len(parts) == len(whole)
        assert all(same(a, b) for a, b in zip(parts, whole, strict=True))


def test_a_faster_channel_is_resampled_without_aliases() -> None:
    """Content at 80 Hz would fold to 20 Hz at 100 Hz; the filter must remove it and leave 11 Hz alone."""
    seconds = even()
    seconds[1] = np.arange(0.0, 4.0 - 1e-9, 1e-3)
    values = [truth(seconds[0], 0), truth(seconds[1], 1) + np.sin(2 * np.pi * 80.0 * seconds[1]), truth(seconds[2], 2)]
    _, windows = windows_of(stream(seconds, values))
    for window in windows[1:-1]:
        assert window.outcome == "used"
        assert np.abs(window.values[:, 1] - expected(window)[:, 1]).max() < 2e-3


@pytest.mark.parametrize("phase", [0.003, 0.005, -0.0045])
def test_a_channel_sampled_between_the_grid_points_is_delayed_by_the_fraction(phase: float) -> None:
    seconds = even()
    seconds[2] = seconds[2][1:] + phase
    _, windows = windows_of(stream(seconds))
    assert len(windows) == 7
    for window in windows[1:-1]:
        assert window.outcome == "used"
        assert np.abs(window.values - expected(window)).max() < 1e-3


def test_jitter_of_even_samples_is_removed_before_resampling() -> None:
    """Arrival scatters by more than a quarter of a period around an even clock: the samples, not the scatter, count."""
    rng = np.random.default_rng(3)
    seconds = even()
    stamps = seconds[2] + rng.uniform(-0.0028, 0.0028, len(seconds[2]))
    values = [truth(s, c) for c, s in enumerate(seconds)]
    _, windows = windows_of(stream([seconds[0], seconds[1], stamps], values))
    for window in windows[1:-1]:
        assert window.outcome == "used", window.reason
        error = np.abs(window.values[:, 2] - expected(window)[:, 2]).max()
        assert error < 0.04  # the phase of 100 stamps is known to 0.2 ms; taken at their word they err by 0.09


def test_a_slower_channel_is_interpolated_and_marked_down_to_half_the_rate() -> None:
    seconds = even(channels=3)
    seconds[1] = np.arange(0.0, 4.0 - 1e-9, 1.0 / 62.5)
    _, windows = windows_of(stream(seconds))
    for window in windows[1:-1]:
        assert (window.outcome, window.reason) == ("repaired", "roof interpolated from 62.5 Hz")
        assert np.abs(window.values[:, 1] - expected(window)[:, 1]).max() < 2e-3


def test_a_sensor_slower_than_half_the_rate_is_absent_and_an_input_drops_the_window() -> None:
    seconds = even()
    seconds[1] = np.arange(0.0, 4.0 - 1e-9, 1.0 / 20.0)
    _, windows = windows_of(stream(seconds))
    assert np.isnan(windows[1].values[:, 1]).all()
    assert windows[1].reason == "roof too slow (20 Hz)"
    seconds = even()
    seconds[0] = np.arange(0.0, 4.0 - 1e-9, 1.0 / 20.0)
    _, windows = windows_of(stream(seconds))
    assert {(w.outcome, w.reason) for w in windows} == {("dropped", "road too slow (20 Hz)")}


def test_bursts_without_an_even_clock_are_refused() -> None:
    seconds = even()
    seconds[1] = np.sort(np.random.default_rng(4).uniform(0.0, 4.0, 400))
    _, windows = windows_of(stream(seconds))
    assert {w.reason for w in windows} == {"roof unevenly sampled"}
    assert np.isnan(windows[2].values[:, 1]).all()


def test_isolated_lost_samples_are_interpolated_marked_and_counted() -> None:
    block = stream(even())
    row = np.rint((block.time - START) / 1e7).astype(int)
    lost = ((block.channel == 1) & np.isin(row, [130, 131, 170])) | ((block.channel == 2) & (row == 180))
    windower, windows = windows_of(without(block, lost))
    assert [w.outcome for w in windows] == ["used", "repaired", "repaired", "repaired", "used", "used", "used"]
    assert [w.repaired_samples for w in windows] == [0, 2, 4, 2, 0, 0, 0]
    assert all(np.abs(w.values - expected(w)).max() < 0.02 for w in windows)
    assert (windower.account.expected, windower.account.lost) == (1200, 4)


def test_invalid_values_are_missing_samples() -> None:
    block = stream(even())
    invalid = (block.channel == 1) & (np.rint((block.time - START) / 1e7) == 130)
    windower, windows = windows_of(replace(block, value=np.where(invalid, np.nan, block.value)))
    assert [w.outcome for w in windows].count("repaired") == 2
    assert windower.account.lost == 1


@pytest.mark.parametrize("phase", [0.002, 0.0045, 0.005])
def test_every_lost_sample_counts_once_whatever_the_phase_of_its_channel(phase: float) -> None:
    """Half a period off the grid, too, where a sample is as near to the row before it as to the one after."""
    seconds = even()
    seconds[1] = np.delete(seconds[1] + phase, [50, 150, 151, 152, 153])
    windower, _ = windows_of(stream(seconds))
    assert windower.account.lost == 5


def test_a_longer_gap_drops_the_windows_that_hold_it_and_no_other() -> None:
    block = stream(even())
    row = np.rint((block.time - START) / 1e7).astype(int)
    windower, windows = windows_of(without(block, (block.channel == 2) & (row >= 120) & (row < 123)))
    assert [w.outcome for w in windows] == ["used", "dropped", "dropped", "used", "used", "used", "used"]
    assert windows[1].reason == "gap in axle"
    assert windower.account.reasons["gap in axle"] == 2


def test_too_many_lost_samples_drop_a_window() -> None:
    block = stream(even())
    row = np.rint((block.time - START) / 1e7).astype(int)
    _, windows = windows_of(without(block, (row < 100) & (row % 9 == 4)))
    assert windows[0].outcome == "dropped"
    assert windows[0].reason == "too many missing samples"
    assert windows[-1].outcome == "used"


def test_a_channel_with_a_loose_contact_is_absent_and_costs_no_window() -> None:
    """It sends for 0.3 s, then not for 0.3 s."""
    block = stream(even())
    row = np.rint((block.time - START) / 1e7).astype(int)
    torn = without(block, (block.channel == 2) & (row % 60 < 30))
    _, windows = windows_of(torn)
    assert {(w.outcome, w.reason) for w in windows} == {("repaired", "gaps in axle")}
    assert all(np.isnan(w.values[:, 2]).all() and np.isfinite(w.values[:, :2]).all() for w in windows)
    everything = without(block, row % 60 < 30)
    assert {w.outcome for w in windows_of(everything)[1]} == {"dropped"}


def test_an_absent_sensor_is_a_nan_column_and_an_absent_input_drops_the_window() -> None:
    block = stream(even())
    _, windows = windows_of(without(block, block.channel == 2))
    assert {w.outcome for w in windows} == {"used"}
    assert all(np.isnan(w.values[:, 2]).all() and np.isfinite(w.values[:, :2]).all() for w in windows)
    windower, windows = windows_of(without(block, block.channel == 0))
    assert {(w.outcome, w.reason) for w in windows} == {("dropped", "missing input road")}
    assert windower.account.reasons["missing input road"] == len(windows)


def test_duplicates_and_samples_out_of_order_within_the_delay_change_nothing() -> None:
    rng = np.random.default_rng(5)
    block = stream(even())
    _, reference = windows_of(block)
    twice = np.sort(np.r_[np.arange(len(block.time)), rng.choice(len(block.time), 200)])
    shuffled = twice[np.argsort(twice + rng.uniform(0, 120, len(twice)))]  # up to 0.4 s
    first = int(np.flatnonzero(shuffled == 0)[0])
    shuffled = np.r_[0, np.delete(shuffled, first)]  # the grid begins at the first sample that arrives
    mixed = SampleBlock(block.time[shuffled], block.channel[shuffled], block.value[shuffled])
    windower, windows = windows_of(mixed)
    assert all(same(a, b) for a, b in zip(windows, reference, strict=True))
    assert not windower.account.reasons


def test_late_samples_are_dropped_and_counted() -> None:
    seconds = even()
    arrival = [s.copy() for s in seconds]
    arrival[1][150] += 1.0
    windower, windows = windows_of(stream(seconds, order=arrival))
    assert windower.account.reasons["late"] == 1
    assert [w.repaired_samples for w in windows] == [0, 0, 1, 1, 0, 0, 0][: len(windows)]


@pytest.mark.parametrize("jump", [3600.0, -3600.0, -2.0])
def test_a_clock_jump_restarts_the_grid(jump: float) -> None:
    block = stream(even(6.0))
    later = block.time >= START + 3_000_000_000
    moved = replace(block, time=block.time + np.where(later, int(jump * 1e9), 0))
    windower, windows = windows_of(moved)
    assert {w.outcome for w in windows} == {"used"}
    assert len(windows) == 10
    assert windows[5].start == START + int((3.0 + jump) * 1e9)
    assert sum(count for reason, count in windower.account.reasons.items() if "clock jump" in reason) == 1
    assert windower.account.recorded == pytest.approx(6.0)


def test_a_small_step_back_of_the_clock_is_not_taken_for_duplicates() -> None:
    block = stream(even(6.0))
    later = block.time >= START + 3_000_000_000
    _, windows = windows_of(replace(block, time=block.time - np.where(later, 300_000_000, 0)))
    assert "clock stepped back" in {w.reason for w in windows}
    used = [w for w in windows if w.outcome == "used"]
    assert len(used) >= 8


def test_a_stray_time_stamp_does_not_stop_the_stream() -> None:
    block = stream(even())
    stamps = block.time.copy()
    stamps[500] = 4 * START
    stamps[700] = 0
    windower, windows = windows_of(replace(block, time=stamps))
    assert windower.account.reasons["stray time stamp"] == 1
    assert windower.account.reasons["late"] == 1
    assert len(windows) == 7
    assert windower.account.recorded == pytest.approx(4.0)  # and not the years to the stray one


def test_the_grid_follows_a_clock_that_drifts() -> None:
    """300 ppm for ten minutes are 18 samples: windows stay whole and their samples unsmeared."""
    seconds = even(600.0)
    block = stream([s * (1 + 3e-4) for s in seconds], [truth(s, c) for c, s in enumerate(seconds)])
    _, windows = windows_of(block)
    assert {w.outcome for w in windows} == {"used"}
    assert len(windows) == 1199
    for k in (0, 600, 1198):
        row = round((windows[k].start - START) / 1e7 / (1 + 3e-4))
        assert np.array_equal(windows[k].values[:, 1], truth(seconds[1][row : row + 100], 1))


def test_a_pause_shorter_than_the_limit_keeps_the_grid() -> None:
    block = stream(even(8.0))
    silent = (block.time >= START + 2_000_000_000) & (block.time < START + 5_000_000_000)
    _, windows = windows_of(without(block, silent))
    assert [w.reason for w in windows].count("no samples") == 5
    assert windows[-1].start == START + 7_000_000_000
    assert windows[-1].outcome == "used"


def test_a_long_recording_takes_little_time_and_memory_stays_bounded() -> None:
    channels = [Channel(f"c{i}", "m", 1e-3) for i in range(28)]
    rows = np.arange(60_000)
    block = SampleBlock(
        np.repeat(START + rows * 10_000_000, 28), np.tile(np.arange(28, dtype=np.int32), 60_000), np.ones(28 * 60_000)
    )
    windower = Windower(channels, RATE, 100, 50)
    begun = time.process_time()
    count, most = 0, 0
    for first in range(0, len(block.time), 28_000):
        part = slice(first, first + 28_000)
        count += len(windower.push(SampleBlock(block.time[part], block.channel[part], block.value[part])))
        most = max(most, sum(len(piece.time) for piece in windower._pending))
    count += len(windower.flush())
    assert count == 1199
    assert most < 28 * 400
    assert time.process_time() - begun < 3.0  # 0.6 s measured; the margin is for a busy machine


def arriving_late(seconds: FloatArray, rng: np.random.Generator, stalls: Iterable[tuple[float, float]]) -> FloatArray:
    """Arrival times: in order, each some milliseconds late, and nothing at all during the stalls."""
    arrival = seconds + rng.uniform(0.0, 0.002, len(seconds))
    for begin, length in stalls:
        arrival = np.where((arrival > begin) & (arrival < begin + length), begin + length, arrival)
    return np.maximum.accumulate(arrival + np.arange(len(arrival)) * 1e-6)


def test_bursty_arrival_of_an_even_source_is_counted_out_and_marked() -> None:
    rng = np.random.default_rng(6)
    seconds = even(6.0)
    stalls = [(t, 0.12) for t in np.arange(0.33, 5.0, 0.25)]
    values = [truth(s, c) for c, s in enumerate(seconds)]
    _, windows = windows_of(stream([arriving_late(s, rng, stalls) for s in seconds], values))
    placed = [w for w in windows if w.outcome == "repaired"]
    assert len(placed) >= 7
    for window in placed:
        assert window.reason == "arrival times made even"
        row = round((window.start - START) / 1e7)
        assert np.abs(window.values - np.stack(values, axis=1)[row : row + 100]).max() < 0.03  # the phase: 0.4 ms


def test_bursty_arrival_with_a_lost_sample_is_not_counted_out() -> None:
    rng = np.random.default_rng(7)
    seconds = even(6.0)
    stalls = [(t, 0.12) for t in np.arange(0.33, 5.0, 0.25)]
    arrival = [arriving_late(s, rng, stalls) for s in seconds]
    values = [truth(s, c) for c, s in enumerate(seconds)]
    arrival[0], values[0] = np.delete(arrival[0], 260), np.delete(values[0], 260)
    _, windows = windows_of(stream(arrival, values))
    used = [window for window in windows if window.outcome != "dropped"]
    assert len(used) >= 7
    for window in used:
        row = round((window.start - START) / 1e7)
        kept = np.stack([truth(s, c) for c, s in enumerate(seconds)], axis=1)[row : row + 100]
        assert np.abs(window.values - kept).max() < 0.03

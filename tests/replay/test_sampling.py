"""Recordings of any rate on the system's grid: reduced, interpolated or refused, and always said so."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sprung.model.signals import Channel, FloatArray, SampleBlock
from sprung.replay import UnreadableRecording
from sprung.replay.account import Account
from sprung.replay.multirate import MultirateColumns
from sprung.replay.record import load_record
from sprung.replay.sampling import anti_alias_taps, at_rate, sampling_clock
from sprung.replay.windowing import Windower
from tests.replay.test_record import CSV_CHANNELS, write_table

CHANNELS = [Channel("fast", "m", 1e-6), Channel("slow", "m", 1e-6)]
GRID = 100.0


def stream(time: FloatArray, value: FloatArray, seconds: float = 20.0, size: int = 997) -> Iterator[SampleBlock]:
    """A fast channel beside one at the grid's rate, cut into blocks, in time order."""
    slow = np.arange(round(seconds * GRID)) / GRID
    times = np.r_[np.rint(time * 1e9), np.rint(slow * 1e9)].astype(np.int64)
    channel = np.r_[np.zeros(len(time)), np.ones(len(slow))].astype(np.int32)
    order = np.argsort(times, kind="stable")
    whole = times[order], channel[order], np.r_[value, slow][order]
    for first in range(0, len(order), size):
        yield SampleBlock(*(part[first : first + size] for part in whole))


def reduced(time: FloatArray, value: FloatArray, **options: Any) -> tuple[FloatArray, FloatArray, FloatArray, Account]:
    """Times (s) and values of the fast channel, values of the slow one, the account."""
    account = Account()
    out = list(at_rate(stream(time, value, **options), CHANNELS, GRID, account, Path("ride.csv")))
    times = np.concatenate([block.time for block in out])
    assert (np.diff(times) >= 0).all()
    channel = np.concatenate([block.channel for block in out])
    values = np.concatenate([block.value for block in out])
    return times[channel == 0] / 1e9, values[channel == 0], values[channel == 1], account


def motion(t: FloatArray) -> FloatArray:
    return np.sin(2 * np.pi * 7 * t) + 0.2 * np.sin(2 * np.pi * 31 * t)


def test_channels_of_another_world_are_left_out_or_refused_before_a_filter_is_made_for_them() -> None:
    """Times in the wrong unit: a thousand million samples a second would need a filter of 4 GB."""
    many: FloatArray = np.arange(3000.0)
    time, _, slow, account = reduced(many * 1e-9, many, seconds=5.0)
    assert len(time) == 0 and len(slow) == 500
    assert account.problems == ["more than 100000 times faster than 100 Hz, so left out: fast (1e+09 Hz)"]
    alone = SampleBlock(many.astype(np.int64), np.zeros(3000, dtype=np.int32), many)
    with pytest.raises(UnreadableRecording, match=r"ride.csv: its samples come every 1e-09 s.* another unit"):
        list(at_rate(iter([alone]), CHANNELS, GRID, Account(), Path("ride.csv")))


@pytest.mark.parametrize("rate", [200.0, 250.0, 333.0, 1000.0, 2000.0, 10_000.0, 50_000.0])
def test_fast_channels_keep_what_the_grid_can_hold_and_lose_what_would_alias(rate: float) -> None:
    t = np.arange(round(10 * rate)) / rate
    above = sum(
        np.sin(2 * np.pi * f * t) for f in (51.0, 93.0, 0.49 * rate) if f < rate / 2
    )  # 93 Hz would show as 7 Hz
    time, value, slow, account = reduced(t, motion(t) + above, seconds=10.0)
    assert np.abs(value - motion(time)).max() < 3e-4
    assert np.array_equal(np.rint(slow * GRID), np.arange(round(slow[0] * GRID), round(slow[-1] * GRID) + 1))
    assert account.problems == [
        f"fast: {rate:.4g} Hz reduced to 100 Hz (linear-phase FIR, flat to 40 Hz, -80 dB from 50 Hz)"
    ]
    assert not account.incomplete
    if rate % GRID == 0:
        assert np.abs(time * GRID - np.rint(time * GRID)).max() < 1e-6  # on the grid: copied, not interpolated
    assert abs(time[0] - slow[0]) < 0.011
    assert abs(time[-1] - slow[-1]) < 0.011


def test_the_filter_is_as_flat_and_as_steep_as_it_says() -> None:
    taps = anti_alias_taps(1, 10, 10.0)
    frequency = np.fft.rfftfreq(1 << 16) * 10.0  # in grid rates
    gain = np.abs(np.fft.rfft(taps, 1 << 16))
    assert np.abs(gain[frequency < 0.4] - 1).max() < 2e-4
    assert gain[frequency > 0.5].max() < 1.2e-4
    assert np.array_equal(taps, taps[::-1])


def test_the_result_does_not_depend_on_how_the_samples_are_cut_into_blocks() -> None:
    t = np.arange(20_000) / 1000.0
    one, two = (reduced(t, motion(t), size=size) for size in (100, 7001))
    assert np.array_equal(one[0], two[0])
    assert np.allclose(one[1], two[1], atol=1e-12)


def test_jittered_and_rounded_stamps_are_counted_out() -> None:
    t = np.arange(40_000) / 2000.0
    jitter = np.random.default_rng(3).normal(0.0, 0.1 / 2000.0, len(t))
    for stamps in (t + jitter, np.round(t, 3)):
        time, value, _, _ = reduced(stamps, motion(t))
        assert np.abs(value - motion(time)).max() < 4e-3


def test_lost_samples_are_bridged_and_longer_gaps_are_gaps() -> None:
    t = np.arange(20_000) / 1000.0
    keep = np.ones(len(t), dtype=bool)
    keep[[5000, 5001, 7000]] = False
    time, value, _, _ = reduced(t[keep], motion(t)[keep])
    assert np.abs(value - motion(time)).max() < 2e-3
    keep[10_000:10_500] = False
    time, value, _, _ = reduced(t[keep], motion(t)[keep])
    assert np.abs(value - motion(time)).max() < 2e-3
    assert not ((time > 9.999) & (time < 10.5)).any()
    assert np.diff(time).max() < 1.2  # the gap and the reach of the filter on either side


def test_values_that_are_missing_stay_missing() -> None:
    t = np.arange(20_000) / 1000.0
    value = motion(t)
    value[9000:9100] = np.nan
    time, got, _, _ = reduced(t, value)
    inside = (time > 9.006) & (time < 9.094)
    assert np.isnan(got[inside]).all()
    assert not np.isnan(got[(time < 8.99) | (time > 9.11)]).any()


def test_the_pace_of_a_channel_does_not_mind_gaps() -> None:
    time = np.rint(np.r_[np.arange(500), 5000 + np.arange(800)] * 1e6).astype(np.int64)
    found = sampling_clock(time)
    assert found is not None and found.period == pytest.approx(1e-3)
    assert found.jitter < 1e-6
    uneven = np.cumsum(np.random.default_rng(0).exponential(1e6, 3000)).astype(np.int64)
    found = sampling_clock(uneven)
    assert found is not None and found.jitter > 3


def test_times_in_another_unit_than_assumed_are_refused_with_the_likely_one(tmp_path: Path) -> None:
    seconds = np.arange(500) / 100.0
    for factor, unit in ((1e3, "ms"), (1e6, "us")):
        write_table(tmp_path / "a.csv", seconds * factor, [np.sin(seconds), np.cos(seconds)])
        with pytest.raises(UnreadableRecording, match=rf"if its times are in {unit}, set `time: {{unit: {unit}}}`"):
            load_record(tmp_path / "a.csv", CSV_CHANNELS, 100.0)


def test_a_channel_that_is_too_slow_is_left_out_and_named() -> None:
    fast, slow = np.arange(3000) / 100.0, np.arange(300) / 10.0
    time = np.r_[fast, slow]
    channel = np.r_[np.zeros(3000), np.ones(300)].astype(np.int32)
    order = np.argsort(time, kind="stable")
    block = SampleBlock(np.rint(time[order] * 1e9).astype(np.int64), channel[order], time[order])
    account = Account()
    list(at_rate([block], CHANNELS, GRID, account, Path("ride.csv")))
    assert account.problems == ["slower than half of 100 Hz, so left out: slow (10 Hz)"]


def irregular(seconds: float = 60.0, low: float = 0.006, high: float = 0.013, seed: int = 1) -> FloatArray:
    """Stamps whose steps scatter: no even clock fits them."""
    time = np.cumsum(np.random.default_rng(seed).uniform(low, high, round(seconds / (low + high) * 2)))
    return np.round(time, 6)


def test_irregular_stamps_of_a_table_are_interpolated_and_nothing_is_lost_in_silence(tmp_path: Path) -> None:
    time = irregular()
    write_table(tmp_path / "a.csv", time, [np.sin(2 * np.pi * 3 * time), np.cos(2 * np.pi * 5 * time)])
    record = load_record(tmp_path / "a.csv", CSV_CHANNELS, 100.0)
    assert record.lost <= 4
    grid = record.start / 1e9 + np.arange(len(record.values)) / 100.0
    inner = slice(30, -30)
    assert np.abs(record.values[inner, 0] - np.sin(2 * np.pi * 3 * grid[inner])).max() < 0.01
    assert np.abs(record.values[inner, 1] - np.cos(2 * np.pi * 5 * grid[inner])).max() < 0.02
    assert sum("its time stamps fit no even clock (steps of 6" in line for line in record.problems) == 2


def test_windows_of_irregular_stamps_are_repaired_for_tables_and_dropped_for_buses() -> None:
    time = irregular(20.0)
    block = SampleBlock(
        np.rint(time * 1e9).astype(np.int64), np.zeros(len(time), dtype=np.int32), np.sin(2 * np.pi * 3 * time)
    )
    for stamped in (True, False):
        windower = Windower(CHANNELS[:1], 100.0, 200, stamped=stamped)
        windows = [*windower.push(block), *windower.flush()]
        assert len(windows) > 15
        for window in windows[1:-1]:
            at = window.start / 1e9 + np.arange(200) / 100.0
            if stamped:
                assert window.outcome == "repaired"
                assert window.reason == "fast unevenly sampled: interpolated"
                assert np.abs(window.values[:, 0] - np.sin(2 * np.pi * 3 * at)).max() < 0.02
            else:
                assert window.outcome == "dropped"


def test_what_is_missing_from_a_record_is_said_with_its_longest_gap(tmp_path: Path) -> None:
    time = np.arange(2000) / 100.0
    force = np.sin(time)
    force[500:900] = np.nan
    force[1200:1210] = np.nan
    write_table(tmp_path / "a.csv", time, [force, np.cos(time)])
    record = load_record(tmp_path / "a.csv", CSV_CHANNELS, 100.0)
    assert record.lost == 410
    assert record.problems == ("force: 20 % of its samples are missing; the longest of 2 gaps has 4 s, from 5.00 s on",)


@pytest.mark.parametrize("first", [0, 1])
def test_a_slower_column_of_a_table_has_the_clock_of_its_rows(tmp_path: Path, first: int) -> None:
    time = np.arange(3000) / 100.0
    position = np.cos(2 * np.pi * 1.5 * time)
    position[1 - first :: 2] = np.nan
    position[1000 + first] = np.nan  # one sample that is missing indeed
    write_table(tmp_path / "a.csv", time, [np.sin(time), position])
    record = load_record(tmp_path / "a.csv", CSV_CHANNELS, 100.0)
    assert 1 <= record.lost <= 4
    known = slice(20, 980)
    assert np.abs(record.values[known, 1] - np.cos(2 * np.pi * 1.5 * time[known])).max() < 0.02
    assert not np.isnan(record.values[:, 0]).any()


def test_nodes_whose_rows_lie_between_each_others_each_have_their_clock(tmp_path: Path) -> None:
    fast, slow = np.arange(3000) / 100.0, np.arange(2400) / 80.0 + 0.003
    time = np.r_[fast, slow]
    order = np.argsort(time, kind="stable")
    force, position = np.full((2, len(time)), np.nan)
    force[: len(fast)], position[len(fast) :] = np.sin(6 * fast), np.cos(6 * slow)
    write_table(tmp_path / "a.csv", time[order], [force[order], position[order]])
    record = load_record(tmp_path / "a.csv", CSV_CHANNELS, 100.0)
    at = np.arange(20, 2900)
    assert np.abs(record.values[at, 0] - np.sin(6 * at / 100)).max() < 0.01
    assert np.abs(record.values[at, 1] - np.cos(6 * at / 100)).max() < 0.01


def test_a_sensor_that_drops_out_at_random_or_dies_has_no_clock_of_its_own() -> None:
    time, random = np.arange(1000) * 10_000_000, np.random.default_rng(3)
    empty = np.zeros((1000, 3), dtype=bool)
    empty[:, 0] = random.uniform(size=1000) < 0.4
    empty[300:, 1] = True
    kept, missing = MultirateColumns().kept(time, empty)
    assert kept.all() and missing == empty.sum()


def test_a_gap_of_many_minutes_in_a_channel_off_the_grid_is_a_gap(tmp_path: Path) -> None:
    time = np.r_[np.arange(300), 3000 + np.arange(300)] / 100.0 + np.where(np.arange(600) % 2, 0.004, 0.0)
    write_table(tmp_path / "a.csv", time, [np.sin(time), np.cos(time)])
    record = load_record(tmp_path / "a.csv", CSV_CHANNELS, 100.0)
    assert np.isnan(record.values[320:2980]).all()
    assert not np.isnan(record.values[20:280]).any()


def test_a_record_beyond_any_memory_is_refused(tmp_path: Path) -> None:
    rows = "".join(f"{t},1,2\n" for t in (*range(20), *(4e8 + i for i in range(40))))
    (tmp_path / "a.csv").write_text("time,force,position\n" + rows)
    with pytest.raises(UnreadableRecording, match="more than can be analysed in one piece"):
        load_record(tmp_path / "a.csv", CSV_CHANNELS, 1.0e3 / 900, pause=1e9)


@pytest.mark.parametrize("scatter", [0.03, 0.2, 0.4])
def test_uneven_stamps_are_accepted_where_the_samples_were_taken_then(tmp_path: Path, scatter: float) -> None:
    """A table's stamps scatter: either the samples do too, or only the stamps; the signal tells which."""
    rng = np.random.default_rng(2)
    even = np.arange(2000) / 200.0
    stamps = even + scatter / 200.0 * rng.uniform(-1, 1, len(even))

    def signal(at: FloatArray) -> FloatArray:
        return np.sin(2 * np.pi * 1.3 * at) + 0.4 * np.sin(2 * np.pi * 4.1 * at + 1)

    for taken in (stamps, even):
        noisy = signal(taken) + 1e-3 * rng.standard_normal(len(even))
        path = tmp_path / "rig.csv"
        rows = "\n".join(f"{t:.7f},{v:.7g}" for t, v in zip(stamps, noisy, strict=True))
        path.write_text("time,x\n" + rows + "\n")
        record = load_record(path, (Channel("x", "m", 1e-6, csv="x"),), 200.0)
        at = record.start / 1e9 + np.arange(len(record.values)) / 200.0
        at -= at[0] - stamps[0]
        error = (record.values[:, 0] - signal(at))[20:-20]
        shift = np.std(error - np.mean(error))
        assert shift < (3.5e-3 if taken is stamps else 0.004 + 0.06 * scatter)

"""No time stamp makes a vehicle deaf, and a recording of which nothing can be used says so."""

import time
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.typing import ArrayLike

from sprung.model.signals import Channel, SampleBlock, Window
from sprung.replay import UnreadableRecording, open_recording
from sprung.replay.clock_messages import remarks
from sprung.replay.plausibility import EARLIEST, LATEST
from sprung.replay.record import load_record
from sprung.replay.windowing import Windower

CHANNELS = [Channel("a", "m/s^2", 0.01, csv="a"), Channel("b", "m/s^2", 0.01, csv="b")]
START = 1_790_000_000_000_000_000
HOUR, YEAR = 3600.0, 365.25 * 86_400.0


def block(seconds: ArrayLike, start: int = START) -> SampleBlock:
    """Both channels at these times."""
    times = start + np.rint(np.asarray(seconds) * 1e9).astype(np.int64)
    return SampleBlock(
        np.repeat(times, 2),
        np.tile(np.array([0, 1], dtype=np.int32), len(times)),
        np.repeat(np.sin(np.arange(len(times))), 2),
    )


def cut(*blocks: SampleBlock, size: int = 500) -> tuple[list[Window], Windower]:
    """Windows of 1 s each half second, and the windower."""
    windower = Windower(CHANNELS, 100.0, 100, 50)
    windows = []
    for whole in blocks:
        for first in range(0, len(whole.time), size):
            piece = slice(first, first + size)
            windows += windower.push(SampleBlock(whole.time[piece], whole.channel[piece], whole.value[piece]))
    return windows + windower.flush(), windower


TEN = np.arange(1000) / 100


@pytest.mark.parametrize("step", [-HOUR, -14 * YEAR, -30.0, 20.0, HOUR, 14 * YEAR])
def test_a_clock_that_is_set_begins_a_new_segment(step: float) -> None:
    windows, windower = cut(block(np.r_[TEN, TEN + 10 + step]))
    first = [window.new_segment for window in windows]
    assert sum(first) == 1
    assert abs(first.index(True) - len(windows) / 2) <= 1
    assert len(windows) >= 36
    assert abs(windower.account.jumps[0].seconds - step) < 0.1
    told = remarks(windower, len(windows))
    if step < 0:
        assert "the clock steps back by" in told[0]
    elif step > YEAR:
        assert "the clock leaps ahead by 14 years, to 2040" in told[0]
    else:
        assert told == []  # a pause


def test_the_reason_why_no_window_can_be_made_is_reported() -> None:
    short, windower = cut(block(TEN[:50]))
    assert "a window needs 1 s, their longest stretch is 0.49 s" in remarks(windower, len(short))[0]
    still, windower = cut(block(np.zeros(3000)))
    assert "longest stretch is 0 s" in remarks(windower, len(still))[0]
    apart, windower = cut(block(1000.0 * np.arange(400)))
    assert "samples at times of which no others are" in remarks(windower, len(apart))[0]
    whole, windower = cut(block(TEN))
    assert remarks(windower, len(whole)) == []


def test_a_stream_that_leaps_to_and_fro_is_read_in_time() -> None:
    to_and_fro = np.arange(20_000) / 100 + np.where(np.arange(20_000) % 2, 32 * YEAR, 0.0)
    started = time.process_time()
    windows, _ = cut(block(to_and_fro), size=120_000)
    assert time.process_time() - started < 5
    assert all(window.outcome == "repaired" for window in windows)  # of every other sample


def test_a_stream_whose_time_stands_still_stays_small() -> None:
    windower = Windower(CHANNELS, 100.0, 100, 50)
    still = block(np.zeros(100_000))
    tracemalloc.start()
    for _ in range(30):  # 6 million samples, 120 MB
        assert windower.push(still) == []
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 60e6
    assert windower.account.reasons["too many samples for their time"] > 1_000_000


def test_a_record_that_is_nearly_all_gaps_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text("time,a,b\n" + "".join(f"{START // 10**9 + 59 * i},{i % 7},{i % 5}\n" for i in range(3000)))
    with pytest.raises(UnreadableRecording, match=r"too few|come every"):
        load_record(path, CHANNELS, 100.0)


stamps = st.one_of(
    st.integers(EARLIEST, LATEST),
    st.integers(0, 10**12),
    st.integers(0, 3000).map(lambda row: row * 10_000_000),
    st.sampled_from([EARLIEST, 0, 1, START, LATEST]),
)


@settings(max_examples=30, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(
    st.lists(
        st.tuples(stamps, st.integers(1, 150), st.sampled_from([0, 1, 1_000, 9_999_999, 10_000_000, 10**9])),
        max_size=12,
    ),
    st.integers(1, 700),
)
def test_any_times_give_windows_in_time_and_memory(runs: list[tuple[int, int, int]], size: int) -> None:
    """Runs of samples that begin anywhere and go on with any period."""
    times = np.concatenate([begin + step * np.arange(n) for begin, n, step in runs] or [np.zeros(0, dtype=np.int64)])
    times = np.clip(times.astype(np.int64), EARLIEST, LATEST)
    channel = (np.arange(len(times)) % 2).astype(np.int32)
    windows, windower = cut(SampleBlock(times, channel, np.cos(np.arange(len(times)))), size=size)
    for window in windows:
        assert window.values.shape == (100, 2)
        assert EARLIEST <= window.start <= LATEST
    assert all("\n" not in line for line in remarks(windower, len(windows)))
    assert windower.account.lost <= windower.account.expected


def test_a_clock_that_is_set_during_a_ride_is_right_from_then_on(tmp_path: Path) -> None:
    """It began in 1970; what had no date gets the one that is given, and what has one keeps it."""
    path, start, set_at = tmp_path / "ride.csv", 1_795_000_000_000_000_000, 1_790_000_000.0
    times = np.arange(0.0, 4.0, 0.01)
    times[200:] += set_at
    path.write_text("time,x\n" + "".join(f"{time:.2f},{row}\n" for row, time in enumerate(times)))
    channels = [Channel("x", "m/s^2", 0.01, csv="x")]
    recording = open_recording(path, channels, start=start)
    found = np.concatenate([block.time for block in recording.blocks()])
    np.testing.assert_allclose(found[[0, 199]] - start, [0, 1.99e9], atol=1000)
    np.testing.assert_allclose(found[200:] / 1e9, times[200:], atol=1e-6)

"""Plausibility of measured values and time stamps: one bad value costs itself, never a recording.

Readers pass on what is in the file.  For all of them, numbers that are not finite, numbers by which loggers mark a
missing value, and values outside a channel's range become missing (NaN) here; samples with an impossible time stamp are
left out.  Everything is counted and reported per channel.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from sprung.model.signals import BoolArray, Channel, FloatArray, IntArray, SampleBlock
from sprung.model.text import some
from sprung.replay.account import Account

EARLIEST = -86_400 * 1_000_000_000  # ns; times that count from a recording's start may begin a little before 0
LATEST = 1 << 62  # ns, in the year 2116; differences of such times still fit 64 bits
OUT_OF_TIME = "time stamp out of range"
OUT_OF_RANGE = "outside the plausible range"
SMALLEST_SENTINEL = 999.0
SENTINELS = np.array(  # what loggers write for "no value": nines, ends of integer types, fill values of netCDF and HDF
    sorted(
        {sign * (10.0**digits - 1.0) for digits in range(3, 10) for sign in (1, -1)}
        | {float((1 << bits) - 1) for bits in (15, 16, 23, 24, 31, 32)}
        | {-float(1 << bits) for bits in (15, 23, 31)}
        | {-float((1 << bits) - 1) for bits in (15, 31)}
        | {9.969209968386869e36, float(np.float32(9.96921e36)), float(np.finfo(np.float32).max)}
    )
)
RANGES = {  # of channels of rail vehicles if the system file states none; far beyond any instrument
    "m": (-100.0, 100.0),
    "m/s": (-500.0, 500.0),
    "m/s^2": (-5e3, 5e3),
    "rad/s": (-200.0, 200.0),
    "N": (-1e8, 1e8),
    "Pa": (-1e9, 1e9),
}
ANYTHING = (-1e12, 1e12)  # in other units
AMBIGUOUS = ("N", "Pa", "kg")  # units in which a sentinel may be an ordinary value, as it may in counts
FEWEST_ZEROS = 3  # of a channel: one may be chance
MOST_MARKS = 100  # values of a channel that are looked at as marks of a missing value
MARK_APART = 10.0  # mean steps from one sample to the next by which both neighbours of such a value must lie off it
ZERO_APART = 6.0  # usual steps from one sample to the next by which both neighbours of a single 0 must lie off it
STANDS_OUT = 10.0  # median deviations of the other values by which a sentinel must then lie outside them


def plausible_range(channel: Channel) -> tuple[float, float]:
    """Lowest and highest value, in the channel's unit, that is taken for a measured one."""
    return channel.range or RANGES.get(channel.unit, ANYTHING)


def nanoseconds(seconds: FloatArray) -> tuple[IntArray, BoolArray]:
    """Times (T,) in s as ns, and which of them are times at all; the others are 0."""
    with np.errstate(invalid="ignore", over="ignore"):
        scaled = np.round(seconds * 1e9)
        good = (scaled >= EARLIEST) & (scaled <= LATEST)  # False for NaN
    return np.where(good, scaled, 0.0).astype(np.int64), good


class PlausibilityCheck:
    """Checks blocks on their way from a reader, counts findings; `tell` reports them at the end."""

    def __init__(
        self, channels: Sequence[Channel], account: Account, convert: Callable[[SampleBlock], SampleBlock]
    ) -> None:
        """convert: recorded numbers to the channels' units."""
        self._channels = channels
        self._account = account
        self._convert = convert
        limits = np.array([plausible_range(channel) for channel in channels])
        self._low, self._high = limits.reshape(-1, 2).T
        self._ambiguous = np.array([channel.unit in AMBIGUOUS or channel.gain != 1.0 for channel in channels])
        self._bad = np.zeros(len(channels), dtype=np.int64)  # values taken as missing
        self._examples: dict[int, float] = {}  # channel -> the first of them, as recorded
        self._late = 0  # samples without a possible time
        self._twice = np.zeros(len(channels), dtype=np.int64)  # samples that are there twice
        self._zeros = np.zeros(len(channels), dtype=np.int64)  # single values of 0 where they should not be
        self._marks = [Counter[float]() for _ in channels]  # values that came alone and far from their neighbours
        self._first: dict[str, int] = {}  # time of the first of either kind, ns
        self._begun: int | None = None  # ns, the first time

    def check(self, block: SampleBlock) -> SampleBlock:
        """The block in the channels' units, bad values NaN, samples without a possible time left out."""
        timely = (block.time >= EARLIEST) & (block.time <= LATEST)
        if not timely.all():
            self._late += int((~timely).sum())
            self._account.values[OUT_OF_TIME] += int((~timely).sum())
            block = SampleBlock(block.time[timely], block.channel[timely], block.value[timely])
        with np.errstate(invalid="ignore", over="ignore"):
            physical = self._convert(block)
            value, channel = physical.value, physical.channel
            self._repeated(physical)
            bad = (value < self._low[channel]) | (value > self._high[channel])
            if (np.abs(block.value) >= SMALLEST_SENTINEL).any():
                bad |= self._sentinels(block.value, channel)
        if not bad.any():
            return physical
        for index in np.flatnonzero(np.bincount(channel[bad], minlength=len(self._bad))).tolist():
            own = bad & (channel == index)
            self._bad[index] += int(own.sum())
            self._account.values[OUT_OF_RANGE] += int(own.sum())
            self._examples.setdefault(index, float(block.value[np.argmax(own)]))
        return SampleBlock(physical.time, channel, np.where(bad, np.nan, value))

    def _sentinels(self, value: FloatArray, channel: NDArray[np.int32]) -> BoolArray:
        """Which recorded values stand for "no value"."""
        found: BoolArray = np.isin(value, SENTINELS)
        for index in np.unique(channel[found & self._ambiguous[channel]]):
            own = (channel == index) & np.isfinite(value)
            others = value[own & ~found]
            if len(others):
                middle = float(np.median(others))
                spread = float(np.median(np.abs(others - middle)))
                apart = np.abs(value - middle) > STANDS_OUT * max(spread, 1.0)
                found &= ~own | apart
        return found

    def _repeated(self, block: SampleBlock) -> None:
        """Count what would pass in silence: copies of a sample, and values that may stand for a missing one.

        Nothing is changed: a copy says nothing new, a 0 may be one, and a shock may reach the end of an instrument.
        """
        if not len(block.time):
            return
        if self._begun is None:
            self._begun = int(block.time.min())
        order = np.argsort(block.channel.astype(np.int16), kind="stable")  # 10 000 columns at most: sorted by counting
        time, channel, value = block.time[order], block.channel[order], block.value[order]
        same = channel[1:] == channel[:-1]
        twice = same & (time[1:] == time[:-1]) & (value[1:] == value[:-1])
        for index in np.unique(channel[1:][twice]).tolist():
            if np.ptp(value[channel == index]) > 0:  # what never changes is the same at coarse times, too
                own = twice & (channel[1:] == index)
                self._count("twice", self._twice, channel[1:][own], time[1:][own])
        zero = np.flatnonzero((value[1:-1] == 0.0) & same[1:] & same[:-1] & (value[:-2] * value[2:] > 0.0)) + 1
        for index in np.unique(channel[zero]).tolist():
            own = zero[channel[zero] == index]
            steps = np.abs(np.diff(value[channel == index]))
            usual = float(np.median(steps[np.isfinite(steps)]))
            off = np.minimum(np.abs(value[own - 1]), np.abs(value[own + 1])) > ZERO_APART * usual
            self._count("zero", self._zeros, channel[own][off], time[own][off])

        self._marked(channel, value, same)

    def _marked(self, channel: NDArray[np.int32], value: FloatArray, same: BoolArray) -> None:
        """Count values (n,), ordered by channel, that lie alone and far from both neighbours.

        same: (n - 1,), whether a value and the next one are of the same channel.
        """
        step = np.where(same, np.abs(np.diff(value)), np.nan)
        taken = np.isfinite(step)
        sums, counts = (np.bincount(channel[1:][taken], some[taken], len(self._bad)) for some in (step, same))
        far = step > MARK_APART * (sums / np.maximum(counts, 1.0))[channel[1:]]
        alone = (value[1:-1] - value[:-2]) * (value[1:-1] - value[2:]) > 0.0
        for at in (np.flatnonzero(far[1:] & far[:-1] & alone & (value[1:-1] != 0.0)) + 1)[:MOST_MARKS].tolist():
            marks, mark = self._marks[channel[at]], float(value[at])
            if mark in marks or len(marks) < MOST_MARKS:
                marks[mark] += 1

    def _count(self, kind: str, counts: IntArray, channel: NDArray[np.int32], time: IntArray) -> None:
        if len(time):
            counts += np.bincount(channel, minlength=len(counts))
            self._first.setdefault(kind, int(time.min()))

    def _note(self, kind: str, counts: IntArray, least: int, what: str) -> None:
        """One line on all channels that have at least so many."""
        found = np.flatnonzero(counts >= least)
        if len(found):
            names = some([self._channels[index].name for index in found.tolist()], 3)
            after = (self._first[kind] - (self._begun or 0)) / 1e9
            self._account.note(f"{what}: {counts[found].sum()}, the first after {after:.2f} s ({names})")

    def conclude(self) -> None:
        """At the end of the recording."""
        self._note("twice", self._twice, 1, "samples that are there twice")
        self._note("zero", self._zeros, FEWEST_ZEROS, "single values of 0 between others far from it")
        for channel, marks in zip(self._channels, self._marks, strict=True):
            for mark, count in marks.most_common(3):
                if count >= FEWEST_ZEROS and mark not in SENTINELS:
                    self._account.note(
                        f"{channel.name}: {count} single values of {mark:.6g} between others far from it"
                    )
        if self._late:
            self._account.problem(f"{self._late} samples left out: their time stamps are such as no clock shows")
        for index in np.flatnonzero(self._bad).tolist():
            count, channel = int(self._bad[index]), self._channels[index]
            limits = f"{self._low[index]:g} to {self._high[index]:g} {channel.unit}"
            first = f"the first as recorded: {self._examples[index]:.6g}"
            self._account.problem(
                f"{channel.name}: {count} of its values taken as missing, for they mark one or lie"
                f" outside {limits} ({first})"
            )

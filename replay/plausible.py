"""What a measured value and its time stamp can be at all: one bad value costs itself, never a recording.

Readers hand on what is written in the file.  Here, for all of them: numbers that are not finite, numbers by which
loggers mark a missing value, and values outside a channel's range become missing (NaN); samples with a time stamp
that no clock can show are left out.  Everything is counted per channel and told.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from sprung.model.signals import BoolArray, Channel, FloatArray, IntArray, SampleBlock
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
RANGES = {  # what a channel of a rail vehicle can measure when the system file does not say; far beyond any instrument
    "m": (-100.0, 100.0),
    "m/s": (-500.0, 500.0),
    "m/s^2": (-5e3, 5e3),
    "rad/s": (-200.0, 200.0),
    "N": (-1e8, 1e8),
    "Pa": (-1e9, 1e9),
}
ANYTHING = (-1e12, 1e12)  # in other units
AMBIGUOUS = ("N", "Pa", "kg")  # units in which a sentinel may be an ordinary value, as it may in counts
STANDS_OUT = 10.0  # median deviations of the other values by which a sentinel must then lie outside them


def nanoseconds(seconds: FloatArray) -> tuple[IntArray, BoolArray]:
    """Times in s as ns, and which of them are times at all; the others are 0."""
    with np.errstate(invalid="ignore", over="ignore"):
        scaled = np.round(seconds * 1e9)
        good = (scaled >= EARLIEST) & (scaled <= LATEST)  # False for NaN
    return np.where(good, scaled, 0.0).astype(np.int64), good


class Screen:
    """Checks blocks on their way from a reader, counts what it finds; `tell` says so at the end."""

    def __init__(
        self, channels: Sequence[Channel], account: Account, convert: Callable[[SampleBlock], SampleBlock]
    ) -> None:
        """convert: recorded numbers to the channels' units."""
        self._channels = channels
        self._account = account
        self._convert = convert
        limits = np.array([channel.range or RANGES.get(channel.unit, ANYTHING) for channel in channels])
        self._low, self._high = limits.reshape(-1, 2).T
        self._ambiguous = np.array([channel.unit in AMBIGUOUS or channel.gain != 1.0 for channel in channels])
        self._bad = np.zeros(len(channels), dtype=np.int64)  # values taken as missing
        self._examples: dict[int, float] = {}  # channel -> the first of them, as recorded
        self._late = 0  # samples without a possible time

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

    def tell(self) -> None:
        """At the end of the recording."""
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

"""What one should know of a recording before it is used: rates, gaps, ranges, spectra, what stands still or repeats."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from math import comb
from pathlib import Path
from typing import Any

import numpy as np
from cantools.database import Database

from sprung.model.signal_filters import welch
from sprung.model.signals import ANY_TIME, FloatArray, IntArray, TimeColumn
from sprung.replay.account import Account
from sprung.replay.listing import NO_TIME, signals_of
from sprung.replay.recording import open_recording
from sprung.replay.sampling import LOST, sampling_clock

MOST_SAMPLES = 40_000_000  # of all channels together that are kept; of longer recordings the first part is looked at
GAP = 2.5  # periods without a sample
STILL_SECONDS, STILL_SHARE = 1.0, 0.005  # least length of a standstill; range in it over that of the whole channel
MOST_STILL = 20  # stretches that are listed
MOST_LEVELS = 20_000  # samples in which the resolution is looked for
ORDER = 4  # order of the differences for the noise level
BAND = (0.05, 0.95)  # shares of the power below the ends of the band


@dataclass(slots=True)
class Signal:
    """One signal of a recording; times in s from the recording's first sample."""

    name: str
    address: dict[str, str]  # mcap, can or column
    unit: str | None  # as the file states it
    samples: int
    missing: int  # samples without a valid value
    start: float = 0.0
    end: float = 0.0
    rate: float | None = None  # Hz
    jitter: float | None = None  # standard deviation of the time stamps about an even clock, periods
    minimum: float | None = None
    maximum: float | None = None
    mean: float | None = None
    deviation: float | None = None  # standard deviation
    noise: float | None = None  # largest standard deviation of white noise that its fourth differences allow
    band: tuple[float, float] | None = None  # Hz between which 90 % of the power about the mean lie
    peak: float | None = None  # Hz, where the spectrum is highest
    gaps: int = 0
    lost: int = 0  # samples, where their times show it
    longest_gap: float = 0.0  # s
    duplicate_times: int = 0  # samples at the time of the one before
    standstill: list[tuple[float, float]] = field(default_factory=list)
    constant: bool = False
    rising: bool = False  # in equal steps, so perhaps a time
    same_as: str | None = None  # another signal with the same values; with a minus sign when they are reversed


@dataclass(slots=True)
class Inspection:
    """All of a recording."""

    file: str
    start: int | None  # of the first sample, ns since 1970
    relative: bool  # its times count from a start of their own
    seconds: float
    vehicle: str | None
    signals: list[Signal]
    problems: list[str]
    incomplete: bool


def inspect(path: Path, dbc: str | Path | Database | None = None, time: TimeColumn = ANY_TIME) -> Inspection:
    """Read a recording and look at every signal; raises UnreadableRecording."""
    listing = signals_of(path, dbc, time)
    listed = listing.signals
    channels = [channel for channel, _ in listed]
    recording = open_recording(path, channels, dbc=dbc, time=listing.time)
    for line in listing.notes:
        recording.account.note(line)
    stamps, values = _collect(recording.blocks(), len(channels), recording.account)
    seen = [t for t in stamps if len(t)]
    first = min(int(t.min()) for t in seen)
    last = max(int(t.max()) for t in seen)
    signals = [
        look(channel.name, _address(channel), unit, stamps[i], values[i], first)
        for i, (channel, unit) in enumerate(listed)
    ]
    _find_same(signals, {c.name: v for c, v in zip(channels, values, strict=True)})
    account = recording.account
    if NO_TIME in account.problems:
        rising = [signal.name for signal in signals if signal.rising]
        if rising:
            account.note(f"evenly rising, so perhaps a time: {', '.join(rising[:8])}")
    problems = [line for line in account.problems if not line.startswith("no values of ")]
    relative = account.relative
    return Inspection(
        str(path), first, relative, (last - first) / 1e9, account.vehicle, signals, problems, account.incomplete
    )


def _collect(blocks: Any, channels: int, account: Account) -> tuple[list[IntArray], list[FloatArray]]:
    """Times and values of every channel, in order of time."""
    time: list[list[IntArray]] = [[] for _ in range(channels)]
    value: list[list[FloatArray]] = [[] for _ in range(channels)]
    total = 0
    for block in blocks:
        total += len(block.time)
        order = np.argsort(block.channel, kind="stable")
        cuts = np.searchsorted(block.channel[order], np.arange(channels + 1))
        for i in range(channels):
            own = order[cuts[i] : cuts[i + 1]]
            if len(own):
                time[i].append(block.time[own])
                value[i].append(block.value[own])
        if total > MOST_SAMPLES:
            account.note(f"only the first {total} samples were looked at")
            break
    stamps, values = [], []
    for t, v in zip(time, value, strict=True):
        joined = np.concatenate(t) if t else np.zeros(0, dtype=np.int64)
        order = np.argsort(joined, kind="stable")
        stamps.append(joined[order])
        values.append((np.concatenate(v) if v else np.zeros(0))[order])
    return stamps, values


def look(name: str, address: dict[str, str], unit: str | None, time: IntArray, value: FloatArray, first: int) -> Signal:
    """One signal (T,); time in ns, sorted."""
    good = np.isfinite(value)
    signal = Signal(name, address, unit, len(value), int((~good).sum()))
    if not good.any():
        return signal
    time, value = time[good], value[good]
    elapsed = (time - first) / 1e9
    signal.start, signal.end = float(elapsed[0]), float(elapsed[-1])
    signal.minimum, signal.maximum = float(value.min()), float(value.max())
    signal.mean, signal.deviation = float(value.mean()), float(value.std())
    signal.constant = signal.minimum == signal.maximum
    signal.rising = _rises_evenly(value)
    steps = np.diff(elapsed)
    signal.duplicate_times = int((steps <= 0).sum())
    found = sampling_clock(time)
    if found is None:
        return signal
    period, jitter = found.period, found.jitter
    counted = _counted_clock(elapsed)
    if counted is not None and not jitter < counted[1] + LOST:  # stamps leave an even clock where samples are missing
        period, jitter, signal.lost = counted
    signal.rate = 1.0 / period
    signal.jitter = jitter if np.isfinite(jitter) else None
    wide = steps > GAP * period
    signal.gaps, signal.longest_gap = int(wide.sum()), float(steps[wide].max()) if wide.any() else 0.0
    stretch = _longest(wide)
    _spectrum(signal, value[stretch])
    signal.standstill = _standstill(elapsed, value, period, signal.noise or 0.0)
    return signal


def _counted_clock(elapsed: FloatArray) -> tuple[float, float, int] | None:
    """Period, s, scatter about it in periods, and lost samples of stamps (T,) whose usual step tells how many are lost.

    None where none are, or where the steps are no multiples of a usual one.
    """
    steps = np.diff(elapsed)
    usual = float(np.median(steps)) if len(steps) else 0.0
    if not usual > 0.0:
        return None
    number = np.r_[0, np.cumsum(np.maximum(np.rint(steps / usual), 1.0))]
    lost = int(number[-1]) - len(steps)
    period, start = (float(c) for c in np.polyfit(number, elapsed, 1))
    scatter = float(np.std(elapsed - start - period * number)) / period
    return (period, scatter, lost) if lost and scatter < LOST else None


def _rises_evenly(value: FloatArray) -> bool:
    """Whether a series may be a time: equal steps upwards."""
    steps = np.diff(value)
    return len(steps) > 8 and bool(steps.min() > 0) and bool(np.ptp(steps) < 0.01 * steps.mean())


def _longest(cut: np.ndarray) -> slice:
    """The longest stretch between the cuts."""
    edges = np.r_[-1, np.flatnonzero(cut), len(cut)]
    longest = int(np.argmax(np.diff(edges)))
    return slice(int(edges[longest]) + 1, int(edges[longest + 1]) + 1)


def _spectrum(signal: Signal, value: FloatArray) -> None:
    """Noise, band and peak of an even stretch."""
    if len(value) < 64 or signal.constant or signal.rate is None:
        return
    differences = np.diff(value, ORDER)
    steps = np.diff(np.unique(value[:MOST_LEVELS]))
    rounding = float(steps.min()) / np.sqrt(12) if len(steps) else 0.0
    signal.noise = max(float(np.median(np.abs(differences)) / 0.6745 / np.sqrt(comb(2 * ORDER, ORDER))), rounding)
    frequency, power = welch(value - value.mean(), fs=signal.rate, nperseg=min(len(value), 4096), detrend="linear")
    total = np.cumsum(power[1:])
    if not total[-1] > 0:
        return
    low, high = (float(frequency[1:][np.searchsorted(total, share * total[-1])]) for share in BAND)
    signal.band = (low, high)
    signal.peak = float(frequency[1:][np.argmax(power[1:])])


def _standstill(elapsed: FloatArray, value: FloatArray, period: float, noise: float) -> list[tuple[float, float]]:
    """Stretches in which the signal hardly moves compared with the rest."""
    width = max(int(STILL_SECONDS / period), 8)
    blocks = len(value) // width
    whole = float(np.ptp(value))
    if blocks < 3 or whole == 0.0:
        return []
    cut = value[: blocks * width].reshape(blocks, width)
    still = np.ptp(cut, axis=1) <= max(STILL_SHARE * whole, min(8.0 * noise, 4 * STILL_SHARE * whole))
    edges = np.flatnonzero(np.diff(np.r_[False, still, False].astype(np.int8)))
    found = [
        (round(float(elapsed[a * width]), 3), round(float(elapsed[b * width - 1]), 3))
        for a, b in zip(edges[::2], edges[1::2], strict=True)
    ]
    return sorted(sorted(found, key=lambda stretch: stretch[0] - stretch[1])[:MOST_STILL])


def _find_same(signals: Sequence[Signal], values: dict[str, FloatArray]) -> None:
    """Signals that repeat an earlier one, as they are or reversed."""
    earlier: dict[tuple[int, bytes], str] = {}
    for signal in signals:
        value = values[signal.name]
        if signal.constant or len(value) < 16:
            continue
        for sign, mark in ((1.0, ""), (-1.0, "-")):
            key = (len(value), (sign * value + 0.0).tobytes())
            if key in earlier:
                signal.same_as = f"{mark}{earlier[key]}"
                break
        earlier.setdefault((len(value), (value + 0.0).tobytes()), signal.name)


def _address(channel: Any) -> dict[str, str]:
    return {key: name for key in ("mcap", "can", "column") if (name := getattr(channel, key)) is not None}

"""Rates of recorded channels relative to the grid: fast channels are decimated, wrong units of time are reported.

A channel at about twice the grid's rate or more goes through a linear-phase FIR low pass that is centred on its
samples (zero phase), computed only where samples are wanted (polyphase; Crochiere and Rabiner, Multirate Digital
Signal Processing, 1983, ch. 3): flat to 0.4 of the grid's rate, -80 dB from 0.5.  Channels at other rates pass
unchanged; the grid resamples them (`replay.grid`).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import lru_cache
from itertools import chain
from pathlib import Path

import numpy as np
from scipy.ndimage import median_filter

from sprung.model.signal_filters import low_pass, upfirdn
from sprung.model.signals import Channel, FloatArray, IntArray, SampleBlock
from sprung.replay.account import Account, UnreadableRecording
from sprung.replay.grid import SLOWEST

PASS, STOP, ATTENUATION = 0.4, 0.5, 80.0  # shares of the grid's rate; dB
FASTER = 1.9  # times the grid's rate from which a channel is reduced
PROBE_SECONDS, PROBE_SAMPLES, PROBE_LIMIT = 3.0, 32, 500_000  # s, samples of each channel, of all together
LONGEST_BRIDGE = 8  # own samples in a row that are interpolated before the filter; more begin a new stretch
JITTER = 3.0  # periods, standard deviation of the stamps about an even clock, above which there is none
LOST = 0.35  # periods by which the stamps leave an even clock for long when a sample is missing
SMOOTH = 33  # samples of the median for it
MOST_FASTER = 100_000  # times the grid's rate that a channel may be: the filter has some 50 taps for each
MOST_UP = 16  # of a rational ratio
LATE = 64  # own samples that may come out of order
SILENT = 5.0  # s after which the others no longer wait for a fast channel
NEVER = np.iinfo(np.int64).min


@dataclass(frozen=True, slots=True)
class SamplingClock:
    """How a channel samples."""

    period: float  # s
    jitter: float  # standard deviation of its stamps about an even clock, periods


def sampling_clock(time: IntArray) -> SamplingClock | None:
    """The sampling clock of sorted times (T,), ns, in the longest stretch without gaps; None with too few of them."""
    steps = np.diff(time).astype(np.float64) / 1e9
    if len(steps) < 3 or not steps.any():
        return None
    typical = steps
    for _ in range(3):
        typical = typical[typical <= 5.0 * typical.mean()]
    cuts = np.r_[-1, np.flatnonzero(steps > 8.0 * typical.mean()), len(steps)]
    longest = int(np.argmax(np.diff(cuts)))
    run = time[cuts[longest] + 1 : cuts[longest + 1] + 1]
    if len(run) < 4:
        return SamplingClock(float(typical.mean()), np.inf)
    elapsed = (run - run[0]) / 1e9
    count = np.arange(len(run))
    slope, start = np.polyfit(count, elapsed, 1)
    if not slope > 0:
        return None
    return SamplingClock(float(slope), float(np.std(elapsed - start - slope * count) / slope))


def at_rate(
    blocks: Iterable[SampleBlock],
    channels: Sequence[Channel],
    sample_rate: float,
    account: Account,
    path: Path,
) -> Iterator[SampleBlock]:
    """The samples, fast channels decimated to the grid's rate, with a note in the account.

    Errors: UnreadableRecording when every channel is much slower than the grid, or far faster.
    """
    source = iter(blocks)
    held: list[SampleBlock] = []
    for block in source:
        held.append(block)
        if _probed(held, len(channels)):
            break
    if not held:
        return
    clocks = _clocks(held, len(channels))
    _refuse_far_off(clocks, channels, sample_rate, account, path)
    fast = {index for index, found in clocks.items() if _far_faster(found, sample_rate)}
    if fast:
        left = [index for index in range(len(channels)) if index not in fast]
        chosen = (_chosen(block, np.isin(block.channel, left)) for block in chain(held, source))
        held, source = [], (block for block in chosen if len(block.time))
    reducers = {
        index: Reducer(found.period, sample_rate)
        for index, found in clocks.items()
        if index not in fast and found.period * sample_rate * FASTER <= 1.0 and found.jitter < JITTER
    }
    if not reducers:
        yield from held
        yield from source
        return
    _note_rates(reducers, channels, sample_rate, account)
    stage = _Stage(reducers)
    for block in held:
        yield from stage.push(block)
    for block in source:
        yield from stage.push(block)
    yield from stage.flush()


def _probed(held: list[SampleBlock], channels: int) -> bool:
    """Whether enough samples have arrived to estimate the rates."""
    total = sum(len(block.time) for block in held)
    if total >= PROBE_LIMIT:
        return True
    first = min(int(block.time.min()) for block in held if len(block.time))
    last = max(int(block.time.max()) for block in held if len(block.time))
    if last - first < PROBE_SECONDS * 1e9:
        return False
    counts = np.sum([np.bincount(block.channel, minlength=channels) for block in held], axis=0)
    return bool((counts[counts > 0] >= PROBE_SAMPLES).all())


def _clocks(held: list[SampleBlock], channels: int) -> dict[int, SamplingClock]:
    time = np.concatenate([block.time for block in held])
    channel = np.concatenate([block.channel for block in held])
    found = {index: sampling_clock(np.sort(time[channel == index])) for index in range(channels)}
    return {index: one for index, one in found.items() if one is not None}


def _far_faster(clock: SamplingClock, sample_rate: float) -> bool:
    """Whether a channel is too fast to be reduced to the grid's rate."""
    return clock.period * sample_rate * MOST_FASTER < 1.0 and clock.jitter < JITTER


def _refuse_far_off(
    clocks: dict[int, SamplingClock], channels: Sequence[Channel], sample_rate: float, account: Account, path: Path
) -> None:
    """Complain about channels that are too slow for the grid, or far too fast; refuse when all are."""
    slow = {i: one for i, one in clocks.items() if one.period * sample_rate > 1.0 / (SLOWEST * 0.98)}
    fast = {i: one for i, one in clocks.items() if _far_faster(one, sample_rate)}
    if len(slow) + len(fast) < len(clocks) or not clocks:
        for which, limit in ((slow, "slower than half of"), (fast, f"more than {MOST_FASTER} times faster than")):
            if which:
                names = ", ".join(channels[i].name for i in list(which)[:5])
                rate = 1 / min(one.period for one in which.values())
                account.note(f"{limit} {sample_rate:g} Hz, so left out: {names} ({rate:.3g} Hz)")
        return
    period = min(one.period for one in (slow or fast).values())
    hint = next(
        (f"if its times are in {unit}, set `time: {{unit: {unit}}}` in the system file; else " for unit, seconds in
         (("ms", 1e-3), ("us", 1e-6), ("ns", 1e-9)) if 0.2 < period * seconds * sample_rate < 200.0), "")  # fmt: skip
    if not slow:
        hint = "if its times are in another unit, set `time: {unit: ...}` in the system file; else "
    raise UnreadableRecording(
        f"{path}: its samples come every {period:.4g} s, the system file has sample_rate: {sample_rate:g} Hz; "
        f"{hint}set sample_rate to {1 / period:.3g}"
    )


def _note_rates(
    reducers: dict[int, Reducer], channels: Sequence[Channel], sample_rate: float, account: Account
) -> None:
    by_rate: dict[str, list[str]] = {}
    for index, reducer in reducers.items():
        by_rate.setdefault(f"{1 / reducer.period:.4g}", []).append(channels[index].name)
    for rate, names in by_rate.items():
        which = names[0] if len(names) == 1 else f"{len(names)} channels"
        account.note(
            f"{which}: {rate} Hz reduced to {sample_rate:g} Hz (linear-phase FIR, flat to {PASS * sample_rate:g} Hz, "
            f"-{ATTENUATION:g} dB from {STOP * sample_rate:g} Hz)"
        )


class _Stage:
    """Reduces some channels and keeps all of them in order of time.

    A filter needs samples on either side, so what comes before the first output and after the last one is left out
    for the other channels, too.
    """

    def __init__(self, reducers: dict[int, Reducer]) -> None:
        self.reducers = reducers
        self.reduced = np.array(sorted(reducers), dtype=np.int32)
        self.waiting: list[SampleBlock] = []  # passed unchanged or reduced, not yet handed out
        self.heard = dict.fromkeys(reducers, NEVER)  # time of the newest sample of each, ns
        self.begun = False

    def push(self, block: SampleBlock) -> Iterator[SampleBlock]:
        """What can be handed out now."""
        mine = np.isin(block.channel, self.reduced)
        if not mine.all():
            self.waiting.append(_chosen(block, ~mine))
        for index in np.unique(block.channel[mine]).tolist():
            own = block.channel == index
            self.heard[index] = max(self.heard[index], int(block.time[own].max()))
            self._add(index, self.reducers[index].push(block.time[own], block.value[own]))
        newest = max(self.heard.values())
        alive = [r.done for i, r in self.reducers.items() if self.heard[i] > newest - SILENT * 1e9]
        if alive and min(alive) > NEVER:
            yield from self._ready(min(alive))

    def flush(self) -> Iterator[SampleBlock]:
        """At the end of the recording."""
        for index, reducer in self.reducers.items():
            self._add(index, reducer.flush())
        yield from self._ready(max(reducer.done for reducer in self.reducers.values()))

    def _add(self, index: int, piece: tuple[IntArray, FloatArray]) -> None:
        time, value = piece
        if len(time):
            self.waiting.append(SampleBlock(time, np.full(len(time), index, dtype=np.int32), value))

    def _ready(self, horizon: int) -> Iterator[SampleBlock]:
        """Everything up to a time, in order."""
        if not self.waiting:
            return
        whole = SampleBlock(
            np.concatenate([block.time for block in self.waiting]),
            np.concatenate([block.channel for block in self.waiting]),
            np.concatenate([block.value for block in self.waiting]),
        )
        if not self.begun:
            self.begun = True
            reduced = np.isin(whole.channel, self.reduced)
            whole = _chosen(whole, whole.time >= whole.time[reduced].min(initial=horizon))
        now = whole.time <= horizon
        self.waiting = [] if now.all() else [_chosen(whole, ~now)]
        if now.any():
            out = _chosen(whole, now)
            order = np.argsort(out.time, kind="stable")
            yield SampleBlock(out.time[order], out.channel[order], out.value[order])


def _chosen(block: SampleBlock, which: np.ndarray) -> SampleBlock:
    return SampleBlock(block.time[which], block.channel[which], block.value[which])


@lru_cache(maxsize=16)
def anti_alias_taps(up: int, down: int, own_over_grid: float) -> FloatArray:
    """The taps (2 h + 1,) at `up` times a channel's own rate, centred; h is a multiple of `down`."""
    taps = low_pass(PASS, STOP, ATTENUATION, up * own_over_grid, multiple=down)  # in grid rates
    return np.asarray(taps * up, dtype=np.float64)


class Reducer:
    """One fast channel: samples in, samples at about the grid's rate out, with the times of their centres."""

    def __init__(self, period: float, sample_rate: float) -> None:
        """period: of the channel, s."""
        self.period = period
        ratio = Fraction(period * sample_rate).limit_denominator(10_000)
        near = next((f for n in range(1, MOST_UP + 1) if (f := _near(period * sample_rate, n)) is not None), None)
        self.up, self.down = (near.numerator, near.denominator) if near else (1, int(1 / ratio))
        self.taps = anti_alias_taps(self.up, self.down, float(f"{1 / (period * sample_rate):.6g}"))
        self.half = len(self.taps) // 2  # at `up` times the own rate
        self.reach = -(-self.half // self.up)  # own samples on either side of an output
        self.done = NEVER  # nothing before this time (ns) will come any more
        self._waiting: list[tuple[IntArray, FloatArray]] = []
        self._count = 0
        self._origin = 0  # ns; begin of the stretch that is being filtered
        self._even = np.zeros(0)  # its samples on the channel's own steps
        self._missing = np.zeros(0, dtype=bool)
        self._stamps = np.zeros(0)  # s after the origin
        self._next = 0  # output that comes next: its centre is own sample `_next` down / up of `_even`

    def push(self, time: IntArray, value: FloatArray) -> tuple[IntArray, FloatArray]:
        """Times (ns) and values of the outputs that are complete."""
        self._waiting.append((time, value))
        self._count += len(time)
        if self._count < 8 * self.reach:
            return _nothing()
        return self._work(LATE)

    def flush(self) -> tuple[IntArray, FloatArray]:
        """The remaining samples, at the end."""
        return self._work(0)

    def _work(self, behind: int) -> tuple[IntArray, FloatArray]:
        """All but the last `behind` samples, before which late ones may still come."""
        time = np.concatenate([np.zeros(0, dtype=np.int64), *(t for t, _ in self._waiting)])
        value = np.concatenate([np.zeros(0), *(v for _, v in self._waiting)])
        order = np.argsort(time, kind="stable")
        time, value = time[order], value[order]
        keep = max(len(time) - behind, 0)
        self._waiting, self._count = [(time[keep:], value[keep:])], len(time) - keep
        time, value = time[:keep], value[:keep]
        longest = (LONGEST_BRIDGE + 1.5) * max(self.period, 0.0) * 1e9
        before = self._origin + round(float(self._stamps[-1]) * 1e9) if len(self._stamps) else None
        steps = np.diff(time, prepend=time[:1] if before is None else before)
        out: list[tuple[IntArray, FloatArray]] = []
        cuts = np.flatnonzero(np.abs(steps) > longest)
        for i, (t, v) in enumerate(zip(np.split(time, cuts), np.split(value, cuts), strict=True)):
            if i:  # a gap: what lies before it cannot be filtered with what lies after it
                self._even, self._missing, self._stamps = np.zeros(0), np.zeros(0, dtype=bool), np.zeros(0)
            if len(t):
                self._append(t, v)
                out.append(self._outputs())
        return np.concatenate([_nothing()[0], *(t for t, _ in out)]), np.concatenate(
            [np.zeros(0), *(v for _, v in out)]
        )

    def _append(self, time: IntArray, value: FloatArray) -> None:
        """Put samples on the channel's own even steps."""
        begins = not len(self._even)
        if begins:
            self._origin = int(time[0])
            self._next = -(-self.reach * self.up // self.down)
        stamps = (time - self._origin) / 1e9
        before = float(stamps[0]) - self.period if begins else float(self._stamps[-1])
        place, stamps, value = self._places(before, stamps, value)
        if not len(place):
            return
        size = int(place[-1]) + 1
        even = np.full(size, np.nan)
        even[place] = value
        at = np.interp(np.arange(size), place, stamps)
        missing = np.isnan(even)
        if missing.all():
            even[:] = 0.0
        elif missing.any():
            rows = np.arange(size)
            even[missing] = np.interp(rows[missing], rows[~missing], even[~missing])
        self._even = np.concatenate([self._even, even])
        self._missing = np.concatenate([self._missing, missing])
        self._stamps = np.concatenate([self._stamps, at])

    def _places(self, before: float, stamps: FloatArray, value: FloatArray) -> tuple[IntArray, FloatArray, FloatArray]:
        """On which own step after the last one each sample lies; with its smoothed stamp and its value."""
        count = np.arange(len(stamps))
        if len(stamps) >= 2 * SMOOTH:
            slope, start = np.polyfit(count, stamps, 1)
            apart = (stamps - start - slope * count) / max(slope, 1e-12)
            apart = median_filter(apart, SMOOTH, mode="reflect")
            if np.abs(apart).max() < LOST + _rounding(stamps) / self.period and slope < 1.5 * self.period:
                self.period = float(slope)
                lead = max(round((start - before) / slope) - 1, 0)
                return count + lead, start + slope * count, value
        steps = np.diff(stamps, prepend=before) / self.period
        even = float(np.median(np.abs(steps - np.rint(steps)))) < 0.25
        place = np.cumsum(np.rint(steps)) - 1 if even else np.rint((stamps - before) / self.period) - 1
        place = place.astype(np.int64)
        first = np.diff(np.maximum.accumulate(place), prepend=-1) > 0
        return place[first], stamps[first], value[first]

    def _outputs(self) -> tuple[IntArray, FloatArray]:
        """Outputs whose whole filter lies within the stretch."""
        size = len(self._even)
        last = (size - 1 - self.reach) * self.up // self.down
        k = np.arange(self._next, last + 1)
        if not len(k):
            return _nothing()
        value = upfirdn(self.taps, self._even, self.up, self.down)[k + self.half // self.down]
        centre = k * (self.down / self.up)
        near = np.rint(centre).astype(np.int64)
        width = max(1, self.down // (2 * self.up))
        gone = np.r_[0, np.cumsum(self._missing)]
        value[gone[np.minimum(near + width, size)] - gone[np.maximum(near - width, 0)] > width] = np.nan
        elapsed = np.interp(centre, np.arange(size), self._stamps)
        time = self._origin + np.rint(elapsed * 1e9).astype(np.int64)
        self._next = int(k[-1]) + 1
        drop = max((self._next * self.down // self.up - self.reach - 1) // self.down * self.down, 0)
        self._next -= drop * self.up // self.down
        self._even, self._missing, self._stamps = self._even[drop:], self._missing[drop:], self._stamps[drop:]
        self.done = int(time[-1])
        return time, value


def _rounding(stamps: FloatArray) -> float:
    """Half the resolution of stamps (s) of which several are equal; 0 when all differ."""
    steps = np.diff(stamps)
    later = steps[steps > 1e-9]
    return 0.5 * float(later.min()) if len(later) and (steps <= 1e-9).any() else 0.0


def _near(ratio: float, numerator: int) -> Fraction | None:
    """The ratio as numerator over a whole number, when it is that to a ten-thousandth."""
    denominator = round(numerator / ratio)
    return Fraction(numerator, denominator) if abs(numerator / denominator / ratio - 1.0) < 1e-4 else None


def _nothing() -> tuple[IntArray, FloatArray]:
    return np.zeros(0, dtype=np.int64), np.zeros(0)

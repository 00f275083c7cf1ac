"""Streams of samples to windows on one even grid."""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from sprung.model.signals import BoolArray, Channel, FloatArray, IntArray, SampleBlock, Window
from sprung.replay.grid import REACH, SLOWEST, GridSamples, Resampled, by_count, fill, place, resample, uneven
from sprung.replay.stream import ClockJump, Reorderer

FOLLOW = 0.1  # of a period: common phase of the samples beyond which the grid follows them
MOST_WINDOWS = 64  # that are made together
MOSTLY_THERE = 0.2  # share of missing samples above which a channel is looked at as one of a lower rate, or is absent
COHERENT = 0.5  # mean resultant length of the phases above which they have a common phase
KEPT_JUMPS = 1000
MOST_RATE = 100  # times the grid's rate: a stream of more samples than all channels give at this one stands still
FEWEST_KEPT = 1_000_000  # samples that may wait in any case


@dataclass(slots=True)
class StreamAccount:
    """Counts of a stream of samples and the windows made of it."""

    reasons: Counter[str] = field(default_factory=Counter)  # windows repaired or dropped, samples dropped, by reason
    jumps: list[ClockJump] = field(default_factory=list)  # of the clock, and pauses; the first ones
    samples: int = 0  # that belonged to the stream
    longest: float = 0.0  # s, the longest stretch of samples without a jump
    recorded: float = 0.0  # s, of all stretches, from the first sample of each to the end of its last one
    expected: int = 0  # samples that the emitted windows should hold, each counted once
    lost: int = 0  # of these, samples that did not come or were invalid


class Windower:
    """Samples in, whole, repaired or dropped windows out, each once and in order.

    The grid begins at the first sample; windows start every `hop` samples.  The result depends on the samples and
    their order only, not on how they are cut into blocks.  A window is emitted once the stream is `delay` past its
    end.  Memory: one window, the delay and the pause that is still waited for.
    """

    def __init__(
        self,
        channels: Sequence[Channel],
        sample_rate: float,
        window: int,
        hop: int | None = None,
        *,
        needed: Sequence[frozenset[str]] = (),
        longest_gap: int = 2,
        largest_share: float = 0.03,
        delay: float = 0.5,
        pause: float = 5.0,
        stamped: bool = False,
    ) -> None:
        """`needed`: sets of channels, of each of which a window must hold one; other channels may be absent.
        `longest_gap` consecutive samples and `largest_share` of a window's samples may be repaired; `delay`: s that
        samples may come out of order; `pause`: s of silence after which the grid starts anew; `stamped`: times are
        those of sampling, not of arrival, so that uneven ones can be interpolated between."""
        if window < 4 or not sample_rate > 0:
            raise ValueError(f"a window needs at least 4 samples and a positive rate, not {window} at {sample_rate}")
        self.channels = tuple(channels)
        self.needed = [np.array([channel.name in names for channel in self.channels]) for names in needed]  # each (C,)
        self.wanted: BoolArray = np.any(self.needed, axis=0) if needed else np.zeros(len(self.channels), dtype=bool)
        self.sample_rate, self.window = float(sample_rate), int(window)
        self.hop = int(hop) if hop else max(self.window // 2, 1)
        self.longest_gap, self.largest_share = longest_gap, largest_share
        self.delay, self.pause, self.stamped = delay, pause, stamped
        self.order = Reorderer(delay, pause, confirm=max(8, 2 * len(self.channels)))
        self.account = StreamAccount()
        self._period = 1e9 / self.sample_rate  # ns
        rows = self.window + (delay + pause) * self.sample_rate
        self._most = max(FEWEST_KEPT, int(MOST_RATE * rows * len(self.channels)))  # samples in `_pending`
        self._pending: list[SampleBlock] = []
        self._waiting = 0  # samples in `_pending`
        self._base = 0  # ns since epoch: the grid's first sample.  Floats hold differences to it only, because a
        self._origin: float | None = None  # float of an absolute time is 256 ns coarse.  ns of the next window's row 0
        self._stretch: tuple[int, int] | None = None  # ns, first and newest time of the stretch without a jump
        self._overlap = (0, 0)  # samples and lost samples of the last window that the next one shares
        self._first_row = True  # the next window is the first of its grid: nothing lies before it
        self._new_segment = False  # the next window is the first after a jump

    def push(self, block: SampleBlock) -> list[Window]:
        """Windows that this block completed."""
        out: list[Window] = []
        for piece in self.order.push(block):
            if isinstance(piece, ClockJump):
                out += self._finish()
                self._end_stretch()
                self.account.reasons["clock jump" if piece.seconds < 0 else "pause or clock jump"] += 1
                self._new_segment = True
                if len(self.account.jumps) < KEPT_JUMPS:
                    self.account.jumps.append(piece)
                continue
            self._pending.append(piece)
            self._waiting += len(piece.time)
            self.account.samples += len(piece.time)
            if self._origin is None:
                self._base, self._origin = int(piece.time[0]), 0.0
            begun, newest = self._stretch or (int(piece.time[0]),) * 2
            self._stretch = begun, max(newest, int(piece.time.max()))
            if self._waiting > self._most:  # time stands still, or nearly
                self.account.reasons["too many samples for their time"] += self._waiting
                self._forget_all()
        if self._origin is not None and self.order.newest is not None:
            horizon = self.order.newest - self._base - self.delay * 1e9
            rows = int(np.floor((horizon - self._origin) / self._period)) - REACH
            out += self._emit(rows, ended=False)
        return out

    def flush(self) -> list[Window]:
        """At the end of the stream: the windows that are still whole."""
        self.order.flush()
        self.account.reasons.update(self.order.counts)
        self.order.counts.clear()
        self._end_stretch()
        return self._finish()

    def _end_stretch(self) -> None:
        if self._stretch is not None:
            begun, newest = self._stretch
            self.account.longest = max(self.account.longest, (newest - begun) / 1e9)
            self.account.recorded += (newest - begun + self._period) / 1e9
        self._stretch = None

    def _finish(self) -> list[Window]:
        """Emit the windows of the current grid and reset it."""
        out: list[Window] = []
        if self._origin is not None and any(len(block.time) for block in self._pending):
            last = max(int(block.time.max()) for block in self._pending if len(block.time)) - self._base
            rows = int(np.rint((last - self._origin) / self._period)) + 1
            out = self._emit(rows, ended=True)
        self.account.expected += self._overlap[0]
        self.account.lost += self._overlap[1]
        self._forget_all()
        return out

    def _forget_all(self) -> None:
        self._pending, self._waiting = [], 0
        self._origin, self._first_row, self._overlap = None, True, (0, 0)

    def _emit(self, rows: int, *, ended: bool) -> list[Window]:
        """All windows within the next `rows` rows; the grid follows the samples' phase from window to window."""
        out: list[Window] = []
        while (count := (rows - self.window) // self.hop + 1) > 0 and self._origin is not None:
            count = min(count, MOST_WINDOWS)
            samples = self._gather()
            beyond = rows - (count - 1) * self.hop - self.window
            batch = _Batch(self, samples, count, after=min(beyond, REACH) if ended else REACH)
            moved = batch.first_out_of_phase()
            for index in range(count if moved is None else moved):
                window = batch.window(index)
                out.append(replace(window, new_segment=True) if self._new_segment else window)
                self._new_segment = False
            done = count if moved is None else moved
            self._origin += done * self.hop * self._period
            rows -= done * self.hop
            if moved is not None:
                self._origin += batch.phase[moved] * self._period
            self._first_row = self._first_row and done == 0
            self._forget(samples)
        return out

    def _count(self, gone: BoolArray) -> None:
        """Count every sample once: a window answers for its first `hop` rows, the last one for all of them."""
        self.account.expected += gone[: self.hop].size
        self.account.lost += int(gone[: self.hop].sum())
        self._overlap = (gone[self.hop :].size, int(gone[self.hop :].sum()))

    def _gather(self) -> SampleBlock:
        if len(self._pending) > 1:
            self._pending = [
                SampleBlock(
                    np.concatenate([block.time for block in self._pending]),
                    np.concatenate([block.channel for block in self._pending]),
                    np.concatenate([block.value for block in self._pending]),
                )
            ]
        return self._pending[0]

    def _forget(self, samples: SampleBlock) -> None:
        oldest = (self._origin or 0.0) - (REACH + 2) * self._period
        keep = samples.time - self._base >= oldest
        self._pending = [SampleBlock(samples.time[keep], samples.channel[keep], samples.value[keep])]
        self._waiting = int(keep.sum())


class _Batch:
    """Several consecutive windows at once: everything that can be done for all of them together."""

    def __init__(self, owner: Windower, samples: SampleBlock, count: int, after: int) -> None:
        self.owner = owner
        self.count = count
        self.before = 0 if owner._first_row else REACH
        self.rows = self.before + (count - 1) * owner.hop + owner.window + after
        self.origin = owner._origin or 0.0
        elapsed = samples.time - owner._base
        self.offset: FloatArray = np.asarray((elapsed - self.origin) / owner._period + self.before, dtype=np.float64)
        self.samples = samples
        channels = len(owner.channels)
        self.placed: GridSamples = place(self.offset, samples.channel, samples.value, self.rows, channels)
        self.starts = self.before + owner.hop * np.arange(count)
        self.ends = self.starts + owner.window
        self.filled = fill(self.placed.value, owner.longest_gap)
        missing = np.isnan(self.placed.value)
        self.missing = self._per_window(missing)  # (W, C)
        self.unfilled = self._per_window(np.isnan(self.filled))
        self.off_grid = self._per_window(self.placed.off_grid)
        self.conflict = self._per_window(self.placed.conflict)
        self.phase, self.coherence = self._phases()
        self.by_channel: list[tuple[FloatArray, FloatArray]] | None = None

    def _per_window(self, mask: BoolArray) -> IntArray:
        total = np.concatenate([np.zeros((1, mask.shape[1]), dtype=np.int64), np.cumsum(mask, axis=0)])
        found: IntArray = total[self.ends] - total[self.starts]
        return found

    def _phases(self) -> tuple[FloatArray, FloatArray]:
        """Circular mean of the samples' offsets from their rows, in periods, and its resultant length: (W,) each."""
        total = np.concatenate([np.zeros((1, 2)), np.cumsum(self.placed.phase, axis=0)])
        cosine, sine = (total[self.ends] - total[self.starts]).T
        present = (~np.isnan(self.placed.value)).sum(axis=1)
        number = np.r_[0, np.cumsum(present)]
        number = np.maximum(number[self.ends] - number[self.starts], 1)
        return np.arctan2(sine, cosine) / (2.0 * np.pi), np.hypot(sine, cosine) / number

    def first_out_of_phase(self) -> int | None:
        """The first window for which the grid must move to stay with the samples."""
        out = np.flatnonzero((np.abs(self.phase) > FOLLOW) & (self.coherence > COHERENT))
        return int(out[0]) if len(out) else None

    def window(self, index: int) -> Window:
        """The window, judged: used, repaired or dropped."""
        owner = self.owner
        rows = slice(self.starts[index], self.ends[index])
        values = self.filled[rows].copy()
        missing = self.missing[index].copy()
        unfilled = self.unfilled[index].copy()
        conflict = self.conflict[index].copy()
        gone = np.isnan(self.placed.value[rows])
        notes: list[str] = []
        sparse = (missing > MOSTLY_THERE * owner.window) & (missing < owner.window)  # gaps, or a slower channel
        for channel in np.flatnonzero((self.off_grid[index] > 0) | sparse):
            resampled, note = self._resampled(int(channel), rows)
            values[:, channel] = resampled.value
            unfilled[channel] = int(np.isnan(resampled.value).sum())
            gone[:, channel] = resampled.bridged | np.isnan(resampled.value)
            missing[channel] = int(gone[:, channel].sum())
            conflict[channel] = 0
            if note and note not in notes:
                notes.append(note)
        absent = (missing == owner.window) & (unfilled == owner.window)
        torn = ~absent & (unfilled > MOSTLY_THERE * owner.window)  # as by a loose contact
        if not (absent | torn).all():  # what is left of them is worth less than the window
            absent |= torn
            notes += [f"gaps in {owner.channels[c].name}" for c in np.flatnonzero(torn)]
        values[:, absent] = np.nan
        owner._count(gone)
        start = owner._base + round(self.origin + index * owner.hop * owner._period)
        reason = self._reason(absent, missing, unfilled, conflict, notes)
        if reason:
            owner.account.reasons[reason] += 1
            return Window(start, owner.sample_rate, values, "dropped", reason)
        repaired = int(missing[~absent].sum())
        if repaired:
            notes.insert(0, "missing samples interpolated")
        if len(lacking := np.flatnonzero(absent & owner.wanted)):
            notes = list(dict.fromkeys([self._missing(lacking, notes), *notes]))
        if notes:
            owner.account.reasons[notes[0]] += 1
            return Window(start, owner.sample_rate, values, "repaired", "; ".join(notes[:4]), repaired)
        return Window(start, owner.sample_rate, values)

    def _reason(
        self, absent: BoolArray, missing: IntArray, unfilled: IntArray, conflict: IntArray, notes: list[str]
    ) -> str | None:
        """Why the window must be dropped, or None."""
        owner = self.owner
        if absent.all():
            return notes[0] if notes else "no samples"
        lacking = next((np.flatnonzero(columns) for columns in owner.needed if absent[columns].all()), None)
        if lacking is not None:
            return self._missing(lacking, notes)
        present = ~absent
        cells = owner.window * int(present.sum())
        if conflict[present].sum() > owner.largest_share * cells:
            return "clock stepped back"
        if missing[present].sum() > owner.largest_share * cells:
            return "too many missing samples"
        broken = np.flatnonzero(present & (unfilled > 0))
        if len(broken):
            return f"gap in {owner.channels[broken[0]].name}"
        return None

    def _missing(self, columns: IntArray, notes: Sequence[str]) -> str:
        """Why there is nothing of some channels, in words: the first one's name stands for all."""
        name = self.owner.channels[columns[0]].name
        said = next((note for note in notes if note.startswith(f"{name} ")), f"missing input {name}")
        return said if len(columns) == 1 else f"{said} and {len(columns) - 1} more"

    def _resampled(self, channel: int, rows: slice) -> tuple[Resampled, str | None]:
        """One channel that does not lie on the grid, and a remark for the user."""
        offset, value = self._samples_of(channel)
        near = slice(*np.searchsorted(offset, [rows.start - REACH - 1, rows.stop + REACH + 1]))
        grid = np.arange(rows.start, rows.stop, dtype=np.float64)
        result = resample(offset[near], value[near], grid, self.owner.longest_gap)
        if not result.even:
            near = slice(
                near.start, int(np.searchsorted(offset, rows.stop + REACH + self.owner.delay * self.owner.sample_rate))
            )
            counted = by_count(offset[near], value[near], grid, self.owner.longest_gap)
            if counted is not None:
                return counted, "arrival times made even"
            if self.owner.stamped:
                around = slice(*np.searchsorted(offset, [rows.start - 2 * REACH, rows.stop + 2 * REACH]))
                between = uneven(offset[around], value[around], grid, self.owner.longest_gap)
                return between, f"{self.owner.channels[channel].name} unevenly sampled: interpolated"
        name, own = self.owner.channels[channel].name, result.rate * self.owner.sample_rate
        if not result.even:
            return result, f"{name} unevenly sampled"
        if 0.0 < result.rate < SLOWEST * (1.0 - 1e-3):
            return result, f"{name} too slow ({own:.3g} Hz)"
        if 0.0 < result.rate < 0.98:
            return result, f"{name} interpolated from {own:.3g} Hz"
        return result, None

    def _samples_of(self, channel: int) -> tuple[FloatArray, FloatArray]:
        if self.by_channel is None:
            order = np.lexsort((self.offset, self.samples.channel))
            bounds = np.searchsorted(self.samples.channel[order], np.arange(len(self.owner.channels) + 1))
            self.by_channel = [
                (self.offset[order[a:b]], self.samples.value[order[a:b]]) for a, b in itertools.pairwise(bounds)
            ]
        return self.by_channel[channel]

"""A whole recording on one even grid, for analyses that want it in one piece."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from cantools.database import Database

from sprung.model.signals import ANY_TIME, BoolArray, Channel, FloatArray, SampleBlock, TimeColumn
from sprung.replay.account import Account, UnreadableRecording
from sprung.replay.grid import REACH, place, resample, taken_at_stamps, uneven
from sprung.replay.multirate import slower_than
from sprung.replay.recording import Recording, open_recording
from sprung.replay.stream import ClockJump, Reorderer

MOST_CELLS = 500_000_000  # rows times channels of one record; 4 GB
CELLS_ALWAYS, CELLS_PER_SAMPLE = 2_000_000, 50  # and at most so many: a record that is nearly all gaps is none
TELL_LOSS = 0.01  # share of a channel's samples above which their loss is reported
ROWS_AT_ONCE = 512  # rows that are resampled together, so that memory stays small


@dataclass(frozen=True, slots=True)
class Record:
    """T rows of C channels on an even grid."""

    start: int  # time of the first row, ns since epoch
    sample_rate: float  # Hz
    values: FloatArray  # (T, C) SI; NaN where no valid sample came, whole columns for absent channels
    lost: int  # samples that did not come or were invalid, absent channels left out
    vehicle: str | None
    problems: tuple[str, ...]  # one line each
    account: Account

    @property
    def seconds(self) -> float:
        """Length of the record."""
        return len(self.values) / self.sample_rate


def load_record(
    path: str | Path,
    channels: Sequence[Channel],
    sample_rate: float,
    *,
    dbc: str | Path | Database | None = None,
    time_source: str | Mapping[str, str] = "auto",
    delay: float = 0.5,
    pause: float = 60.0,
    time: TimeColumn = ANY_TIME,
    start: int | None = None,
) -> Record:
    """Read everything; raises UnreadableRecording.

    Nothing is repaired: lost samples are NaN.  When the clock jumps or the sender pauses for more than `pause` s,
    the longest stretch is kept and the others are named in `problems`.
    """
    recording = open_recording(path, channels, dbc=dbc, time_source=time_source, time=time, start=start)
    stretches = _stretches(recording, Reorderer(delay, pause, confirm=max(8, 2 * len(channels))), sample_rate)
    longest = max(stretches, key=lambda block: len(block.time))
    if len(stretches) > 1:
        left_out = sum(len(block.time) for block in stretches) - len(longest.time)
        recording.account.problem(
            f"the clock jumps {len(stretches) - 1} times; the longest stretch is used, {left_out} samples are not"
        )
    start, values = _grid(longest, recording, sample_rate)
    missing = np.isnan(values)
    absent: BoolArray = np.asarray(missing.all(axis=0))
    _note_losses(recording, missing, absent, sample_rate)
    account = recording.account
    lost = int(missing[:, ~absent].sum())
    return Record(start, sample_rate, values, lost, account.vehicle, tuple(account.problems), account)


def _note_losses(recording: Recording, missing: BoolArray, absent: BoolArray, sample_rate: float) -> None:
    """Say of every channel that lacks much how much, and where its longest gap is."""
    for channel in np.flatnonzero((missing.mean(axis=0) > TELL_LOSS) & ~absent):
        edges = np.flatnonzero(np.diff(np.r_[False, missing[:, channel], False].astype(np.int8)))
        starts, ends = edges[::2], edges[1::2]
        worst = int(np.argmax(ends - starts))
        recording.account.problem(
            f"{recording.channels[channel].name}: {100 * missing[:, channel].mean():.2g} % of its samples are missing; "
            f"the longest of {len(starts)} gaps has {(ends - starts)[worst] / sample_rate:.3g} s, "
            f"from {starts[worst] / sample_rate:.2f} s on"
        )


def _stretches(recording: Recording, order: Reorderer, sample_rate: float) -> list[SampleBlock]:
    """Runs of samples without a clock jump between them."""
    runs: list[list[SampleBlock]] = [[]]
    for block in recording.at_rate(sample_rate):
        for piece in order.push(block):
            if isinstance(piece, ClockJump):
                runs.append([])
            else:
                runs[-1].append(piece)
    order.flush()
    for reason, count in order.counts.items():
        recording.account.values[reason] += count
    joined = [
        SampleBlock(
            np.concatenate([block.time for block in run]),
            np.concatenate([block.channel for block in run]),
            np.concatenate([block.value for block in run]),
        )
        for run in runs
        if run
    ]
    if not joined:
        raise UnreadableRecording(f"{recording.path}: no samples in time order")
    return joined


def _grid(block: SampleBlock, recording: Recording, sample_rate: float) -> tuple[int, FloatArray]:
    """Start time and values (T, C): copied where the samples lie on the grid, else resampled."""
    start = int(block.time.min())
    offset: FloatArray = np.asarray((block.time - start) * (sample_rate / 1e9), dtype=np.float64)
    rows = int(np.rint(offset.max())) + 1
    channels = recording.channels
    cells = rows * len(channels)
    if cells > MOST_CELLS:
        raise UnreadableRecording(
            f"{recording.path}: {rows / sample_rate:.4g} s at {sample_rate:g} Hz are more than can be analysed in one "
            "piece; check the unit of its times (`time: {unit: ...}` in the system file) or cut it"
        )
    if cells > CELLS_ALWAYS + CELLS_PER_SAMPLE * len(block.time):
        raise UnreadableRecording(
            f"{recording.path}: {len(block.time)} samples in {rows / sample_rate:.4g} s are too few for "
            f"{sample_rate:g} Hz; check the unit of its times (`time: {{unit: ...}}` in the system file) or cut it"
        )
    placed = place(offset, block.channel, block.value, rows, len(channels))
    values = placed.value
    as_stamped = [recording.stamped and _taken_at_stamps(block, offset, channel) for channel in range(len(channels))]
    slower = [slower_than(offset[block.channel == channel], 1.0) for channel in range(len(channels))]
    for channel in np.flatnonzero(placed.off_grid.any(axis=0) | np.array(as_stamped) | np.array(slower)):
        own = block.channel == channel
        values[:, channel], between = _resample_long(
            offset[own], block.value[own], rows, recording.stamped, as_stamped[channel]
        )
        if between:
            steps = np.diff(np.sort(block.time[own])) / 1e6
            low, high = np.percentile(steps, [1, 99])
            reason = (
                "its samples were taken at uneven times" if as_stamped[channel] else "its time stamps fit no even clock"
            )
            recording.account.note(
                f"{channels[channel].name}: {reason} (steps of {low:.3g} to {high:.3g} ms) in "
                f"{100 * between / rows:.3g} % of the record: interpolated between them (cubic spline)"
            )
    return start, values


def _taken_at_stamps(block: SampleBlock, offset: FloatArray, channel: int) -> bool:
    own = block.channel == channel
    order = np.argsort(offset[own], kind="stable")
    return taken_at_stamps(offset[own][order], block.value[own][order])


def _resample_long(
    offset: FloatArray, value: FloatArray, rows: int, stamped: bool, as_stamped: bool
) -> tuple[FloatArray, int]:
    """Values at the rows, and how many of them had to be interpolated between uneven stamps.

    as_stamped: the samples were taken when their stamps say.
    """
    order = np.argsort(offset, kind="stable")
    offset, value = offset[order], value[order]
    column = np.full(rows, np.nan)
    between = 0
    for first in range(0, rows, ROWS_AT_ONCE):
        last = min(first + ROWS_AT_ONCE, rows)
        near = slice(*np.searchsorted(offset, [first - 4 * REACH, last + 4 * REACH]))
        at = np.arange(first, last, dtype=np.float64)
        result = None if as_stamped else resample(offset[near], value[near], at)
        if result is None or (not result.even and stamped):
            result = uneven(offset[near], value[near], at)
            between += last - first
        result.value[result.bridged] = np.nan
        column[first:last] = result.value
    return column, between

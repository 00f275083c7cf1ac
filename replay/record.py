"""A whole recording on one even grid, for analyses that want it in one piece."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from cantools.database import Database

from sprung.model.signals import ANY_TIME, Channel, FloatArray, SampleBlock, TimeColumn
from sprung.replay.account import Account, UnreadableRecording
from sprung.replay.grid import REACH, place, resample
from sprung.replay.recording import Recording, open_recording
from sprung.replay.stream import Jump, Order

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
    stretches = _stretches(recording, Order(delay, pause, confirm=max(8, 2 * len(channels))))
    longest = max(stretches, key=lambda block: len(block.time))
    if len(stretches) > 1:
        left_out = sum(len(block.time) for block in stretches) - len(longest.time)
        recording.account.problem(
            f"the clock jumps {len(stretches) - 1} times; the longest stretch is used, {left_out} samples are not"
        )
    start, values = _grid(longest, len(channels), sample_rate)
    missing = np.isnan(values)
    lost = int(missing[:, ~missing.all(axis=0)].sum())
    account = recording.account
    return Record(start, sample_rate, values, lost, account.vehicle, tuple(account.problems), account)


def _stretches(recording: Recording, order: Order) -> list[SampleBlock]:
    """Runs of samples without a clock jump between them."""
    runs: list[list[SampleBlock]] = [[]]
    for block in recording.blocks():
        for piece in order.push(block):
            if isinstance(piece, Jump):
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


def _grid(block: SampleBlock, channels: int, sample_rate: float) -> tuple[int, FloatArray]:
    """Start time and values (T, C): copied where the samples lie on the grid, else resampled."""
    start = int(block.time.min())
    offset: FloatArray = np.asarray((block.time - start) * (sample_rate / 1e9), dtype=np.float64)
    rows = int(np.rint(offset.max())) + 1
    placed = place(offset, block.channel, block.value, rows, channels)
    values = placed.value
    for channel in np.flatnonzero(placed.off_grid.any(axis=0)):
        own = block.channel == channel
        values[:, channel] = _resample_long(offset[own], block.value[own], rows)
    return start, values


def _resample_long(offset: FloatArray, value: FloatArray, rows: int) -> FloatArray:
    order = np.argsort(offset, kind="stable")
    offset, value = offset[order], value[order]
    column = np.full(rows, np.nan)
    for first in range(0, rows, ROWS_AT_ONCE):
        last = min(first + ROWS_AT_ONCE, rows)
        near = slice(*np.searchsorted(offset, [first - 4 * REACH, last + 4 * REACH]))
        result = resample(offset[near], value[near], np.arange(first, last, dtype=np.float64))
        result.value[result.bridged] = np.nan
        column[first:last] = result.value
    return column

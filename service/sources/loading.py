"""Whole files that are read in a process of their own: what it is asked, and what it does.

Such a process imports this module anew, so it imports no more than reading needs: the rest of a command would cost it
twice the processor time.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sprung.model.signals import Channel, FloatArray, IntArray, SampleBlock, TimeColumn
from sprung.replay import open_recording
from sprung.replay.inspection import Inspection, inspect
from sprung.replay.record import Record, load_record
from sprung.service.processes.worker import Emit


@dataclass(frozen=True, slots=True)
class RecordRequest:
    """A recording to load in one piece."""

    path: Path
    channels: tuple[Channel, ...]
    sample_rate: float
    dbc: Path | None
    time: TimeColumn
    start: int | None


@dataclass(frozen=True, slots=True)
class DrivingRequest:
    """A recording whose inputs drive a simulation, with what was measured beside them at any rate."""

    record: RecordRequest
    beside: tuple[Channel, ...]


@dataclass(frozen=True, slots=True)
class DrivingRecord:
    """A recording, and what was measured beside it."""

    record: Record
    beside: FloatArray  # at the record's rows, shape (T, B); NaN columns for what was not measured


@dataclass(frozen=True, slots=True)
class InspectionRequest:
    """A file to look into."""

    path: Path
    dbc: Path | None
    time: TimeColumn


def load_task(request: RecordRequest, _emit: Emit[None]) -> Record:
    """In the other process."""
    return load_record(
        request.path,
        request.channels,
        request.sample_rate,
        dbc=request.dbc,
        time=request.time,
        start=request.start,
    )


def driving_task(request: DrivingRequest, emit: Emit[None]) -> DrivingRecord:
    """In the other process.

    What was measured beside is interpolated linearly between its values, and held before the first and after the last.
    """
    record = load_task(request.record, emit)
    beside = np.full((len(record.values), len(request.beside)), np.nan)
    rows = np.arange(len(record.values)) * (1e9 / record.sample_rate)
    for column, (time, value) in enumerate(_beside(request)):
        if len(time):
            beside[:, column] = np.interp(rows, (time - record.start).astype(np.float64), value)
    return DrivingRecord(record, beside)


def _beside(request: DrivingRequest) -> list[tuple[IntArray, FloatArray]]:
    """Times and values of every channel beside the others, in order of time."""
    asked = request.record
    if not request.beside:
        return []
    recording = open_recording(
        asked.path, asked.channels, dbc=asked.dbc, time=asked.time, start=asked.start, beside=request.beside
    )
    blocks = [SampleBlock(np.zeros(0, np.int64), np.zeros(0, np.int32), np.zeros(0))]
    for block in recording.blocks():
        own = (block.channel >= len(asked.channels)) & np.isfinite(block.value)
        blocks.append(SampleBlock(block.time[own], block.channel[own], block.value[own]))
    time = np.concatenate([block.time for block in blocks])
    order = np.argsort(time, kind="stable")
    channel = np.concatenate([block.channel for block in blocks])[order]
    value, time = np.concatenate([block.value for block in blocks])[order], time[order]
    return [
        (time[channel == index], value[channel == index])
        for index in range(len(asked.channels), len(asked.channels) + len(request.beside))
    ]


def inspect_task(request: InspectionRequest, _emit: Emit[None]) -> Inspection:
    """In the other process."""
    return inspect(request.path, request.dbc, request.time)


@dataclass(frozen=True, slots=True)
class Beginning:
    """Whose recording it is and when it began; None: not said, no sample."""

    vehicle: str | None
    first_ns: int | None


def head_task(request: RecordRequest, _emit: Emit[None]) -> Beginning:
    """In the other process."""
    recording = open_recording(request.path, request.channels, dbc=request.dbc, time=request.time, start=request.start)
    blocks = recording.at_rate(request.sample_rate)
    first = next((int(block.time.min()) for block in blocks if len(block.time)), None)
    return Beginning(recording.vehicle, first)

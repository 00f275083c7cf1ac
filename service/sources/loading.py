"""Whole files that are read in a process of their own: what it is asked, and what it does.

Such a process imports this module anew, so it imports no more than reading needs: the rest of a command would cost it
twice the processor time.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from sprung.model.signals import Channel, TimeColumn
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

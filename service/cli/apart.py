"""Files are read in a process of their own, with bounds: one that was made to do harm costs its own reading."""

from __future__ import annotations

from collections.abc import Iterator
from math import inf
from pathlib import Path
from typing import TypeVar

from sprung.replay.inspection import Inspection
from sprung.replay.record import Record
from sprung.service.errors import UserError
from sprung.service.processes.worker import ProcessLimits, Task, carried_out
from sprung.service.settings import Settings, settings_with
from sprung.service.sources.loading import (
    DrivingRecord,
    DrivingRequest,
    InspectionRequest,
    RecordRequest,
    driving_task,
    inspect_task,
    load_task,
)
from sprung.service.sources.reading import SLOWEST_BYTES_PER_SECOND, Reading, ReadRequest, ReadWindows, reading_of

Request = TypeVar("Request")
Result = TypeVar("Result")


def own_limits(settings: Settings, path: Path) -> ProcessLimits | None:
    """What reading a file that the user names may use; None: it is read here, as the settings say.

    However long it takes: people see that it goes on, and can end it.  Processor time goes with the size.
    """
    if not settings.isolate_reading:
        return None
    seconds = 60 + path.stat().st_size // SLOWEST_BYTES_PER_SECOND
    return ProcessLimits(inf, inf, settings.worker_memory_bytes, seconds, niceness=0)


def readable(path: Path) -> None:
    """Refuse what is no file that can be opened, before work is begun or a process started.

    Errors: OSError, UserError (pipes and devices: opening them may wait for ever).
    """
    if path.exists() and not (path.is_file() or path.is_dir()):
        raise UserError(f"{path}: is no file; send what comes through a pipe to standard input, and give - instead")
    with open(path, "rb"):
        pass


def load(request: RecordRequest) -> Record:
    """The record.  Raises UnreadableRecording, or UserError where the bounds are exceeded."""
    return _apart(load_task, request, request.path)


def load_driving(request: DrivingRequest) -> DrivingRecord:
    """The record, and what was measured beside its inputs.  Raises as `load`."""
    return _apart(driving_task, request, request.record.path)


def look(request: InspectionRequest) -> Inspection:
    """What is in the file.  Raises as `load`."""
    return _apart(inspect_task, request, request.path)


def windows(request: ReadRequest) -> Iterator[ReadWindows]:
    """The windows of a recording.  Raises as `load`."""
    return reading(request).pieces(lambda: None)


def reading(request: ReadRequest) -> Reading:
    """A recording that is about to be read.  Raises OSError where there is none."""
    readable(request.path)
    return reading_of(request, own_limits(settings_with({}), request.path))


def _apart(task: Task[Request, None, Result], request: Request, path: Path) -> Result:
    readable(path)
    return carried_out(task, request, own_limits(settings_with({}), path), f"the reading of {path.name}")

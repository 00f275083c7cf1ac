"""Recordings as a system file says: its channels, the unit and start of its times, its CAN database."""

from __future__ import annotations

from pathlib import Path

from sprung.model.system import System
from sprung.replay.record import Record, load_record
from sprung.replay.recording import Recording, open_recording


def open_stream(path: Path, system: System, dbc: Path | None = None, start: int | None = None) -> Recording:
    """A recording as a stream of samples, to be read once.  Raises UnreadableRecording.

    start: ns since 1970, when the recording began if its times count from 0; else the file's own time is taken.
    """
    written = path.stat().st_mtime_ns if start is None and path.is_file() else start
    recording = open_recording(path, system.channels, dbc=dbc, time=system.time, start=written, beside=system.auxiliary)
    recording.start_of_file = start is None
    return recording


def open_record(
    path: Path, system: System, dbc: Path | None = None, start: int | None = None, *, signals: bool = False
) -> Record:
    """A whole recording on one even grid; with `signals` also what parameters may follow, after the channels.

    Raises UnreadableRecording.
    """
    channels = (*system.channels, *system.signals) if signals else system.channels
    return load_record(path, channels, system.sample_rate, dbc=dbc, time=system.time, start=start)

"""Forgetting: how long windows, roll-ups and uploads are kept.

Ages count from when a row was stored, not from the time in the recording: an archive of last year that is
replayed today is kept as long as today's measurements.
"""

from __future__ import annotations

from dataclasses import dataclass

from sqlalchemy import Connection, delete, select, update

from sprung.service.store.schema import jobs, recordings, rollups, windows
from sprung.service.store.work import UNFINISHED


@dataclass(frozen=True, slots=True)
class Forgotten:
    """What was removed."""

    windows: int
    minutes: int
    upload_files: tuple[str, ...]  # names inside the upload folder, for the caller to delete


def forget(connection: Connection, windows_before: int, minutes_before: int, uploads_before: int) -> Forgotten:
    """Delete what was stored before the given times, ns since epoch.  One-hour roll-ups and alarms stay."""
    old = delete(windows).where(windows.c.stored_ns < windows_before)  # posteriors go with their windows
    removed_windows = connection.execute(old).rowcount
    removed_minutes = connection.execute(
        delete(rollups).where(rollups.c.resolution_s == 60, rollups.c.updated_ns < minutes_before)
    ).rowcount
    in_use = select(jobs.c.recording_id).where(jobs.c.state.in_(UNFINISHED), jobs.c.recording_id.is_not(None))
    finished = (
        (recordings.c.file.is_not(None)) & (recordings.c.created_ns < uploads_before) & (recordings.c.id.not_in(in_use))
    )
    files = tuple(connection.execute(select(recordings.c.file).where(finished)).scalars())
    connection.execute(update(recordings).where(finished).values(file=None))
    return Forgotten(removed_windows, removed_minutes, files)

"""Forgetting: how long windows, roll-ups and uploads are kept, and how much room they may take.

A window goes when it is old by both clocks: by the time of its data and by the time at which it was stored.  An archive
of last year that is replayed today is kept as long as today's measurements, and a host whose clock was wrong for a
while, in either direction, loses nothing.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from sqlalchemy import Connection, delete, func, select, text, update

from sprung.service.store.schema import jobs, recordings, rollups, windows
from sprung.service.store.work import UNFINISHED

CLOCK_WAS_SET_NS = 1_577_836_800_000_000_000  # 2020: before it, a clock was not set, and says nothing about age
AT_ONCE = 5000  # windows that are deleted together when there are too many


@dataclass(frozen=True, slots=True)
class RetentionLimits:
    """What is kept: times before which things are old, ns since epoch, and bytes."""

    windows_before: int
    minutes_before: int
    uploads_before: int
    store_bytes: int | None = None  # windows beyond go, the oldest first
    upload_bytes: int | None = None


@dataclass(frozen=True, slots=True)
class Forgotten:
    """What was removed."""

    windows: int
    minutes: int
    upload_files: tuple[str, ...]  # names inside the upload folder, for the caller to delete
    windows_for_room: int = 0  # of the windows, those that were not old


def forget(connection: Connection, limits: RetentionLimits) -> Forgotten:
    """Delete what is past the limits.  One-hour roll-ups and alarms stay."""
    old = delete(windows).where(  # posteriors go with their windows
        windows.c.stored_ns < limits.windows_before,
        windows.c.stored_ns >= CLOCK_WAS_SET_NS,
        windows.c.start_ns < limits.windows_before,
    )
    removed = connection.execute(old).rowcount
    for_room = 0 if limits.store_bytes is None else _make_room(connection, limits.store_bytes)
    minutes = delete(rollups).where(
        rollups.c.resolution_s == 60,
        rollups.c.updated_ns < limits.minutes_before,
        rollups.c.updated_ns >= CLOCK_WAS_SET_NS,
        rollups.c.bucket_ns < limits.minutes_before,
    )
    removed_minutes = connection.execute(minutes).rowcount
    files = _old_uploads(connection, limits.uploads_before)
    if limits.upload_bytes is not None:
        files += _surplus_uploads(connection, limits.upload_bytes)
    return Forgotten(removed + for_room, removed_minutes, tuple(files), for_room)


def newest(connection: Connection) -> int | None:
    """When the last window was stored by a clock that was set, ns since epoch."""
    query = select(func.max(windows.c.stored_ns)).where(windows.c.stored_ns >= CLOCK_WAS_SET_NS)
    found: int | None = connection.execute(query).scalar_one()
    return found


def used_bytes(connection: Connection) -> int | None:
    """Bytes that the store's content takes, free pages left out; None where the database does not tell."""
    if connection.dialect.name != "sqlite":
        return None
    pages, free, size = (
        int(connection.execute(text(f"PRAGMA {name}")).scalar_one())
        for name in ("page_count", "freelist_count", "page_size")
    )
    return (pages - free) * size


def _make_room(connection: Connection, limit: int) -> int:
    removed = 0
    while (used := used_bytes(connection)) is not None and used > limit:
        oldest = select(windows.c.id).order_by(windows.c.start_ns).limit(AT_ONCE).scalar_subquery()
        count = connection.execute(delete(windows).where(windows.c.id.in_(oldest))).rowcount
        if count == 0:
            break
        removed += count
    return removed


def _old_uploads(connection: Connection, before: int) -> list[str]:
    old = (recordings.c.created_ns < before) & (recordings.c.created_ns >= CLOCK_WAS_SET_NS)
    return _release(connection, [row.id for row in _finished(connection, old)])


def _surplus_uploads(connection: Connection, limit: int) -> list[str]:
    """The oldest uploads, until the rest is within the limit."""
    kept = int(
        connection.execute(select(func.coalesce(func.sum(recordings.c.size_bytes), 0)).where(_kept())).scalar_one()
    )
    surplus = []
    for row in _finished(connection, _kept()):
        if kept <= limit:
            break
        kept -= row.size_bytes or 0
        surplus.append(row.id)
    return _release(connection, surplus)


def _kept() -> Any:
    return recordings.c.file.is_not(None)


def _finished(connection: Connection, condition: Any) -> list[Any]:
    """Recordings with a file that no job needs any more, oldest first."""
    in_use = select(jobs.c.recording_id).where(jobs.c.state.in_(UNFINISHED), jobs.c.recording_id.is_not(None))
    query = select(recordings.c.id, recordings.c.size_bytes).where(_kept(), condition, recordings.c.id.not_in(in_use))
    return list(connection.execute(query.order_by(recordings.c.created_ns)))


def _release(connection: Connection, ids: list[str]) -> list[str]:
    """Take the files away from recordings; their names."""
    files: list[str] = []
    for first in range(0, len(ids), 500):
        chosen = recordings.c.id.in_(ids[first : first + 500])
        files += connection.execute(select(recordings.c.file).where(chosen)).scalars()
        connection.execute(update(recordings).where(chosen).values(file=None))
    return files

"""Forgetting: how long windows, roll-ups and uploads are kept, and how much room they may take.

A window goes when it is old by both clocks: by the time of its data and by the time at which it was stored.  An archive
of last year that is replayed today is kept as long as today's measurements, and a host whose clock was wrong for a
while, in either direction, loses nothing.

On PostgreSQL whole months go at once, by dropping their partition: deleting a tenth of a large table row by row would
cost more than storing it did.  There a window is kept until the last one of its month is old.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from sqlalchemy import Connection, delete, func, select, text, update

from sprung.service.store import partitions
from sprung.service.store.schema import circumstances, jobs, recordings, rollups, windows
from sprung.service.store.work import ALARM_SOURCE, UNFINISHED

CLOCK_WAS_SET_NS = 1_577_836_800_000_000_000  # 2020: before it, a clock was not set, and says nothing about age
Keep = Callable[..., Any]  # of a connection and the conditions of windows
AT_ONCE = 5000  # windows that are deleted together when there are too many
FEWEST = 50  # likewise, where little room is missing: they fill some dozen pages, and single ones would free none
WINDOW_BYTES = 1200  # of one in the store, about


@dataclass(frozen=True, slots=True)
class RetentionLimits:
    """What is kept: times before which things are old, ns since epoch, and bytes."""

    windows_before: int
    minutes_before: int
    uploads_before: int
    store_bytes: int | None = None  # windows beyond go, the oldest first
    upload_bytes: int | None = None


@dataclass(frozen=True, slots=True)
class RetentionResult:
    """What was removed."""

    windows: int
    minutes: int
    upload_files: tuple[str, ...]  # names inside the upload folder, for the caller to delete
    windows_for_room: int = 0  # of the windows, those that were not old
    too_many_bytes: int = 0  # by which the store is too large though no window is left to go


def forget(
    connection: Connection, limits: RetentionLimits, keep: Keep = lambda connection, *which: None
) -> RetentionResult:
    """Delete what is past the limits.  One-hour roll-ups and alarms stay.

    keep: called with windows, by their conditions, before they are deleted.
    """
    if connection.dialect.name == "postgresql":
        connection.execute(text("SET LOCAL statement_timeout = 0"))  # a month of a fleet takes its time
    removed, freed = _forget_windows(connection, limits.windows_before, keep)
    for_room = beyond = 0
    if limits.store_bytes is not None:
        for_room, beyond = _make_room(connection, limits.store_bytes + freed, keep)
    minutes = delete(rollups).where(
        rollups.c.resolution_s == 60,
        rollups.c.updated_ns < limits.minutes_before,
        rollups.c.updated_ns >= CLOCK_WAS_SET_NS,
        rollups.c.bucket_ns < limits.minutes_before,
    )
    removed_minutes = connection.execute(minutes).rowcount
    connection.execute(
        delete(circumstances).where(
            circumstances.c.resolution_s == 60,
            circumstances.c.updated_ns < limits.minutes_before,
            circumstances.c.updated_ns >= CLOCK_WAS_SET_NS,
            circumstances.c.bucket_ns < limits.minutes_before,
        )
    )
    files = _old_uploads(connection, limits.uploads_before)
    if limits.upload_bytes is not None:
        files += _surplus_uploads(connection, limits.upload_bytes)
    return RetentionResult(removed + for_room, removed_minutes, tuple(files), for_room, beyond)


def _forget_windows(connection: Connection, before: int, keep: Keep) -> tuple[int, int]:
    """Windows that went, and bytes that they took of which the database does not show yet that they are free."""
    if connection.dialect.name == "postgresql":
        old = old_months(connection, before)
        freed = sum(partitions.size(connection, month) for month in old)
        return sum(_drop(connection, month, keep) for month in old), freed
    which = (windows.c.stored_ns < before, windows.c.stored_ns >= CLOCK_WAS_SET_NS, windows.c.start_ns < before)
    keep(connection, *which)
    return connection.execute(delete(windows).where(*which)).rowcount, 0


def _drop(connection: Connection, month: partitions.Month, keep: Keep) -> int:
    keep(connection, windows.c.start_ns >= month.begin, windows.c.start_ns < month.end)
    return partitions.drop(connection, month)


def old_months(connection: Connection, before: int) -> list[partitions.Month]:
    """Partitions all of whose windows are old by both clocks."""
    found = []
    for month in partitions.months(connection):
        inside = (windows.c.start_ns >= month.begin, windows.c.start_ns < month.end)
        kept = select(windows.c.stored_ns).where(
            *inside, (windows.c.stored_ns >= before) | (windows.c.stored_ns < CLOCK_WAS_SET_NS)
        )
        if month.end <= before and connection.execute(kept.limit(1)).first() is None:
            found.append(month)
    return found


def newest(connection: Connection) -> int | None:
    """When the last window was stored by a clock that was set, ns since epoch."""
    query = select(func.max(windows.c.stored_ns)).where(windows.c.stored_ns >= CLOCK_WAS_SET_NS)
    found: int | None = connection.execute(query).scalar_one()
    return found


def used_bytes(connection: Connection) -> int | None:
    """Bytes that the store's content takes, free pages left out; None where the database does not tell."""
    if connection.dialect.name == "postgresql":
        return int(connection.execute(text("SELECT pg_database_size(current_database())")).scalar_one())
    if connection.dialect.name != "sqlite":
        return None
    pages, free, size = (
        int(connection.execute(text(f"PRAGMA {name}")).scalar_one())
        for name in ("page_count", "freelist_count", "page_size")
    )
    return (pages - free) * size


def _make_room(connection: Connection, limit: int, keep: Keep) -> tuple[int, int]:
    """Windows that went, and bytes by which the store is too large all the same."""
    if connection.dialect.name == "postgresql":
        return _drop_for_room(connection, limit, keep)
    removed = 0
    while (used := used_bytes(connection)) is not None and used > limit:
        enough = min(max((used - limit) // WINDOW_BYTES, FEWEST), AT_ONCE)
        starts = select(windows.c.start_ns).order_by(windows.c.start_ns).limit(enough).subquery()
        last = connection.execute(select(func.max(starts.c.start_ns))).scalar()
        if last is None:
            return removed, used - limit
        oldest = windows.c.start_ns <= last
        keep(connection, oldest)
        count = connection.execute(delete(windows).where(oldest)).rowcount
        removed += count
    return removed, 0


def _drop_for_room(connection: Connection, limit: int, keep: Keep) -> tuple[int, int]:
    """Whole months, the oldest first; never the newest one.

    The database has the room of a dropped table back, and shows it, only when the transaction is committed.
    """
    removed, beyond = 0, (used_bytes(connection) or 0) - limit
    for month in partitions.months(connection)[:-1]:
        if beyond <= 0:
            break
        beyond -= partitions.size(connection, month)
        removed += _drop(connection, month, keep)
    return removed, max(beyond, 0)


def _old_uploads(connection: Connection, before: int) -> list[str]:
    old = (_kept_since() < before) & (_kept_since() >= CLOCK_WAS_SET_NS)
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


def surplus_alarm_signals(connection: Connection, vehicle: str, count: int, limit: int) -> list[str]:
    """Give up the oldest signals of alarms: of a vehicle those beyond `count`, of all what is beyond `limit` bytes.

    Names of files that the caller deletes.
    """
    found = _finished(connection, recordings.c.source == ALARM_SOURCE)
    own = set(connection.execute(select(recordings.c.id).where(recordings.c.vehicle_id == vehicle)).scalars())
    surplus = [row.id for row in found if row.id in own][:-count]
    kept = sum(row.size_bytes or 0 for row in found if row.id not in surplus)
    for row in found:
        if kept <= limit:
            break
        if row.id not in surplus:
            kept -= row.size_bytes or 0
            surplus.append(row.id)
    return _release(connection, surplus)


def _kept() -> Any:
    return recordings.c.file.is_not(None)


def _kept_since() -> Any:
    return func.coalesce(recordings.c.kept_since_ns, recordings.c.created_ns)


def _finished(connection: Connection, condition: Any) -> list[Any]:
    """Recordings with a file that no job needs any more, oldest first."""
    in_use = select(jobs.c.recording_id).where(jobs.c.state.in_(UNFINISHED), jobs.c.recording_id.is_not(None))
    query = select(recordings.c.id, recordings.c.size_bytes).where(_kept(), condition, recordings.c.id.not_in(in_use))
    return list(connection.execute(query.order_by(_kept_since())))


def _release(connection: Connection, ids: list[str]) -> list[str]:
    """Take the files away from recordings; their names."""
    files: list[str] = []
    for first in range(0, len(ids), 500):
        chosen = recordings.c.id.in_(ids[first : first + 500])
        files += connection.execute(select(recordings.c.file).where(chosen)).scalars()
        connection.execute(update(recordings).where(chosen).values(file=None))
    return files

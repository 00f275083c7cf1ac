"""Recordings, jobs, reports and notifications as pages, newest first."""

from __future__ import annotations

from dataclasses import fields
from typing import Any, TypeVar

from sqlalchemy import Connection, Table, and_, or_, select

from sprung.service.store.cursors import whole_number
from sprung.service.store.outbox import DeliveryRow
from sprung.service.store.schema import deliveries, jobs, recordings, reports
from sprung.service.store.work import JobRow, RecordingRow, ReportRow

T = TypeVar("T", JobRow, RecordingRow, ReportRow, DeliveryRow)
Cursor = tuple[int, str]  # (created, id) of the last row of the page before


def list_jobs(connection: Connection, limit: int, after: Cursor | None = None, **equal: str | None) -> list[JobRow]:
    """Jobs; `equal` are columns that must have a value (None: any)."""
    return _page(connection, jobs, JobRow, limit, after, equal)


def list_recordings(
    connection: Connection, limit: int, after: Cursor | None = None, **equal: str | None
) -> list[RecordingRow]:
    """Recordings."""
    return _page(connection, recordings, RecordingRow, limit, after, equal)


def list_reports(
    connection: Connection, limit: int, after: Cursor | None = None, **equal: str | None
) -> list[ReportRow]:
    """Mismatch reports."""
    return _page(connection, reports, ReportRow, limit, after, equal)


def list_deliveries(
    connection: Connection, limit: int, after: Cursor | None = None, **equal: str | None
) -> list[DeliveryRow]:
    """Notifications."""
    return _page(connection, deliveries, DeliveryRow, limit, after, equal)


def cursor_of(row: Any) -> str:
    """What the next page goes on from."""
    return f"{row.created_ns}:{row.id}"


def parse_cursor(text: str | None) -> Cursor | None:
    """The inverse of `cursor_of`.  Raises ValueError."""
    if text is None:
        return None
    created, separator, identity = text.partition(":")
    if not separator:
        raise ValueError(text)
    return whole_number(created), identity


def _page(
    connection: Connection,
    table: Table,
    make: type[T],
    limit: int,
    after: Cursor | None,
    equal: dict[str, str | None],
) -> list[T]:
    names = [one.name for one in fields(make) if one.name in table.c]
    query = select(*(table.c[name] for name in names)).order_by(table.c.created_ns.desc(), table.c.id.desc())
    for name, value in equal.items():
        if value is not None:
            query = query.where(table.c[name] == value)
    if after is not None:
        created, identity = after
        same = and_(table.c.created_ns == created, table.c.id < identity)
        query = query.where(or_(table.c.created_ns < created, same))
    return [make(**row._mapping) for row in connection.execute(query.limit(limit))]

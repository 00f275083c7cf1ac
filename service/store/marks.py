"""What people wrote on a vehicle's time line, what they call it, and its end."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from sqlalchemy import Connection, delete, insert, select, update

from sprung.service.store.schema import (
    alarms,
    circumstances,
    fleet_status,
    jobs,
    marks,
    pending,
    recordings,
    reports,
    rollups,
    tracker_states,
    vehicle_model_uses,
    vehicle_models,
    vehicles,
    window_reasons,
    windows,
)


@dataclass(frozen=True, slots=True)
class MarkRow:
    """A note or a maintenance."""

    id: int
    vehicle_id: str
    kind: str  # note, maintenance
    time_ns: int
    text: str
    parameters: list[str] | None  # whose baselines were learned anew; None: none, []: all
    author: str
    created_ns: int


@dataclass(frozen=True, slots=True)
class RemovedVehicle:
    """What was kept of a vehicle beside the store, for the caller to delete."""

    upload_files: tuple[str, ...]
    reports: tuple[str, ...]


def add_mark(connection: Connection, row: MarkRow) -> MarkRow:
    """Store a mark; the row with its number (the given one does not count)."""
    values: dict[str, Any] = {name: getattr(row, name) for name in MarkRow.__slots__ if name != "id"}
    key = connection.execute(insert(marks).values(**values)).inserted_primary_key
    assert key is not None
    return MarkRow(int(key[0]), **values)


def list_marks(connection: Connection, vehicle: str, limit: int) -> list[MarkRow]:
    """Marks of a vehicle, newest first."""
    query = (
        select(marks)
        .where(marks.c.vehicle_id == vehicle)
        .order_by(marks.c.time_ns.desc(), marks.c.id.desc())
        .limit(limit)
    )
    return [MarkRow(*row) for row in connection.execute(query)]


def rename(connection: Connection, vehicle: str, label: str | None) -> None:
    """What people call the vehicle."""
    connection.execute(update(vehicles).where(vehicles.c.id == vehicle).values(label=label or None))


def retire(connection: Connection, vehicle: str, since: int | None) -> None:
    """Take a vehicle out of service, or back into it (None)."""
    connection.execute(update(vehicles).where(vehicles.c.id == vehicle).values(retired_ns=since))


def remove(connection: Connection, vehicle: str) -> RemovedVehicle:
    """Delete a vehicle with everything that is known of it; the audit log keeps that it was deleted."""
    # of those that no job has read to the end it is known by the job alone
    asked = select(jobs.c.recording_id).where(jobs.c.vehicle_id == vehicle, jobs.c.recording_id.is_not(None))
    unread = recordings.c.vehicle_id.is_(None) & recordings.c.id.in_(asked)
    connection.execute(update(recordings).where(unread).values(vehicle_id=vehicle))
    own = recordings.c.vehicle_id == vehicle
    files = connection.execute(select(recordings.c.file).where(own, recordings.c.file.is_not(None))).scalars().all()
    pages = connection.execute(select(reports.c.id).where(reports.c.vehicle_id == vehicle)).scalars().all()
    own_models = (vehicle_model_uses, vehicle_models)
    kept = (
        alarms,
        circumstances,
        marks,
        fleet_status,
        window_reasons,
        tracker_states,
        rollups,
        pending,
        windows,
        reports,
    )
    for table in (*own_models, *kept):
        connection.execute(delete(table).where(table.c.vehicle_id == vehicle))
    ids = select(recordings.c.id).where(own)
    for table in (jobs, reports, windows):  # of other vehicles or none, from the same file
        connection.execute(update(table).where(table.c.recording_id.in_(ids)).values(recording_id=None))
    connection.execute(update(jobs).where(jobs.c.vehicle_id == vehicle).values(vehicle_id=None))
    connection.execute(delete(recordings).where(own))
    connection.execute(delete(vehicles).where(vehicles.c.id == vehicle))
    return RemovedVehicle(tuple(files), tuple(pages))

"""Vehicles, models, tracker states and alarms."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from sqlalchemy import Connection, func, select, update

from sprung.model.tracking.tracker import Alarm
from sprung.service.store.engine import insert_or_ignore, upsert
from sprung.service.store.schema import alarms, models, tracker_states, vehicles, windows


@dataclass(frozen=True, slots=True)
class TrackerRow:
    """A vehicle's tracker as it was after its last window."""

    last_window_ns: int
    revision: int  # grows by one with every write: tells whether a copy in memory is still current
    state: dict[str, Any]


@dataclass(frozen=True, slots=True)
class AlarmRow:
    """One alarm as the store keeps it; the fields are those of the tracker's `Alarm`."""

    kind: str  # change, misfit
    parameter: str | None  # None for a misfit
    onset: int  # ns since epoch
    opened: int
    closed: int | None
    severity: str
    change: float | None  # relative to the vehicle's own baseline
    std: float | None
    peak: float | None
    report_id: str | None = None


@dataclass(frozen=True, slots=True)
class VehicleRow:
    """One line of the fleet."""

    id: str
    created_ns: int
    last_window_ns: int | None


def ensure_vehicle(connection: Connection, vehicle: str, now: int) -> None:
    """Make the vehicle known."""
    insert_or_ignore(connection, vehicles, [{"id": vehicle, "created_ns": now}])


def ensure_model(connection: Connection, digest: str, system: str, description: dict[str, Any], now: int) -> int:
    """The row number of a model, stored when it is new."""
    row = {"digest": digest, "system": system, "description": description, "created_ns": now}
    insert_or_ignore(connection, models, [row])
    return connection.execute(select(models.c.id).where(models.c.digest == digest)).scalar_one()


def list_vehicles(connection: Connection, limit: int, after: str = "") -> list[VehicleRow]:
    """Vehicles by id, `limit` of them after `after`."""
    last = (
        select(func.max(windows.c.start_ns))
        .where(windows.c.vehicle_id == vehicles.c.id)
        .correlate(vehicles)
        .scalar_subquery()
    )
    query = (
        select(vehicles.c.id, vehicles.c.created_ns, last)
        .where(vehicles.c.id > after)
        .order_by(vehicles.c.id)
        .limit(limit)
    )
    return [VehicleRow(*row) for row in connection.execute(query)]


def vehicle_exists(connection: Connection, vehicle: str) -> bool:
    """Whether anything was ever stored of the vehicle."""
    return connection.execute(select(vehicles.c.id).where(vehicles.c.id == vehicle)).first() is not None


def window_counts(connection: Connection, vehicle: str, model_id: int) -> dict[str, int]:
    """How many windows of each outcome are stored."""
    query = (
        select(windows.c.outcome, func.count())
        .where(windows.c.vehicle_id == vehicle, windows.c.model_id == model_id)
        .group_by(windows.c.outcome)
    )
    counts = {"used": 0, "repaired": 0, "dropped": 0}
    return counts | {outcome: count for outcome, count in connection.execute(query)}


def load_tracker(connection: Connection, vehicle: str, model_id: int) -> TrackerRow | None:
    """The stored tracker of a vehicle, or None before its first window."""
    table = tracker_states
    query = select(table.c.last_window_ns, table.c.revision, table.c.state).where(
        table.c.vehicle_id == vehicle, table.c.model_id == model_id
    )
    row = connection.execute(query).first()
    return None if row is None else TrackerRow(*row)


def tracker_revision(connection: Connection, vehicle: str, model_id: int) -> int | None:
    """The revision of the stored tracker, without reading its state."""
    query = select(tracker_states.c.revision).where(
        tracker_states.c.vehicle_id == vehicle, tracker_states.c.model_id == model_id
    )
    return connection.execute(query).scalar_one_or_none()


def save_tracker(connection: Connection, vehicle: str, model_id: int, row: TrackerRow, now: int) -> None:
    """Replace the vehicle's tracker."""
    values = {
        "vehicle_id": vehicle,
        "model_id": model_id,
        "last_window_ns": row.last_window_ns,
        "revision": row.revision,
        "state": row.state,
        "updated_ns": now,
    }
    upsert(connection, tracker_states, [values], key=("vehicle_id", "model_id"))


def save_alarms(connection: Connection, vehicle: str, model_id: int, found: Iterable[Alarm]) -> None:
    """Insert alarms or bring them up to date; a report that is attached stays attached."""
    values = [
        {
            "vehicle_id": vehicle,
            "model_id": model_id,
            "kind": alarm.kind,
            "parameter": alarm.parameter or "",
            "opened_ns": alarm.opened,
            "onset_ns": alarm.onset,
            "closed_ns": alarm.closed,
            "change": alarm.change,
            "std": alarm.std,
            "peak": alarm.peak,
            "severity": alarm.severity,
        }
        for alarm in found
    ]
    upsert(connection, alarms, values, key=("vehicle_id", "model_id", "kind", "parameter", "opened_ns"))


def list_alarms(
    connection: Connection, vehicle: str, model_id: int, limit: int, active_only: bool = False
) -> list[AlarmRow]:
    """Alarms of a vehicle, newest first."""
    columns = ("kind", "parameter", "onset_ns", "opened_ns", "closed_ns", "severity")
    query = (
        select(*(alarms.c[name] for name in (*columns, "change", "std", "peak", "report_id")))
        .where(alarms.c.vehicle_id == vehicle, alarms.c.model_id == model_id)
        .order_by(alarms.c.opened_ns.desc(), alarms.c.id.desc())
        .limit(limit)
    )
    if active_only:
        query = query.where(alarms.c.closed_ns.is_(None))
    return [AlarmRow(row[0], row[1] or None, *row[2:]) for row in connection.execute(query)]


def attach_report(connection: Connection, vehicle: str, model_id: int, report_id: str) -> None:
    """Make a report part of the vehicle's active alarms that have none."""
    connection.execute(
        update(alarms)
        .where(
            alarms.c.vehicle_id == vehicle,
            alarms.c.model_id == model_id,
            alarms.c.closed_ns.is_(None),
            alarms.c.report_id.is_(None),
        )
        .values(report_id=report_id)
    )


def recent_vehicles(connection: Connection, model_id: int, limit: int) -> list[str]:
    """Vehicles whose trackers were fed last, the newest first."""
    query = (
        select(tracker_states.c.vehicle_id)
        .where(tracker_states.c.model_id == model_id)
        .order_by(tracker_states.c.updated_ns.desc())
        .limit(limit)
    )
    return list(connection.execute(query).scalars())

"""Vehicles, models, tracker states and alarms."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

from sqlalchemy import Connection, Select, and_, func, or_, select, update

from sprung.model.tracking.tracker import Alarm
from sprung.service.store.engine import insert_or_ignore, upsert
from sprung.service.store.schema import LONGEST_NAME, STAGING, alarms, fleet_status, models, tracker_states, vehicles


@dataclass(frozen=True, slots=True)
class TrackerRow:
    """A vehicle's tracker as it was after its last window."""

    last_window_ns: int
    revision: int  # grows by one with every write: shows whether a copy in memory is still current
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
    id: int | None = None
    vehicle: str | None = None
    acknowledged: int | None = None  # ns since epoch
    acknowledged_by: str | None = None
    alternatives: tuple[str, ...] = ()  # what the evidence does not tell it from, "bogie1_1l.gain"


@dataclass(frozen=True, slots=True)
class AlarmChange:
    """Something about an alarm is new."""

    what: Literal["opened", "changed", "closed"]  # changed: its severity
    alarm: Alarm
    before: str | None  # severity as it was


def ensure_vehicle(connection: Connection, vehicle: str, now: int, listed: bool = True) -> None:
    """Make the vehicle known, and list it, though nothing was identified of it yet."""
    insert_or_ignore(connection, vehicles, [{"id": vehicle, "created_ns": now}])
    shown = models.c.id.not_in(staging_models())
    model = connection.execute(select(func.max(models.c.id)).where(shown)).scalar() if listed else None
    if model is not None:
        counted = ("used", "repaired", "dropped", "uninformative", "unfitting")
        numbers = ("revision", "urgency", "alarms", "warnings", "unacknowledged", "earlier", "learned", *counted)
        # nobody watches over it yet, as the tracker says of a vehicle without windows; listed behind those heard from
        health = "check_function"
        blank = {"vehicle_id": vehicle, "model_id": model, "health": health, "elements": "", "received_ns": now}
        insert_or_ignore(connection, fleet_status, [blank | dict.fromkeys(numbers, 0)])


def take_vehicles(connection: Connection, wanted: Collection[str], now: int, listed: bool = True) -> None:
    """`hold_vehicle` of several, in the order of their ids; one that is not known, or is to be listed and is not, is
    made so."""
    there = select(vehicles.c.id, fleet_status.c.vehicle_id.label("listed"))
    there = there.join(fleet_status, fleet_status.c.vehicle_id == vehicles.c.id, isouter=True)
    there = there.where(vehicles.c.id.in_(sorted(wanted))).order_by(vehicles.c.id)
    held = there.with_for_update(key_share=True, of=vehicles)
    fine = {row.id for row in connection.execute(held) if not listed or row.listed is not None}
    missing = sorted(set(wanted) - fine)
    for vehicle in missing:
        ensure_vehicle(connection, vehicle, now, listed)
    if missing:
        connection.execute(held).all()


def staging_models() -> Select[tuple[int]]:
    """Models whose history is not shown yet."""
    return select(models.c.id).where(models.c.digest.startswith(STAGING))


def hold_vehicle(connection: Connection, vehicle: str) -> None:
    """Keep other transactions from folding windows of the vehicle until this one ends; SQLite has one writer anyway.

    Whoever holds several takes them in the order of their ids.
    """
    connection.execute(select(vehicles.c.id).where(vehicles.c.id == vehicle).with_for_update(key_share=True))


def ensure_model(connection: Connection, digest: str, system: str, description: dict[str, Any], now: int) -> int:
    """The row number of a model, stored when it is new; see `known_model`."""
    there = known_model(connection, digest, description)
    if there is None:
        row = {"digest": digest, "system": system, "description": description, "created_ns": now}
        insert_or_ignore(connection, models, [row])
        there = connection.execute(select(models.c.id).where(models.c.digest == digest)).scalar_one()
    return there


def known_model(connection: Connection, digest: str, description: dict[str, Any]) -> int | None:
    """The row number of a stored model, or of one whose values mean the same; None: there is none.

    Other weights, or a system file with another name or other noises, do not make another vehicle: histories and
    baselines go on.
    """
    there = connection.execute(select(models.c.id).where(models.c.digest == digest)).scalar()
    if there is None and not digest.startswith(STAGING):
        return _of_same_values(connection, digest, description)
    return None if there is None else int(there)


def digest_of(connection: Connection, model_id: int) -> str:
    """Under which digest a model is stored; that of the weights in use may be a later one."""
    return str(connection.execute(select(models.c.digest).where(models.c.id == model_id)).scalar_one())


def _of_same_values(connection: Connection, digest: str, description: dict[str, Any]) -> int | None:
    """The newest stored model whose windows read alike and whose values mean the same."""
    shown = models.c.id.not_in(staging_models())
    stored = select(models.c.id, models.c.digest, models.c.description).where(shown).order_by(models.c.id.desc())
    for number, old_digest, old in connection.execute(stored):
        if "structure" not in old:  # of an earlier version: other weights of the same file at the most
            if old_digest.partition("-")[0] == digest.partition("-")[0] and old | description == description and old:
                return int(number)
        elif old == description:
            return int(number)
    return None


def vehicle_exists(connection: Connection, vehicle: str) -> bool:
    """Whether anything was ever stored of the vehicle."""
    return connection.execute(select(vehicles.c.id).where(vehicles.c.id == vehicle)).first() is not None


def load_tracker(connection: Connection, vehicle: str, model_id: int) -> TrackerRow | None:
    """The stored tracker of a vehicle, or None before its first window."""
    table = tracker_states
    query = select(table.c.last_window_ns, table.c.revision, table.c.state).where(
        table.c.vehicle_id == vehicle, table.c.model_id == model_id
    )
    row = connection.execute(query).first()
    return None if row is None else TrackerRow(*row)


def count_trackers(connection: Connection, model_id: int) -> int:
    """Vehicles that have a tracker."""
    query = select(func.count()).select_from(tracker_states).where(tracker_states.c.model_id == model_id)
    return int(connection.execute(query).scalar_one())


def latest_trackers(connection: Connection, model_id: int, most: int) -> list[TrackerRow]:
    """Stored trackers of the vehicles that ran last."""
    table = tracker_states
    query = select(table.c.last_window_ns, table.c.revision, table.c.state).where(table.c.model_id == model_id)
    rows = connection.execute(query.order_by(table.c.last_window_ns.desc()).limit(most))
    return [TrackerRow(*row) for row in rows]


def tracker_revisions(connection: Connection, wanted: Collection[str]) -> dict[tuple[str, int], int]:
    """The revisions of stored trackers, by vehicle and model, without reading their states."""
    table = tracker_states
    query = select(table.c.vehicle_id, table.c.model_id, table.c.revision).where(table.c.vehicle_id.in_(list(wanted)))
    return {(row[0], row[1]): row[2] for row in connection.execute(query)}


def save_trackers(connection: Connection, found: Mapping[tuple[str, int], TrackerRow], now: int) -> None:
    """Replace trackers, by vehicle and model."""
    rows = [
        {
            "vehicle_id": vehicle,
            "model_id": model_id,
            "last_window_ns": row.last_window_ns,
            "revision": row.revision,
            "state": row.state,
            "updated_ns": now,
        }
        for (vehicle, model_id), row in found.items()
    ]
    upsert(connection, tracker_states, rows, key=("vehicle_id", "model_id"))


def save_alarms(connection: Connection, vehicle: str, model_id: int, found: Iterable[Alarm]) -> list[AlarmChange]:
    """Insert alarms or bring them up to date; a report that is attached stays attached.  What is new about them."""
    found = list(found)
    changes = _changes(connection, vehicle, model_id, found)
    values = [
        {
            "vehicle_id": vehicle,
            "model_id": model_id,
            "kind": alarm.kind,
            "parameter": _stored_name(alarm),
            "opened_ns": alarm.opened,
            "onset_ns": alarm.onset,
            "closed_ns": alarm.closed,
            "change": alarm.change,
            "std": alarm.std,
            "peak": alarm.peak,
            "severity": alarm.severity,
            "alternatives": list(alarm.alternatives),
        }
        for alarm in found
    ]
    upsert(connection, alarms, values, key=("vehicle_id", "model_id", "kind", "parameter", "opened_ns"))
    return changes


def _changes(connection: Connection, vehicle: str, model_id: int, found: list[Alarm]) -> list[AlarmChange]:
    if not found:
        return []
    table = alarms
    query = select(table.c.kind, table.c.parameter, table.c.opened_ns, table.c.severity, table.c.closed_ns)
    query = query.where(table.c.vehicle_id == vehicle, table.c.model_id == model_id)
    query = query.where(table.c.opened_ns >= min(alarm.opened for alarm in found))
    stored = {(row.kind, row.parameter, row.opened_ns): row for row in connection.execute(query)}
    changes = []
    for alarm in found:
        row = stored.get((alarm.kind, _stored_name(alarm), alarm.opened))
        if row is None:
            changes.append(AlarmChange("opened", alarm, None))
        if alarm.closed is not None and (row is None or row.closed_ns is None):
            changes.append(AlarmChange("closed", alarm, None if row is None else row.severity))
        elif row is not None and row.closed_ns is None and row.severity != alarm.severity:
            changes.append(AlarmChange("changed", alarm, row.severity))
    return changes


def _stored_name(alarm: Alarm) -> str:
    """Of a fault that many channels share, what fits; empty for a misfit."""
    return (alarm.parameter or "")[:LONGEST_NAME]


@dataclass(frozen=True, slots=True)
class WantedAlarms:
    """Which alarms are asked for; None: any."""

    vehicle: str | None = None
    active: bool = False
    acknowledged: bool | None = None
    severity: str | None = None
    kind: str | None = None
    since: int | None = None  # opened at or after, ns
    number: int | None = None  # its id


def list_alarms(
    connection: Connection, wanted: WantedAlarms, limit: int, after: tuple[int, int] | None = None, offset: int = 0
) -> list[AlarmRow]:
    """Alarms of every model, newest first; `after` holds (opened, id) of the last one of the page before."""
    table = alarms
    names = ("kind", "parameter", "onset_ns", "opened_ns", "closed_ns", "severity", "change", "std", "peak")
    more = ("report_id", "id", "vehicle_id", "acknowledged_ns", "acknowledged_by", "alternatives")
    query = _asked_for(select(*(table.c[name] for name in (*names, *more))), wanted)
    query = query.order_by(table.c.opened_ns.desc(), table.c.id.desc()).limit(limit).offset(offset)
    if after is not None:
        opened, identity = after
        same = and_(table.c.opened_ns == opened, table.c.id < identity)
        query = query.where(or_(table.c.opened_ns < opened, same))
    return [_alarm_row(*row) for row in connection.execute(query)]


def _alarm_row(kind: str, parameter: str, *rest: Any) -> AlarmRow:
    *others, alternatives = rest
    return replace(AlarmRow(kind, parameter or None, *others), alternatives=tuple(alternatives or ()))


def count_alarms(connection: Connection, wanted: WantedAlarms) -> int:
    """How many alarms `list_alarms` has on all its pages together."""
    return int(connection.execute(_asked_for(select(func.count()).select_from(alarms), wanted)).scalar_one())


def _asked_for(query: Select[Any], wanted: WantedAlarms) -> Select[Any]:
    table = alarms
    query = query.where(table.c.model_id.not_in(staging_models()))
    for column, value in (
        ("vehicle_id", wanted.vehicle),
        ("severity", wanted.severity),
        ("kind", wanted.kind),
        ("id", wanted.number),
    ):
        if value is not None:
            query = query.where(table.c[column] == value)
    if wanted.active:
        query = query.where(table.c.closed_ns.is_(None))
    if wanted.acknowledged is not None:
        never = table.c.acknowledged_ns.is_(None)
        query = query.where(~never if wanted.acknowledged else never)
    if wanted.since is not None:
        query = query.where(table.c.opened_ns >= wanted.since)
    return query


def acknowledge(connection: Connection, alarm_id: int, actor: str, now: int) -> str | None:
    """Write down who has seen an alarm, once; its vehicle, or None where there is no such alarm."""
    vehicle = connection.execute(select(alarms.c.vehicle_id).where(alarms.c.id == alarm_id)).scalar_one_or_none()
    if vehicle is not None:
        connection.execute(
            update(alarms)
            .where(alarms.c.id == alarm_id, alarms.c.acknowledged_ns.is_(None))
            .values(acknowledged_ns=now, acknowledged_by=actor[:128])
        )
    return vehicle


def close_alarms_of_other_models(connection: Connection, vehicle: str, model_id: int, now: int) -> int:
    """A maintenance ends what an earlier model had raised: nothing else would ever close it."""
    closed = connection.execute(
        update(alarms)
        .where(alarms.c.vehicle_id == vehicle, alarms.c.model_id != model_id, alarms.c.closed_ns.is_(None))
        .values(closed_ns=now)
    )
    return closed.rowcount


def close_misfits_of_other_models(connection: Connection, vehicle: str, model_id: int, now: int) -> int:
    """That windows do not fit is said of a model: it ends with the model's use.  What was said of the vehicle stays."""
    closed = connection.execute(
        update(alarms)
        .where(alarms.c.vehicle_id == vehicle, alarms.c.model_id != model_id)
        .where(alarms.c.kind == "misfit", alarms.c.closed_ns.is_(None))
        .values(closed_ns=now)
    )
    return closed.rowcount


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


def recent_vehicles(connection: Connection, model_ids: Sequence[int], limit: int) -> list[str]:
    """Vehicles whose trackers were fed last under any of the models, the newest first."""
    query = (
        select(tracker_states.c.vehicle_id)
        .where(tracker_states.c.model_id.in_(model_ids))
        .group_by(tracker_states.c.vehicle_id)
        .order_by(func.max(tracker_states.c.updated_ns).desc())
        .limit(limit)
    )
    return list(connection.execute(query).scalars())

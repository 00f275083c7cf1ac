"""One row a vehicle for lists of the fleet: written with the tracker, sorted, filtered and paged by the database."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal

from sqlalchemy import ColumnElement, Connection, Select, and_, func, or_, select

from sprung.service.store.cursors import whole_number
from sprung.service.store.engine import upsert
from sprung.service.store.fleet import staging_models
from sprung.service.store.schema import alarms, fleet_status, tracker_states, vehicles, window_reasons, windows

HEALTHS = ("ok", "maintenance_required", "out_of_specification", "check_function", "failure")  # NE 107, worse last
COUNTED = ("used", "repaired", "dropped", "uninformative", "unfitting")
MOST_COUNTED = 499_999
MOST_REASONS = 200  # of one vehicle; further ones are counted as OTHER
OTHER = "other reasons"
Sort = Literal["urgency", "id", "last_window", "drift"]


@dataclass(frozen=True, slots=True)
class Status:
    """How a vehicle stands after its newest windows."""

    health: str
    alarms: int
    warnings: int
    largest: str | None  # parameter with the largest drift
    drift: float | None
    drift_std: float | None
    nrmse: float | None
    learned: float
    elements: str  # a letter an element: . learning, ? not identifiable, o ok, w warning, a alarm
    last_window_ns: int | None


@dataclass(frozen=True, slots=True)
class FleetRow:
    """One line of the fleet."""

    id: str
    label: str | None
    retired_ns: int | None
    health: str
    urgency: int
    alarms: int
    warnings: int
    unacknowledged: int
    earlier: int
    largest: str | None
    drift: float | None
    drift_std: float | None
    nrmse: float | None
    learned: float
    elements: str
    last_window_ns: int | None
    received_ns: int
    windows: dict[str, int]


@dataclass(frozen=True, slots=True)
class StatusFilter:
    """Which vehicles are asked for."""

    search: str = ""  # in the id or the label
    health: str | None = None
    silent_since: int | None = None  # only those from which nothing came since then, ns
    acknowledged: bool | None = None  # False: only those with alarms that nobody has acknowledged
    retired: bool = False  # those out of service instead of those in service
    fleet: str = ""  # only those whose ids begin so


@dataclass(frozen=True, slots=True)
class Reason:
    """How many windows of one outcome had one reason."""

    outcome: str
    reason: str
    windows: int
    last_ns: int


@dataclass(frozen=True, slots=True)
class NewStatus:
    """What is new of a vehicle's row."""

    vehicle: str
    model_id: int
    revision: int
    status: Status
    counts: Counter[str]  # of windows, added to those that were there


def save_statuses(connection: Connection, found: Sequence[NewStatus], now: int) -> None:
    """Replace the rows of vehicles that are known; `earlier` alarms are looked up."""
    table, rows = fleet_status, []
    for model_id in sorted({one.model_id for one in found}):
        of_model = {one.vehicle: one for one in found if one.model_id == model_id}
        query = select(vehicles.c.id, table, *_open_alarms(vehicles.c.id, model_id))
        query = query.select_from(vehicles.outerjoin(table, table.c.vehicle_id == vehicles.c.id))
        for row in connection.execute(query.where(vehicles.c.id.in_(list(of_model)))):
            rows.append(_merged(of_model[row.id], row, now))
    upsert(connection, table, rows, key=("vehicle_id",))


def _merged(new: NewStatus, row: Any, now: int) -> dict[str, Any]:
    """A vehicle's row, made of what is new and of the row that was there, if any, beside counts of open alarms."""
    status, counts = new.status, new.counts
    old = None if row.vehicle_id is None else row
    same = old is not None and old.model_id == new.model_id
    earlier = row.open_of_others
    numbers = {name: (getattr(old, name) if same else 0) + counts[name] for name in COUNTED}
    values = asdict(status)
    if status.nrmse is None and same and old is not None:
        values["nrmse"] = old.nrmse
    values |= numbers | {
        "vehicle_id": new.vehicle,
        "model_id": new.model_id,
        "revision": new.revision,
        "health": _worse(status.health, "maintenance_required" if earlier else "ok"),
        "earlier": earlier,
        "received_ns": now if old is None or any(counts.values()) else old.received_ns,
    }
    return values | _urgency(values["health"], row.open_in_all, row.open_unseen)


def refresh_urgency(connection: Connection, vehicle: str) -> None:
    """After an acknowledgement: how urgent the vehicle is now."""
    table = fleet_status
    row = connection.execute(select(table.c.health).where(table.c.vehicle_id == vehicle)).first()
    if row is not None:
        query = select(*_open_alarms(vehicles.c.id, 0)).select_from(vehicles).where(vehicles.c.id == vehicle)
        _, *counts = connection.execute(query).one()
        values = _urgency(row.health, *counts)
        connection.execute(table.update().where(table.c.vehicle_id == vehicle).values(**values))


def add_reasons(connection: Connection, vehicle: str, model_id: int, found: Iterable[tuple[str, str, int]]) -> None:
    """Count windows by outcome and reason; `found` holds (outcome, reason, start)."""
    table = window_reasons
    fresh: dict[tuple[str, str], list[int]] = {}
    for outcome, reason, start in found:
        fresh.setdefault((outcome, without_numbers(reason)), []).append(start)
    if not fresh:
        return
    where = (table.c.vehicle_id == vehicle, table.c.model_id == model_id)
    query = select(table.c.outcome, table.c.reason, table.c.windows, table.c.last_ns).where(*where)
    stored = {(row.outcome, row.reason): row for row in connection.execute(query)}
    merged: dict[tuple[str, str], list[int]] = {}
    for (outcome, reason), starts in fresh.items():
        room = (outcome, reason) in stored or len(stored) + len(merged) < MOST_REASONS
        merged.setdefault((outcome, reason if room else OTHER), []).extend(starts)
    rows = [
        {
            "vehicle_id": vehicle,
            "model_id": model_id,
            "outcome": key[0],
            "reason": key[1],
            "windows": len(starts) + (stored[key].windows if key in stored else 0),
            "last_ns": max(*starts, stored[key].last_ns if key in stored else 0),
        }
        for key, starts in merged.items()
    ]
    upsert(connection, table, rows, key=("vehicle_id", "model_id", "outcome", "reason"))


def count_reasons(connection: Connection, vehicle: str, model_id: int, further: Sequence[Any]) -> None:
    """Count why windows are as they are anew; `further` are rows whose kinds cannot be told from the windows."""
    table, mine = window_reasons, (windows.c.vehicle_id == vehicle, windows.c.model_id == model_id)
    counted = select(windows.c.outcome, windows.c.reason, func.count(), func.max(windows.c.start_ns))
    counted = counted.where(*mine, windows.c.reason.is_not(None)).group_by(windows.c.outcome, windows.c.reason)
    found: dict[tuple[str, str], list[int]] = {}
    for outcome, reason, count, last in connection.execute(counted):
        entry = found.setdefault((outcome, without_numbers(reason)), [0, 0])
        entry[0], entry[1] = entry[0] + count, max(entry[1], last)
    for row in further:
        if row.outcome == "unfitting":
            found[row.outcome, row.reason] = [row.windows, row.last_ns]
    most = sorted(found.items(), key=lambda item: -item[1][0])[:MOST_REASONS]
    rows = [
        {"vehicle_id": vehicle, "model_id": model_id, "outcome": key[0], "reason": key[1]}
        | {"windows": count, "last_ns": last}
        for key, (count, last) in most
    ]
    upsert(connection, table, rows, key=("vehicle_id", "model_id", "outcome", "reason"))


def count_windows(connection: Connection, vehicle: str, model_id: int) -> Counter[str]:
    """Windows of a vehicle by what became of them."""
    mine = (windows.c.vehicle_id == vehicle, windows.c.model_id == model_id)
    query = select(windows.c.outcome, func.count()).where(*mine).group_by(windows.c.outcome)
    counts = Counter({outcome: count for outcome, count in connection.execute(query)})
    misfits = select(func.count()).where(*mine, windows.c.adequate.is_(False), windows.c.outcome != "uninformative")
    counts["unfitting"] = connection.execute(misfits).scalar_one()
    return counts


def fleet_model(connection: Connection, vehicle: str) -> int | None:
    """The model under which a vehicle is listed with something that was identified; None before."""
    query = select(fleet_status.c.model_id).where(fleet_status.c.vehicle_id == vehicle, fleet_status.c.revision > 0)
    return connection.execute(query).scalar()


def forget_counts(connection: Connection, vehicle: str) -> None:
    """Set the windows of a vehicle's row to 0: they are counted anew."""
    table = fleet_status
    connection.execute(table.update().where(table.c.vehicle_id == vehicle).values(**dict.fromkeys(COUNTED, 0)))


def reasons_of(connection: Connection, vehicle: str, model_id: int) -> list[Reason]:
    """Why windows were dropped, repaired or did not fit; the most frequent first."""
    table = window_reasons
    query = (
        select(table.c.outcome, table.c.reason, table.c.windows, table.c.last_ns)
        .where(table.c.vehicle_id == vehicle, table.c.model_id == model_id)
        .order_by(table.c.windows.desc(), table.c.reason)
    )
    return [Reason(*row) for row in connection.execute(query)]


def fleet_page(
    connection: Connection, wanted: StatusFilter, sort: Sort, limit: int, offset: int = 0, after: str | None = None
) -> list[FleetRow]:
    """`limit` vehicles; `after` is the `cursor` of the last row of the page before."""
    query = _filtered(select(vehicles.c.label, vehicles.c.retired_ns, fleet_status), wanted)
    order = _order(sort)
    if after is not None:
        query = query.where(_beyond(sort, after))
    query = query.order_by(*order).limit(limit).offset(offset)
    return [_fleet_row(row) for row in connection.execute(query)]


def fleet_row(connection: Connection, vehicle: str) -> FleetRow | None:
    """One vehicle's line."""
    query = (
        select(vehicles.c.label, vehicles.c.retired_ns, fleet_status)
        .join(fleet_status, fleet_status.c.vehicle_id == vehicles.c.id)
        .where(vehicles.c.id == vehicle)
    )
    row = connection.execute(query).first()
    return None if row is None else _fleet_row(row)


def cursor(sort: Sort, row: FleetRow) -> str:
    """What `fleet_page` needs to go on after a row."""
    value = {"urgency": row.urgency, "last_window": row.last_window_ns or 0, "id": ""}.get(sort, "")
    if sort == "drift":
        value = repr(abs(row.drift or 0.0))
    return f"{value}:{row.id}"


def health_counts(connection: Connection, wanted: StatusFilter) -> dict[str, int]:
    """How many vehicles are in each state of health, whatever health is asked for."""
    anyhow = replace(wanted, health=None)
    query = _filtered(select(fleet_status.c.health, func.count()), anyhow).group_by(fleet_status.c.health)
    return dict.fromkeys(HEALTHS, 0) | {health: count for health, count in connection.execute(query)}


def alarmed_vehicles(connection: Connection) -> list[str]:
    """Vehicles in service that are not well, the most urgent last."""
    query = _filtered(select(fleet_status.c.vehicle_id), StatusFilter()).where(fleet_status.c.health != "ok")
    return list(connection.execute(query.order_by(fleet_status.c.urgency)).scalars())


def outdated(connection: Connection, model_id: int) -> list[str]:
    """Vehicles whose row is older than their tracker (a store of an earlier version, restored in part, or of a model
    that was in use before)."""
    query = (
        select(tracker_states.c.vehicle_id)
        .join(fleet_status, fleet_status.c.vehicle_id == tracker_states.c.vehicle_id, isouter=True)
        .where(tracker_states.c.model_id == model_id)
        .where(
            or_(
                fleet_status.c.revision.is_(None),
                fleet_status.c.revision == 0,
                fleet_status.c.model_id != model_id,  # of the model before
            )
        )
    )
    return list(connection.execute(query).scalars())


def without_numbers(reason: str) -> str:
    """A reason as a kind of reason: measured numbers in it are left out; limits ("longer than 10 s") and names with
    digits stay.

    >>> without_numbers("tells nothing without car_1l and 3 more"), without_numbers("a gap of 0.4 s")
    ('tells nothing without car_1l and others', 'a gap of N s')
    """
    reason = re.sub(r"\band \d+ more\b", "and others", reason)
    return re.sub(r"(?<![\w.])(?<!than )[-+]?\d+(\.\d+)?(?![\w.])", "N", reason)[:200]


def _filtered(query: Select[Any], wanted: StatusFilter) -> Select[Any]:
    table = fleet_status
    query = query.select_from(table.join(vehicles, vehicles.c.id == table.c.vehicle_id))
    query = query.where(vehicles.c.retired_ns.is_not(None) if wanted.retired else vehicles.c.retired_ns.is_(None))
    if wanted.fleet:
        query = query.where(func.substr(table.c.vehicle_id, 1, len(wanted.fleet)) == wanted.fleet)
    if wanted.search:
        text = wanted.search.lower()
        found = func.lower(vehicles.c.id).contains(text, autoescape=True)
        query = query.where(or_(found, func.lower(vehicles.c.label).contains(text, autoescape=True)))
    if wanted.health is not None:
        query = query.where(table.c.health == wanted.health)
    if wanted.silent_since is not None:
        query = query.where(table.c.received_ns < wanted.silent_since)
    if wanted.acknowledged is not None:
        none_left = table.c.unacknowledged == 0
        query = query.where(none_left if wanted.acknowledged else ~none_left)
    return query


def _order(sort: Sort) -> Sequence[ColumnElement[Any]]:
    column, identity = _key(sort), fleet_status.c.vehicle_id.asc()
    return (identity,) if column is None else (column.desc(), identity)


def _key(sort: Sort) -> ColumnElement[Any] | None:
    if sort == "urgency":
        return fleet_status.c.urgency
    if sort == "last_window":
        return func.coalesce(fleet_status.c.last_window_ns, 0)
    if sort == "drift":
        return func.abs(func.coalesce(fleet_status.c.drift, 0.0))
    return None


def _beyond(sort: Sort, after: str) -> ColumnElement[bool]:
    """Rows behind a cursor.  Raises ValueError for what is none."""
    value, colon, identity = after.partition(":")
    column, own = _key(sort), fleet_status.c.vehicle_id
    if not colon or not identity:
        raise ValueError(after)
    if column is None:
        if value:
            raise ValueError(after)
        return own > identity
    number = float(value) if sort == "drift" else whole_number(value)
    return or_(column < number, and_(column == number, own > identity))


def _fleet_row(row: Any) -> FleetRow:
    own = {name: getattr(row, name) for name in FleetRow.__slots__ if name not in ("id", "windows")}
    return FleetRow(id=row.vehicle_id, windows={name: getattr(row, name) for name in COUNTED}, **own)


def _open_alarms(vehicle: ColumnElement[str], model_id: int) -> Sequence[ColumnElement[int]]:
    """Open alarms of the vehicle of a row: how many of other models, in all, and not acknowledged."""
    shown = alarms.c.model_id.not_in(staging_models())
    open_ = select(func.count()).where(alarms.c.vehicle_id == vehicle, alarms.c.closed_ns.is_(None), shown)
    return (
        open_.where(alarms.c.model_id != model_id).scalar_subquery().label("open_of_others"),
        open_.scalar_subquery().label("open_in_all"),
        open_.where(alarms.c.acknowledged_ns.is_(None)).scalar_subquery().label("open_unseen"),
    )


def _urgency(health: str, total: int, unacknowledged: int) -> dict[str, int]:
    rank = HEALTHS.index(health) if health in HEALTHS else 1
    number = min(total, MOST_COUNTED) + (MOST_COUNTED + 1) * (unacknowledged > 0)
    return {"unacknowledged": unacknowledged, "urgency": rank * 1_000_000 + number}


def _worse(one: str, other: str) -> str:
    known = [health for health in (one, other) if health in HEALTHS]
    return max(known, key=HEALTHS.index) if len(known) == 2 else one

"""A history that is being made beside the one that is shown, and its way into that one's place.

It lies under a model of its own, whose digest begins with `staging:`; lists of alarms and vehicles leave it out.  A
swap is one transaction a vehicle: readers see the old history or the new one, never a gap.
"""

from __future__ import annotations

import hashlib
from typing import Any

from sqlalchemy import Connection, delete, func, select, update

from sprung.service.store import fleet, history, status
from sprung.service.store.engine import upsert
from sprung.service.store.schema import STAGING, alarms, rollups, tracker_states, window_reasons, windows
from sprung.service.store.windows import VehicleWindows, windows_between
from sprung.service.times import NANOSECONDS

HOUR = 3600 * NANOSECONDS
TOGETHER = 2000  # windows whose roll-ups are made together


def staging_digest(digest: str, name: str) -> str:
    """Under which the history of a model is made, by the work called `name`."""
    return STAGING + hashlib.sha256(f"{name} {digest}".encode()).hexdigest()


def swap(connection: Connection, vehicle: str, staged: int, target: int, now: int) -> bool:
    """Put the staged history of a vehicle in the place of the target's, for the time that it spans.

    What the target knows of other times stays; its tracker stays where it has seen later windows.  Hold the vehicle
    before.  Whether anything was staged.
    """
    mine = (windows.c.vehicle_id == vehicle, windows.c.model_id == staged)
    first, last = connection.execute(
        select(func.min(windows.c.start_ns), func.max(windows.c.start_ns)).where(*mine)
    ).one()
    if first is None:
        return False
    of_target = (windows.c.vehicle_id == vehicle, windows.c.model_id == target)
    connection.execute(delete(windows).where(*of_target, windows.c.start_ns >= first, windows.c.start_ns <= last))
    connection.execute(update(windows).where(*mine).values(model_id=target))
    _rollups(connection, vehicle, staged, target, (first, last), now)
    _reasons(connection, vehicle, staged, target)
    _alarms(connection, vehicle, staged, target, first, last)
    _tracker(connection, vehicle, staged, target, now)
    return True


def _rollups(connection: Connection, vehicle: str, staged: int, target: int, span: tuple[int, int], now: int) -> None:
    begin, end = span[0] // HOUR * HOUR, span[1] // HOUR * HOUR + HOUR
    own = rollups.c.vehicle_id == vehicle
    connection.execute(delete(rollups).where(own, rollups.c.model_id == staged))
    inside = (rollups.c.bucket_ns >= begin, rollups.c.bucket_ns < end)
    connection.execute(delete(rollups).where(own, rollups.c.model_id == target, *inside))
    for records in windows_between(connection, vehicle, target, begin, end, TOGETHER):
        history.add_to_rollups(connection, [VehicleWindows(vehicle, target, records)], now)


def _reasons(connection: Connection, vehicle: str, staged: int, target: int) -> None:
    table = window_reasons
    mine = (table.c.vehicle_id == vehicle, table.c.model_id == staged)
    found = connection.execute(select(table).where(*mine)).all()
    connection.execute(delete(table).where(table.c.vehicle_id == vehicle, table.c.model_id.in_((staged, target))))
    status.count_reasons(connection, vehicle, target, found)


def _alarms(connection: Connection, vehicle: str, staged: int, target: int, first: int, last: int) -> None:
    """What people have seen or a report belongs to stays."""
    table = alarms
    own = table.c.vehicle_id == vehicle
    untouched = (table.c.acknowledged_ns.is_(None), table.c.report_id.is_(None))
    inside = (table.c.opened_ns >= first, table.c.opened_ns <= last)
    connection.execute(delete(table).where(own, table.c.model_id == target, *inside, *untouched))
    rows: list[dict[str, Any]] = []
    for row in connection.execute(select(table).where(own, table.c.model_id == staged)).mappings():
        kept = {name: value for name, value in row.items() if name not in ("id", "report_id")}
        rows.append({name: v for name, v in kept.items() if "acknowledged" not in name} | {"model_id": target})
    connection.execute(delete(table).where(own, table.c.model_id == staged))
    upsert(connection, table, rows, key=("vehicle_id", "model_id", "kind", "parameter", "opened_ns"))


def _tracker(connection: Connection, vehicle: str, staged: int, target: int, now: int) -> None:
    new, old = fleet.load_tracker(connection, vehicle, staged), fleet.load_tracker(connection, vehicle, target)
    table = tracker_states
    connection.execute(delete(table).where(table.c.vehicle_id == vehicle, table.c.model_id == staged))
    if new is not None and (old is None or old.last_window_ns <= new.last_window_ns):
        revision = 1 + max(new.revision, 0 if old is None else old.revision)
        row = fleet.TrackerRow(new.last_window_ns, revision, new.state)
        fleet.save_trackers(connection, {(vehicle, target): row}, now)

"""Estimates that were received and wait for the windows before them: kept with the acknowledgement, folded in order."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from sqlalchemy import Connection, delete, or_, select

from sprung.service.store.engine import insert_or_ignore
from sprung.service.store.schema import pending


@dataclass(frozen=True, slots=True)
class Waiting:
    """One window as it came."""

    start: int  # ns since epoch
    received: int  # ns since epoch, by this machine's clock
    message: bytes  # as `service.fleet.message` writes one window


def waiting(connection: Connection, models: Mapping[str, int]) -> dict[str, list[Waiting]]:
    """What waits of vehicles under their `models`, in order of time; vehicles of which nothing waits are left out."""
    query = (
        select(pending.c.vehicle_id, pending.c.model_id, pending.c.start_ns, pending.c.received_ns, pending.c.message)
        .where(pending.c.vehicle_id.in_(list(models)))
        .order_by(pending.c.start_ns)
    )
    found: dict[str, list[Waiting]] = {}
    for vehicle, model_id, *row in connection.execute(query):
        if model_id == models[vehicle]:
            found.setdefault(vehicle, []).append(Waiting(*row))
    return found


def keep(connection: Connection, vehicle: str, model_id: int, rows: Iterable[Waiting]) -> None:
    """Store what is to wait; what waits already is left as it is."""
    shared = {"vehicle_id": vehicle, "model_id": model_id}
    values = [shared | {"start_ns": row.start, "received_ns": row.received, "message": row.message} for row in rows]
    insert_or_ignore(connection, pending, values)


def release(connection: Connection, vehicle: str, model_id: int, starts: Iterable[int]) -> None:
    """Forget what was folded."""
    mine = (pending.c.vehicle_id == vehicle, pending.c.model_id == model_id)
    chosen = list(starts)
    for first in range(0, len(chosen), 500):
        connection.execute(delete(pending).where(*mine, pending.c.start_ns.in_(chosen[first : first + 500])))


def overdue(connection: Connection, model_ids: Sequence[int], before: int, ahead: int) -> list[str]:
    """Vehicles of which something has waited since before a time, ns, in the order of their ids; or since a time that
    lies `ahead`: by a clock that has been set back."""
    query = (
        select(pending.c.vehicle_id)
        .where(pending.c.model_id.in_(model_ids), or_(pending.c.received_ns < before, pending.c.received_ns > ahead))
        .distinct()
        .order_by(pending.c.vehicle_id)
    )
    return list(connection.execute(query).scalars())

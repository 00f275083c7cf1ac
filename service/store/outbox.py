"""Notifications on their way: written down before they are sent, so that none is lost, and kept when they fail."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from sqlalchemy import Connection, delete, insert, select, update

from sprung.service.store.schema import deliveries


@dataclass(frozen=True, slots=True)
class DeliveryRow:
    """One event for one receiver."""

    id: str
    kind: str  # type of the event
    target: str  # an URL, or mailto:ADDRESS
    event: dict[str, Any]  # CloudEvents 1.0, structured
    state: str  # waiting, delivered, dead
    attempts: int
    next_ns: int
    error: str | None
    created_ns: int
    updated_ns: int


def add_delivery(connection: Connection, row: DeliveryRow) -> None:
    """Accept a notification."""
    connection.execute(insert(deliveries).values(**{name: getattr(row, name) for name in DeliveryRow.__slots__}))


def targets(connection: Connection) -> list[str]:
    """Receivers that something waits for."""
    query = select(deliveries.c.target).where(deliveries.c.state == "waiting").distinct()
    return list(connection.execute(query.order_by(deliveries.c.target)).scalars())


def due(connection: Connection, now: int, target: str, limit: int) -> list[DeliveryRow]:
    """Those of a receiver to be tried now, the longest waiting first."""
    table = deliveries
    mine = (table.c.state == "waiting", table.c.target == target, table.c.next_ns <= now)
    query = select(table).where(*mine).order_by(table.c.next_ns, table.c.created_ns)
    return [DeliveryRow(*row) for row in connection.execute(query.limit(limit))]


def settle(connection: Connection, delivery: str, now: int, **values: Any) -> None:
    """Write down what an attempt came to."""
    connection.execute(update(deliveries).where(deliveries.c.id == delivery).values(updated_ns=now, **values))


def forget_deliveries(connection: Connection, before: int) -> int:
    """Delete delivered and dead ones that were settled before a time."""
    done = deliveries.c.state != "waiting"
    return connection.execute(delete(deliveries).where(done, deliveries.c.updated_ns < before)).rowcount

"""Notifications on their way: written down before they are sent, so that none is lost, and kept when they fail."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from typing import Any

from sqlalchemy import Connection, and_, delete, func, insert, or_, select, update

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


def due(connection: Connection, now: int, target: str, limit: int, ahead: int) -> list[DeliveryRow]:
    """Those of a receiver to be tried now, the longest waiting first.

    ahead: ns, a time that no pause reaches: what is to wait until then was written down by a clock that has been set
    back, and is tried now.
    """
    table = deliveries
    now_or_never = or_(table.c.next_ns <= now, table.c.next_ns > ahead)
    mine = (table.c.state == "waiting", table.c.target == target, now_or_never)
    query = select(table).where(*mine).order_by(table.c.next_ns, table.c.created_ns)
    return [DeliveryRow(*row) for row in connection.execute(query.limit(limit))]


def settle(connection: Connection, delivery: str, now: int, **values: Any) -> None:
    """Write down what an attempt came to."""
    connection.execute(update(deliveries).where(deliveries.c.id == delivery).values(updated_ns=now, **values))


def newest_of_sources(connection: Connection) -> list[tuple[str, str, str]]:
    """(source, kind, id) of the newest events that tell of a source, of each."""
    source = deliveries.c.event["data"]["source"].as_string().label("source")
    query = select(deliveries.c.id, deliveries.c.kind, deliveries.c.created_ns, source)
    of_sources = query.where(source.is_not(None)).subquery()
    last = (
        select(of_sources.c.source, func.max(of_sources.c.created_ns).label("at"))
        .group_by(of_sources.c.source)
        .subquery()
    )
    newest = and_(of_sources.c.source == last.c.source, of_sources.c.created_ns == last.c.at)
    found = connection.execute(select(of_sources.c.source, of_sources.c.kind, of_sources.c.id).join(last, newest))
    return [(row.source, row.kind, row.id) for row in found]


def forget_deliveries(connection: Connection, before: int, kept: Collection[str] = ()) -> int:
    """Delete delivered and dead ones that were settled before a time, but for those that are `kept`, by their ids."""
    old = (deliveries.c.state != "waiting", deliveries.c.updated_ns < before, deliveries.c.id.not_in(kept))
    return connection.execute(delete(deliveries).where(*old)).rowcount

"""Who did what, and when; never changed.

A deed is noted in the transaction that does it; signing in and out, which the store does not know, right after it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from sqlalchemy import Connection, insert, select

from sprung.service.store.schema import audit


@dataclass(frozen=True, slots=True)
class AuditRow:
    """One deed."""

    id: int
    time_ns: int
    actor: str  # the token's or user's name; "local" where no token is needed
    action: str  # such as upload, diagnose, acknowledge
    target: str  # what it was done to
    detail: dict[str, Any] | None


def record(
    connection: Connection, actor: str, action: str, target: str, detail: dict[str, Any] | None, now: int
) -> None:
    """Write down a deed."""
    row = {"time_ns": now, "actor": actor[:160], "action": action[:60], "target": target[:200], "detail": detail}
    connection.execute(insert(audit).values(**row))


def entries(connection: Connection, limit: int, before: int | None = None) -> list[AuditRow]:
    """The newest deeds first; `before`: older than the one with this id."""
    query = select(audit).order_by(audit.c.id.desc()).limit(limit)
    if before is not None:
        query = query.where(audit.c.id < before)
    return [AuditRow(*row) for row in connection.execute(query)]

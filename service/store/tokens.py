"""Access tokens: only digests of their secrets are kept."""

from __future__ import annotations

from dataclasses import dataclass

from sqlalchemy import Connection, func, insert, select, update

from sprung.service.store.schema import tokens


@dataclass(frozen=True, slots=True)
class TokenRow:
    """One token; the fields are those of the table."""

    id: str
    digest: str
    name: str
    scopes: list[str]
    fleet: str  # vehicles whose ids begin so; empty: all
    created_ns: int
    expires_ns: int | None
    revoked_ns: int | None


def add(connection: Connection, row: TokenRow) -> None:
    """Store a token."""
    connection.execute(insert(tokens).values(**{name: getattr(row, name) for name in row.__slots__}))


def get(connection: Connection, token_id: str) -> TokenRow | None:
    """A token by its public part."""
    row = connection.execute(select(tokens).where(tokens.c.id == token_id)).first()
    return None if row is None else TokenRow(*row)


def list_all(connection: Connection) -> list[TokenRow]:
    """Every token, the newest first."""
    return [TokenRow(*row) for row in connection.execute(select(tokens).order_by(tokens.c.created_ns.desc()))]


def count(connection: Connection) -> int:
    """How many there are or were."""
    return int(connection.execute(select(func.count()).select_from(tokens)).scalar_one())


def revoke(connection: Connection, token_id: str, now: int) -> bool:
    """Make a token worthless; whether there was one that was not."""
    query = update(tokens).where(tokens.c.id == token_id, tokens.c.revoked_ns.is_(None)).values(revoked_ns=now)
    return connection.execute(query).rowcount > 0


def expire(connection: Connection, token_id: str, at: int) -> int:
    """Let a token end at a time, if it does not end before; when it ends, ns."""
    row = get(connection, token_id)
    if row is not None and row.expires_ns is not None and row.expires_ns <= at:
        return row.expires_ns
    connection.execute(update(tokens).where(tokens.c.id == token_id).values(expires_ns=at))
    return at

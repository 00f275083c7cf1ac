"""Who may ask: bearer tokens with scopes, a fleet and an end; and sessions of people who signed in with one.

A token is `sprung_ID_SECRET`.  The secret has 256 random bits, so its SHA-256 reveals nothing and needs no salt or
stretching; only that is stored.
"""

from __future__ import annotations

import hashlib
import hmac
import re
import secrets
import threading
import time
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass

from cachetools import TTLCache
from sqlalchemy import Connection

from sprung.model.text import IN_VEHICLE_IDS, hidden_character
from sprung.service.errors import NotFound, UserError
from sprung.service.store import Store, audit, tokens
from sprung.service.store.tokens import TokenRow
from sprung.service.times import NANOSECONDS, now_ns

SCOPES = ("read", "ingest", "operate", "admin")
IMPLIED = {"admin": {"read", "ingest", "operate", "admin"}, "operate": {"operate", "read"}}
PREFIX = "sprung"
FLEET = re.compile(f"([A-Za-z0-9][{IN_VEHICLE_IDS}]*)?")  # how a vehicle's id may begin; empty: all
REMEMBER_SECONDS = 5.0  # for which a token that was revoked may still be taken
MOST_REMEMBERED = 1000
SESSION_SECONDS = 12 * 3600.0
MOST_SESSIONS = 1000
DAY = 86_400 * NANOSECONDS


@dataclass(frozen=True, slots=True)
class Actor:
    """Who sends a request, and what he may do."""

    name: str = "local"
    scopes: frozenset[str] = frozenset(SCOPES)
    fleet: str = ""  # vehicles whose ids begin so; empty: all
    key: str = ""  # of the token or person, for limits of one client: names are chosen, and may be those of others

    def may(self, scope: str) -> bool:
        """Whether a scope allows it, by itself or as part of a greater one."""
        return any(scope in IMPLIED.get(held, {held}) for held in self.scopes)

    def sees(self, vehicle: str | None) -> bool:
        """Whether a vehicle (None: of no vehicle in particular) is of his fleet."""
        return not self.fleet or (vehicle is not None and vehicle.startswith(self.fleet))


class Refused(Exception):
    """A token that is no good; the message says why."""


@dataclass(frozen=True, slots=True)
class _Session:
    """Of somebody who signed in."""

    ends: float  # time.monotonic()
    owner: Callable[[], Actor]
    key: str  # of whose it is


class Tokens:
    """Safe to share between threads."""

    def __init__(self, store: Store, admin_token: str | None = None, clock: Callable[[], int] = now_ns) -> None:
        """admin_token: one more secret that allows everything, from the settings."""
        self._store = store
        self._admin = None if admin_token is None else digest_of(admin_token)
        self._clock = clock
        self._known: TTLCache[str, TokenRow | None] = TTLCache(MOST_REMEMBERED, REMEMBER_SECONDS)
        self._sessions: dict[str, _Session] = {}  # by digest, the oldest first
        self._counted: tuple[float, bool] = (-1e9, False)
        self._lock = threading.Lock()

    def create(
        self, name: str, scopes: Sequence[str], fleet: str = "", days: float | None = None, by: str = "local"
    ) -> tuple[str, TokenRow]:
        """A new token: its text, which is shown once, and its row.  Raises UserError."""
        unknown = [scope for scope in scopes if scope not in SCOPES]
        if unknown or not scopes:
            raise UserError(f"scope {', '.join(unknown) or 'is missing'}: known are {', '.join(SCOPES)}")
        if not name or len(name) > 128 or len(fleet) > 128:
            raise UserError("a token needs a name, and name and fleet have at most 128 characters")
        if hidden_character(name):
            raise UserError(f"a token's name cannot hold control characters: {name!r}")
        if not FLEET.fullmatch(fleet):
            raise UserError(f"no vehicle's id can begin with {fleet!r}: letters, digits and . _ : - only")
        if days is not None and not 0 < days < 36_500:
            raise UserError("a token lasts for more than 0 and less than 36500 days")
        text, row = self._made(name, scopes, fleet, days)
        with self._store.write() as connection:
            self._add(connection, row, "create token", {}, by)
        self._forget()
        return text, row

    def _made(self, name: str, scopes: Sequence[str], fleet: str, days: float | None) -> tuple[str, TokenRow]:
        token_id, secret = secrets.token_hex(6), secrets.token_urlsafe(32)
        text = f"{PREFIX}_{token_id}_{secret}"
        now = self._clock()
        expires = None if days is None else now + round(days * DAY)
        return text, TokenRow(token_id, digest_of(text), name, list(scopes), fleet, now, expires, None)

    def _add(self, connection: Connection, row: TokenRow, action: str, more: dict[str, str], by: str) -> None:
        tokens.add(connection, row)
        detail = {"name": row.name, "scopes": row.scopes, "fleet": row.fleet} | more
        audit.record(connection, by, action, row.id, detail, row.created_ns)

    def rotate(self, token_id: str, hours: float = 24.0, by: str = "local") -> tuple[str, TokenRow, int]:
        """A new token like an old one, which ends in `hours`, if it does not end before; its text, its row, and when
        the old one ends, ns.

        Raises NotFound, and UserError for an old one that is worth nothing any more: it would come to life again.
        """
        with self._store.read() as connection:
            old = tokens.get(connection, token_id)
        if old is None:
            raise NotFound(f"no token {token_id[:40]!r}")
        now = self._clock()
        if (wrong := _worthless(old, now)) is not None:
            raise UserError(f"token {token_id}: {wrong}; make a new one")
        left = None if old.expires_ns is None else max((old.expires_ns - old.created_ns) / DAY, 1e-6)
        text, row = self._made(old.name, old.scopes, old.fleet, left)
        with self._store.write() as connection:
            self._add(connection, row, "rotate token", {"before": token_id}, by)
            ends = tokens.expire(connection, token_id, now + round(hours * 3600 * NANOSECONDS))
        self._forget()
        return text, row, ends

    def revoke(self, token_id: str, by: str = "local") -> None:
        """Make a token worthless.  Raises NotFound."""
        now = self._clock()
        with self._store.write() as connection:
            if not _revoked(connection, token_id, now, by):
                raise NotFound(f"no token {token_id[:40]!r} that is not revoked")
        self._forget()

    def revoke_all(self, by: str = "local") -> list[TokenRow]:
        """Make every token worthless; those that were not revoked before, the newest first."""
        now = self._clock()
        with self._store.write() as connection:
            revoked = [row for row in tokens.list_all(connection) if _revoked(connection, row.id, now, by)]
        self._forget()
        return revoked

    def rows(self) -> list[TokenRow]:
        """Every token, the newest first."""
        with self._store.read() as connection:
            return tokens.list_all(connection)

    @property
    def any(self) -> bool:
        """Whether there is or was a token: then requests need one, also when all have been revoked."""
        if self._admin is not None:
            return True
        at, found = self._counted
        if not found and time.monotonic() - at > REMEMBER_SECONDS:
            with self._store.read() as connection:
                found = tokens.count(connection) > 0
            self._counted = (time.monotonic(), found)
        return found

    def actor(self, text: str) -> Actor:
        """Who a token belongs to.  Raises Refused."""
        digest = digest_of(text)
        if self._admin is not None and hmac.compare_digest(digest, self._admin):
            return Actor("admin", frozenset({"admin"}), key="admin")
        parts = text.split("_", 2)
        row = self._row(parts[1]) if len(parts) == 3 and parts[0] == PREFIX and len(parts[1]) == 12 else None
        if row is None or not hmac.compare_digest(digest, row.digest):
            raise Refused("the token is not known")
        return self._valid(row)

    def sign_in(self, text: str) -> tuple[str, Actor]:
        """A session of the token's owner, that ends with the token, and who that is.  Raises Refused."""
        actor = self.actor(text)
        return self.open_session(lambda: self.actor(text), SESSION_SECONDS, actor.key), actor

    def open_session(self, owner: Callable[[], Actor], seconds: float, key: str) -> str:
        """A session; `owner` is asked with each request and may raise Refused.

        When there are too many, who has most of them by `key` loses the oldest: nobody signs others out.
        """
        session = secrets.token_urlsafe(32)
        with self._lock:
            self._sessions[digest_of(session)] = _Session(time.monotonic() + seconds, owner, key)
            if len(self._sessions) > MOST_SESSIONS:
                greedy = Counter(one.key for one in self._sessions.values()).most_common(1)[0][0]
                del self._sessions[next(digest for digest, one in self._sessions.items() if one.key == greedy)]
        return session

    def sign_out(self, session: str) -> Actor | None:
        """End a session; whose it was, None if it was over."""
        try:
            actor = self.session(session)
        except Refused:
            actor = None
        with self._lock:
            self._sessions.pop(digest_of(session), None)
        return actor

    def session(self, session: str) -> Actor:
        """Whose session it is; ends with its token.  Raises Refused."""
        with self._lock:
            found = self._sessions.get(digest_of(session))
        if found is None or found.ends < time.monotonic():
            raise Refused("the session is over; sign in again")
        return found.owner()

    def _valid(self, row: TokenRow) -> Actor:
        if (wrong := _worthless(row, self._clock())) is not None:
            raise Refused(f"the token {wrong}")
        return Actor(row.name, frozenset(row.scopes), row.fleet, row.id)

    def _row(self, token_id: str) -> TokenRow | None:
        with self._lock, suppress(KeyError):
            return self._known[token_id]
        with self._store.read() as connection:
            row = tokens.get(connection, token_id)
        with self._lock:
            self._known[token_id] = row
        return row

    def _forget(self) -> None:
        with self._lock:
            self._known.clear()
        self._counted = (-1e9, False)


def _revoked(connection: Connection, token_id: str, now: int, by: str) -> bool:
    """Whether a token was not revoked before; it is now, and that is in the audit log."""
    found = tokens.revoke(connection, token_id, now)
    if found:
        audit.record(connection, by, "revoke token", token_id, None, now)
    return found


def _worthless(row: TokenRow, now: int) -> str | None:
    """Why a token is no good any more, None while it is."""
    if row.revoked_ns is not None:
        return "was revoked"
    return "has expired" if row.expires_ns is not None and row.expires_ns <= now else None


def digest_of(text: str) -> str:
    """SHA-256 in hex."""
    return hashlib.sha256(text.encode()).hexdigest()

"""`sprung token`."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from sprung.service.access.tokens import Tokens
from sprung.service.errors import UserError
from sprung.service.settings import settings_with
from sprung.service.store import open_store
from sprung.service.times import optional_iso, to_iso


@contextmanager
def opened(data_dir: Path | None, store: str | None, there: bool = True) -> Iterator[Tokens]:
    """The tokens of a store."""
    found = open_store(settings_with({"data_dir": data_dir, "store": store}).store_url, there=there)
    try:
        yield Tokens(found)
    finally:
        found.close()


def create(name: str, scopes: str, fleet: str | None, days: float, data_dir: Path | None, store: str | None) -> int:
    """Make a token and print it; it cannot be shown again."""
    if fleet == "":  # of a variable that nobody set: the token would be good for every vehicle
        raise UserError("--fleet is empty; leave it out for a token for all vehicles")
    with opened(data_dir, store, there=False) as tokens:
        wanted = [scope.strip() for scope in scopes.split(",") if scope.strip()]
        text, row = tokens.create(name, wanted, fleet or "", days or None)
    ends = "does not end" if row.expires_ns is None else f"ends {to_iso(row.expires_ns)}"
    print(text)
    print(f"token {row.id} of {name}: {', '.join(row.scopes)}; {ends}; it is shown this once", file=sys.stderr)
    return 0


def rotate(token_id: str, hours: float, data_dir: Path | None, store: str | None) -> int:
    """Make a token like an old one, and let that end."""
    with opened(data_dir, store) as tokens:
        try:
            text, row, ends = tokens.rotate(token_id, hours)
        except LookupError as error:
            raise UserError(str(error)) from None
    print(text)
    print(f"token {row.id} takes the place of {token_id}, which ends {to_iso(ends)}", file=sys.stderr)
    return 0


def revoke(token_id: str | None, every: bool, data_dir: Path | None, store: str | None) -> int:
    """Make a token worthless, or all of them, which are then printed."""
    if every == (token_id is not None):
        raise UserError("give the ID of a token, as sprung token list shows it, or --all")
    with opened(data_dir, store) as tokens:
        if token_id is None:
            for row in tokens.revoke_all():
                print(f"{row.id}  {row.name}")
            return 0
        try:
            tokens.revoke(token_id)
        except LookupError as error:
            raise UserError(str(error)) from None
    return 0


def show(json_lines: bool, data_dir: Path | None, store: str | None) -> int:
    """List the tokens."""
    with opened(data_dir, store) as tokens:
        rows = tokens.rows()
    for row in rows:
        state = "revoked" if row.revoked_ns is not None else optional_iso(row.expires_ns) or "no end"
        if json_lines:
            print(json.dumps({"id": row.id, "name": row.name, "scopes": row.scopes, "fleet": row.fleet, "ends": state}))
        else:
            print(f"{row.id}  {row.name:24s} {','.join(row.scopes):24s} {row.fleet or 'all vehicles':20s} {state}")
    return 0

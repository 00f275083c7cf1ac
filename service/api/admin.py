"""Tokens, the audit log, and a profile of the process."""

from __future__ import annotations

import sys
import threading
import time
from collections import Counter
from types import FrameType
from typing import Annotated, Any, Literal

from fastapi import APIRouter, Query
from fastapi.concurrency import run_in_threadpool
from fastapi.responses import PlainTextResponse, Response
from pydantic import Field

from sprung.service.access.tokens import FLEET
from sprung.service.api.access import CoreOf, read
from sprung.service.api.actors import ActorOf
from sprung.service.api.answers import json_response
from sprung.service.api.bodies import LINE, StrictBody
from sprung.service.errors import Busy
from sprung.service.store import audit
from sprung.service.store.tokens import TokenRow
from sprung.service.times import optional_iso, to_iso

router = APIRouter(tags=["operation"])
pages = APIRouter(include_in_schema=False)
SAMPLE_SECONDS = 0.01
MOST_STACKS = 2000
PROFILE_SECONDS = 30
_profiling = threading.Lock()


Scope = Literal["read", "ingest", "operate", "admin"]


class TokenBody(StrictBody):
    """A token to be made."""

    name: Annotated[str, Field(min_length=1, max_length=128), *LINE]
    scopes: Annotated[list[Scope], Field(min_length=1, max_length=4)]
    fleet: Annotated[
        str, Field(max_length=128, pattern=f"^{FLEET.pattern}$", description="vehicles whose ids begin so; empty: all")
    ] = ""
    days: Annotated[float | None, Field(gt=0, lt=36_500, description="until it ends; null: never")] = 365.0


@router.get("/tokens", summary="Access tokens", response_model=list[dict[str, Any]])
async def tokens(core: CoreOf) -> Response:
    """All tokens, newest first; their secrets are not stored."""
    return json_response([token_dict(row) for row in await run_in_threadpool(core.tokens.rows)])


@router.post("/tokens", status_code=201, summary="Make a token", response_model=dict[str, Any])
async def create_token(core: CoreOf, actor: ActorOf, body: TokenBody) -> Response:
    """The answer holds the token; it is shown this once."""
    text, row = await run_in_threadpool(
        core.tokens.create, body.name, list(body.scopes), body.fleet, body.days, actor.name
    )
    return json_response(token_dict(row) | {"token": text}, 201)


@router.delete("/tokens/{id}", summary="Revoke a token", response_model=dict[str, str])
async def revoke_token(core: CoreOf, actor: ActorOf, id: str) -> Response:
    """It is worth nothing within five seconds."""
    await run_in_threadpool(core.tokens.revoke, id, actor.name)
    return json_response({"revoked": id})


@router.get("/audit", summary="Who did what", response_model=list[dict[str, Any]])
async def audit_log(
    core: CoreOf,
    limit: Annotated[int, Query(ge=1, le=1000)] = 100,
    before: Annotated[int | None, Query(ge=0, le=2**53)] = None,
) -> Response:
    """The newest deeds first; `before`: older than the one with this id."""
    rows = await read(core, lambda connection: audit.entries(connection, limit, before))
    found = [
        {
            "id": r.id,
            "time": to_iso(r.time_ns),
            "actor": r.actor,
            "action": r.action,
            "target": r.target,
            "detail": r.detail,
        }
        for r in rows
    ]
    return json_response(found)


@pages.get("/debug/profile")
async def profile(seconds: Annotated[float, Query(gt=0, le=PROFILE_SECONDS)] = 3.0) -> PlainTextResponse:
    """Stacks of every thread, looked at a hundred times a second, one line each with its count: the format that flame
    graphs are drawn from."""
    if not _profiling.acquire(blocking=False):  # each holds a thread that answers requests
        raise Busy("a profile is being taken already", PROFILE_SECONDS)
    try:
        return PlainTextResponse(await run_in_threadpool(stacks, seconds))
    finally:
        _profiling.release()


def stacks(seconds: float) -> str:
    """Folded stacks of the threads of this process."""
    own, names = threading.get_ident(), {}
    counts: Counter[str] = Counter()
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        names = {thread.ident: thread.name for thread in threading.enumerate()}
        for ident, frame in sys._current_frames().items():
            if ident != own:
                counts[f"{names.get(ident, ident)};{_folded(frame)}"] += 1
        time.sleep(SAMPLE_SECONDS)
    return "".join(f"{stack} {count}\n" for stack, count in counts.most_common(MOST_STACKS))


def _folded(frame: FrameType | None) -> str:
    found: list[str] = []
    while frame is not None:
        found.append(f"{frame.f_globals.get('__name__', '?')}.{frame.f_code.co_name}")
        frame = frame.f_back
    return ";".join(reversed(found))


def token_dict(row: TokenRow) -> dict[str, Any]:
    """JSON of a token, without anything that it is worth."""
    return {
        "id": row.id,
        "name": row.name,
        "scopes": row.scopes,
        "fleet": row.fleet,
        "created": to_iso(row.created_ns),
        "expires": optional_iso(row.expires_ns),
        "revoked": optional_iso(row.revoked_ns),
    }

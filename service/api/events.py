"""`GET /events`: what changes, as server-sent events."""

from __future__ import annotations

import asyncio
import json
import time
from collections.abc import AsyncIterator

from fastapi import APIRouter, Request
from fastapi.responses import Response, StreamingResponse
from sqlalchemy.exc import SQLAlchemyError

from sprung.service.api.access import CoreOf
from sprung.service.api.actors import ClientOf
from sprung.service.api.queries import OfVehicle
from sprung.service.core import Core
from sprung.service.monitoring.hub import Listener
from sprung.service.times import optional_iso

router = APIRouter(tags=["vehicles"])
LEAST_SECONDS = 1.0  # between two answers: a page that redraws more often is not read better
BEAT_SECONDS = 15.0  # a comment, so that proxies keep the connection
ASK_SECONDS = 5.0  # between two looks whether whoever follows still may


@router.get(
    "/events",
    summary="Follow the fleet, or one vehicle",
    response_class=Response,
    responses={200: {"content": {"text/event-stream": {"schema": {"type": "string"}}}}},
)
async def events(request: Request, core: CoreOf, client: ClientOf, vehicle: OfVehicle = None) -> Response:
    """Server-sent events `vehicle` with `{"vehicle", "window", "alarms"}`, at most one a second and vehicle.

    It ends when the token or session that it was begun with does.
    A client may follow 40 times at once (429). Of 200 in all, the client with most streams loses its oldest to others.
    """
    loop, ready = asyncio.get_running_loop(), asyncio.Event()

    def wake() -> None:
        loop.call_soon_threadsafe(ready.set)

    listener = core.hub.listen(vehicle, wake, client)
    stream = _stream(request, core, listener, ready)
    return StreamingResponse(stream, media_type="text/event-stream", headers={"Cache-Control": "no-store"})


async def _stream(request: Request, core: Core, listener: Listener, ready: asyncio.Event) -> AsyncIterator[str]:
    quiet, asked = 0.0, time.monotonic()
    try:
        yield "retry: 3000\n\n"
        while not (core.stopping.is_set() or listener.ended) and not await request.is_disconnected():
            if time.monotonic() - asked > ASK_SECONDS:
                if not await _still_let_in(request):
                    return
                asked = time.monotonic()
            try:
                await asyncio.wait_for(ready.wait(), LEAST_SECONDS)
            except TimeoutError:
                quiet += LEAST_SECONDS
                if quiet >= BEAT_SECONDS:
                    quiet = 0.0
                    yield ": still here\n\n"
                continue
            ready.clear()
            quiet = 0.0
            for news in listener.take():
                data = {"vehicle": news.vehicle, "window": optional_iso(news.window), "alarms": news.active}
                yield f"event: vehicle\ndata: {json.dumps(data)}\n\n"
            await asyncio.sleep(LEAST_SECONDS)
    finally:
        core.hub.leave(listener)


async def _still_let_in(request: Request) -> bool:
    """Whether the guard would let the request in now; a store that cannot be asked ends nobody's stream."""
    try:
        allowed: bool = await request.scope["sprung.again"]()
    except (SQLAlchemyError, OSError, MemoryError):
        return True
    return allowed

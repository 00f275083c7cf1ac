"""What routes are handed."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, TypeVar

from fastapi import Depends, Request
from fastapi.concurrency import run_in_threadpool
from fastapi.responses import Response
from pydantic import TypeAdapter
from sqlalchemy import Connection

from sprung.service.access.tokens import Actor
from sprung.service.api.clients import client_of
from sprung.service.api.problems import ApiProblem
from sprung.service.core import Core
from sprung.service.store import audit
from sprung.service.times import now_ns

T = TypeVar("T")


async def get_core(request: Request) -> Core:
    """The core of the application that serves this request.  Not a plain function: those are called in a thread."""
    core: Core = request.app.state.core
    return core


CoreOf = Annotated[Core, Depends(get_core)]


async def get_actor(request: Request) -> Actor:
    """The actor that the guard identified; `local` without authentication."""
    found: Actor = request.scope.get("sprung.actor") or Actor()
    return found


ActorOf = Annotated[Actor, Depends(get_actor)]


async def get_client(request: Request, actor: ActorOf) -> str:
    """Identity for per-client limits: the token's owner, or the address without authentication."""
    if actor == Actor():
        return f"address {client_of(request.client.host if request.client else '')}"
    return f"token {actor.name}"


ClientOf = Annotated[str, Depends(get_client)]


async def read(core: Core, query: Callable[[Connection], T]) -> T:
    """Run a query off the event loop."""

    def work() -> T:
        with core.store.read() as connection:
            return query(connection)

    return await run_in_threadpool(work)


async def note(core: Core, actor: Actor, action: str, target: str, detail: dict[str, str | None] | None = None) -> None:
    """Write a deed into the audit log."""

    def work() -> None:
        with core.store.write() as connection:
            audit.record(connection, actor.name, action, target, detail, now_ns())

    await run_in_threadpool(work)


def known_vehicle(found: bool, vehicle: str) -> None:
    """404 for a vehicle of which nothing was stored."""
    if not found:
        raise ApiProblem(404, f"nothing is known of vehicle {vehicle[:128]!r}")


def own_vehicle(actor: Actor, vehicle: str | None) -> None:
    """403 for a vehicle of another fleet, and for work whose vehicle is unknown."""
    if not actor.sees(vehicle):
        what = "name the vehicle" if vehicle is None else f"vehicle {vehicle[:128]!r} is of another fleet"
        raise ApiProblem(403, f"{what}; the token is for those that begin with {actor.fleet!r}")


_ANY: TypeAdapter[object] = TypeAdapter(object)


def json_response(content: object, status: int = 200, headers: dict[str, str] | None = None) -> Response:
    """JSON written by pydantic's core, several times faster than the standard library's."""
    return Response(_ANY.dump_json(content), status, headers, "application/json")

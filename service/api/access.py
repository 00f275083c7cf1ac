"""What routes are handed."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, TypeVar

from fastapi import Depends, Request
from fastapi.concurrency import run_in_threadpool
from sqlalchemy import Connection

from sprung.service.access.tokens import Actor
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

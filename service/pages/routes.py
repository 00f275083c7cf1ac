"""`GET /` and the pages behind it."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Annotated, Any
from urllib.parse import urlencode

from fastapi import APIRouter, Query
from fastapi.concurrency import run_in_threadpool
from fastapi.responses import HTMLResponse
from sqlalchemy import Connection

from sprung.service.api.access import CoreOf, read
from sprung.service.api.actors import ActorOf
from sprung.service.api.fleet import silent_before
from sprung.service.api.queries import one_of
from sprung.service.fleet.statistics import knowledge_dict
from sprung.service.rendering.drawing import columns, small_view
from sprung.service.rendering.render import render
from sprung.service.store import status
from sprung.service.store.status import Sort, StatusFilter

router = APIRouter(include_in_schema=False)

PAGE_ROWS = 50
SHOWN_STANDINGS = 8
HEALTH = {  # NAMUR NE 107
    "ok": "good",
    "maintenance_required": "maintenance required",
    "out_of_specification": "out of specification",
    "check_function": "check function",
    "failure": "failure",
}
SORTS = (
    ("urgency", "most urgent first"),
    ("drift", "largest drift first"),
    ("last_window", "newest first"),
    ("id", "by name"),
)


@router.get("/")
async def fleet_page(
    core: CoreOf,
    actor: ActorOf,
    q: Annotated[str, Query(max_length=128)] = "",
    sort: Sort = "urgency",
    health: str = "",
    silent: bool = False,
    open: bool = False,
    retired: bool = False,
    page: Annotated[int, Query(ge=1, le=100_000)] = 1,
) -> HTMLResponse:
    """The fleet, those that need attention first."""
    before = silent_before(core)
    wanted = StatusFilter(
        q.strip(),
        one_of("health", health or None, tuple(HEALTH)),
        before if silent else None,
        False if open else None,
        retired,
        actor.fleet,
    )

    def query(connection: Connection) -> tuple[list[status.FleetRow], dict[str, int]]:
        rows = status.fleet_page(connection, wanted, sort, PAGE_ROWS, (page - 1) * PAGE_ROWS)
        return rows, status.health_counts(connection, wanted)

    rows, counts = await read(core, query)
    knowledge = await run_in_threadpool(core.statistics.known, actor.fleet) if page == 1 else None
    total = sum(counts.values()) if wanted.health is None else counts[wanted.health]
    asked = {"q": q, "sort": sort, "health": health, "page": page}
    asked |= {name: "true" for name, on in (("silent", silent), ("open", open), ("retired", retired)) if on}
    return HTMLResponse(
        render(
            "fleet.html",
            rows=rows,
            knowledge=None if knowledge is None else knowledge_dict(knowledge, SHOWN_STANDINGS),
            counts=counts,
            wanted=wanted,
            searching=wanted != StatusFilter(fleet=actor.fleet),
            health=HEALTH,
            system=core.engine.system.name,
            sort=sort,
            sorts=SORTS,
            page=page,
            pages=-(-total // PAGE_ROWS),
            silent_before=before,
            small=partial(small_view, core.engine.system, columns(core.engine.system)),
            link=linker("/", asked),
        )
    )


def linker(path: str, asked: dict[str, Any]) -> Callable[..., str]:
    """A function that gives the present page's address with some parameters changed."""

    def link(**changed: Any) -> str:
        wanted = {name: value for name, value in (asked | changed).items() if value not in ("", 1, None)}
        return f"{path}?{urlencode(wanted)}" if wanted else path

    return link

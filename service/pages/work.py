"""`GET /pages/alarms` and `GET /pages/work`: alarms of all vehicles; uploads, jobs, reports, buses, notifications."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import APIRouter, Query
from fastapi.responses import HTMLResponse
from sqlalchemy import Connection

from sprung.replay.recording import EXTENSIONS
from sprung.service.api.access import CoreOf, read
from sprung.service.api.lists import delivery_dict, report_dict
from sprung.service.api.recordings import job_dict
from sprung.service.monitoring.views import alarm_dict
from sprung.service.pages.routes import linker
from sprung.service.rendering.render import render
from sprung.service.store import fleet, lists, work
from sprung.service.store.fleet import WantedAlarms

router = APIRouter(include_in_schema=False)
SHOWN = 30
PAGE_ALARMS = 50


@router.get("/pages/alarms")
async def alarms_page(
    core: CoreOf, active: bool = True, page: Annotated[int, Query(ge=1, le=100_000)] = 1
) -> HTMLResponse:
    """Alarms of the fleet, newest first."""
    wanted = WantedAlarms(active=active)

    def query(connection: Connection) -> tuple[list[fleet.AlarmRow], int]:
        rows = fleet.list_alarms(connection, wanted, PAGE_ALARMS, offset=(page - 1) * PAGE_ALARMS)
        return rows, fleet.count_alarms(connection, wanted)

    rows, total = await read(core, query)
    return HTMLResponse(
        render(
            "alarms.html",
            alarms=[alarm_dict(row) for row in rows],
            active=active,
            total=total,
            page=page,
            pages=-(-total // PAGE_ALARMS),
            link=linker("/pages/alarms", {"active": "" if active else "false", "page": page}),
        )
    )


@router.get("/pages/work")
async def work_page(core: CoreOf, vehicle: Annotated[str, Query(max_length=128)] = "") -> HTMLResponse:
    """What is being worked on, and what came of it."""

    def query(connection: Connection) -> dict[str, Any]:
        jobs = lists.list_jobs(connection, SHOWN)
        return {
            "jobs": [job_dict(row) for row in jobs],
            "names": work.recording_names(connection, [row.recording_id for row in jobs if row.recording_id]),
            "reports": [report_dict(row) for row in lists.list_reports(connection, SHOWN)],
            "dead": [delivery_dict(row) for row in lists.list_deliveries(connection, SHOWN, state="dead")],
        }

    values = await read(core, query)
    feeds = [feed.status() for feed in core.feeds]
    extensions = ", ".join(EXTENSIONS)
    return HTMLResponse(render("work.html", **values, feeds=feeds, vehicle=vehicle, extensions=extensions))

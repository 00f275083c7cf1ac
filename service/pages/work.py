"""`GET /pages/alarms` and `GET /pages/work`: alarms of all vehicles; uploads, jobs, reports, failed notifications."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import APIRouter, Query
from fastapi.responses import HTMLResponse
from sqlalchemy import Connection

from sprung.replay.recording import EXTENSIONS
from sprung.service.api.access import CoreOf, read
from sprung.service.api.lists import delivery_dict, report_dict
from sprung.service.api.recordings import job_dict
from sprung.service.pages.render import render
from sprung.service.store import fleet, lists
from sprung.service.store.fleet import WantedAlarms
from sprung.service.views import alarm_dict

router = APIRouter(include_in_schema=False)
SHOWN = 30
SHOWN_ALARMS = 200


@router.get("/pages/alarms")
async def alarms_page(core: CoreOf, active: bool = True) -> HTMLResponse:
    """Alarms of the fleet, newest first."""
    wanted = WantedAlarms(active=active)
    rows = await read(core, lambda connection: fleet.list_alarms(connection, wanted, SHOWN_ALARMS + 1))
    shown = [alarm_dict(row) for row in rows[:SHOWN_ALARMS]]
    return HTMLResponse(render("alarms.html", alarms=shown, active=active, more=len(rows) > SHOWN_ALARMS))


@router.get("/pages/work")
async def work_page(core: CoreOf, vehicle: Annotated[str, Query(max_length=128)] = "") -> HTMLResponse:
    """What is being worked on, and what came of it."""

    def query(connection: Connection) -> dict[str, Any]:
        return {
            "jobs": [job_dict(row) for row in lists.list_jobs(connection, SHOWN)],
            "reports": [report_dict(row) for row in lists.list_reports(connection, SHOWN)],
            "dead": [delivery_dict(row) for row in lists.list_deliveries(connection, SHOWN, state="dead")],
        }

    values = await read(core, query)
    return HTMLResponse(render("work.html", **values, vehicle=vehicle, extensions=", ".join(EXTENSIONS)))

"""Lists over the fleet, newest first: alarms, jobs, reports, recordings, notifications; monitored parameters."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal

from fastapi import APIRouter
from fastapi.responses import Response
from sqlalchemy import Connection

from sprung.model.diagnosis.investigation.verdict import Verdict
from sprung.service.api import job_models, models
from sprung.service.api.access import CoreOf, read
from sprung.service.api.answers import json_response
from sprung.service.api.queries import After, Limit, OfVehicle, Since, time_of, with_cursor
from sprung.service.api.recordings import job_dict
from sprung.service.core import Core
from sprung.service.monitoring.views import alarm_dict
from sprung.service.store import fleet, lists
from sprung.service.store.cursors import whole_number
from sprung.service.store.fleet import WantedAlarms
from sprung.service.times import optional_iso, to_iso

router = APIRouter()


@router.get("/alarms", summary="Alarms of the fleet", tags=["vehicles"], response_model=models.AlarmPage)
async def alarms(
    core: CoreOf,
    vehicle: OfVehicle = None,
    active: bool = False,
    acknowledged: bool | None = None,
    severity: models.Severity | None = None,
    kind: models.Kind | None = None,
    since: Since = None,
    limit: Limit = 100,
    after: After = None,
) -> Response:
    """Alarms, newest first."""
    begin = None if since is None else time_of("since", since, 0)
    wanted = WantedAlarms(vehicle, active, acknowledged, severity, kind, begin)
    last = _cursor(after)
    place = None if last is None else (last[0], with_cursor(lambda: whole_number(last[1])))
    rows = await read(core, lambda connection: fleet.list_alarms(connection, wanted, limit, place))
    following = f"{rows[-1].opened}:{rows[-1].id}" if len(rows) == limit else None
    return json_response({"alarms": [alarm_dict(row) for row in rows], "next": following})


@router.get("/jobs", summary="Jobs", tags=["recordings"], response_model=job_models.JobPage)
async def jobs(
    core: CoreOf,
    vehicle: OfVehicle = None,
    kind: Literal["recording", "diagnosis"] | None = None,
    state: Literal["queued", "running", "done", "failed"] | None = None,
    limit: Limit = 100,
    after: After = None,
) -> Response:
    """Jobs, newest first."""
    place = _cursor(after)

    def query(connection: Connection) -> list[Any]:
        return list(lists.list_jobs(connection, limit, place, vehicle_id=vehicle, kind=kind, state=state))

    return await _answer(core, query, "jobs", job_dict, limit)


@router.get("/reports", summary="Mismatch reports", tags=["diagnosis"], response_model=job_models.ReportPage)
async def reports(
    core: CoreOf,
    vehicle: OfVehicle = None,
    verdict: Verdict | None = None,
    limit: Limit = 100,
    after: After = None,
) -> Response:
    """Reports, newest first, those of uploads without a vehicle too."""
    place = _cursor(after)

    def query(connection: Connection) -> list[Any]:
        return list(lists.list_reports(connection, limit, place, vehicle_id=vehicle, verdict=verdict))

    return await _answer(core, query, "reports", report_dict, limit)


@router.get("/recordings", summary="Recordings", tags=["recordings"], response_model=job_models.RecordingPage)
async def recordings(core: CoreOf, vehicle: OfVehicle = None, limit: Limit = 100, after: After = None) -> Response:
    """What was read, newest first."""
    place = _cursor(after)

    def query(connection: Connection) -> list[Any]:
        return list(lists.list_recordings(connection, limit, place, vehicle_id=vehicle))

    return await _answer(core, query, "recordings", recording_dict, limit)


@router.get("/deliveries", summary="Notifications", tags=["operation"], response_model=job_models.DeliveryPage)
async def deliveries(
    core: CoreOf,
    state: Literal["waiting", "delivered", "dead"] | None = None,
    limit: Limit = 100,
    after: After = None,
) -> Response:
    """Notifications, newest first; `dead` ones were given up."""
    place = _cursor(after)

    def query(connection: Connection) -> list[Any]:
        return list(lists.list_deliveries(connection, limit, place, state=state))

    return await _answer(core, query, "deliveries", delivery_dict, limit)


@router.get("/system", summary="What is monitored", tags=["vehicles"], response_model=models.SystemAnswer)
async def system(core: CoreOf) -> Response:
    """Parameters, elements and channels of the system file that the service runs with."""
    found, names = core.engine.system, {p.name for p in core.engine.system.tracked}
    elements = [
        {
            "name": name,
            "upper": item.upper,
            "lower": item.lower,
            "position": None if item.position is None else list(item.position),
            "parameters": [f"{name}.{q}" for q in ("stiffness", "damping") if f"{name}.{q}" in names],
        }
        for name, item in found.file.elements.items()
    ]
    return json_response(
        {
            "name": found.name,
            "model": core.engine.digest,
            "sample_rate": found.sample_rate,
            "window": found.window,
            "parameters": [{"name": p.name, "unit": p.unit, "nominal": p.nominal} for p in found.parameters],
            "elements": elements,
            "sensors": list(found.sensors),
            "channels": [channel.name for channel in found.channels],
        }
    )


def report_dict(row: Any) -> dict[str, Any]:
    """JSON of a report in a list."""
    findings = row.report.get("findings", [])
    return {
        "id": row.id,
        "vehicle": row.vehicle_id,
        "recording": row.recording_id,
        "verdict": row.verdict,
        "findings": [f.get("sentence") or f"{f['location']}: {f['effect']}" for f in findings],
        "created": to_iso(row.created_ns),
        "page": f"/reports/{row.id}/page",
    }


def recording_dict(row: Any) -> dict[str, Any]:
    """JSON of a recording."""
    return {
        "id": row.id,
        "vehicle": row.vehicle_id,
        "name": row.name,
        "source": row.source,
        "size_bytes": row.size_bytes,
        "kept": row.file is not None,
        "start": optional_iso(row.began_ns),
        "created": to_iso(row.created_ns),
        "finished": optional_iso(row.finished_ns),
        "tally": row.tally,
    }


def delivery_dict(row: Any) -> dict[str, Any]:
    """JSON of a notification, without its secret parts."""
    return {
        "id": row.id,
        "type": row.kind,
        "target": row.target,
        "state": row.state,
        "attempts": row.attempts,
        "next_attempt": to_iso(row.next_ns) if row.state == "waiting" else None,
        "error": row.error,
        "created": to_iso(row.created_ns),
    }


async def _answer(
    core: Core, query: Callable[[Connection], list[Any]], name: str, as_dict: Callable[[Any], Any], limit: int
) -> Response:
    rows = await read(core, query)
    following = lists.cursor_of(rows[-1]) if len(rows) == limit else None
    return json_response({name: [as_dict(row) for row in rows], "next": following})


def _cursor(text: str | None) -> lists.Cursor | None:
    return with_cursor(lambda: lists.parse_cursor(text))

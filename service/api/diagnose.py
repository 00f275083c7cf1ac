"""`POST /diagnose` and `GET /reports/{id}`: unmodelled dynamics in a recording."""

from __future__ import annotations

from typing import Any

from fastapi import APIRouter, Request
from fastapi.concurrency import run_in_threadpool
from fastapi.responses import HTMLResponse, PlainTextResponse, RedirectResponse, Response
from pydantic import ValidationError
from sqlalchemy import Connection

from sprung.service.access.tokens import Actor
from sprung.service.api import job_models
from sprung.service.api.access import CoreOf, known_vehicle, read
from sprung.service.api.actors import ActorOf, own_vehicle
from sprung.service.api.answers import json_response
from sprung.service.api.bodies import DiagnoseBody
from sprung.service.api.idempotency import IdempotentRequests, OnceOf
from sprung.service.api.problems import ApiProblem, from_validation
from sprung.service.api.recordings import noting
from sprung.service.api.scopes import FORM, content_kind
from sprung.service.api.uploads import BODY as UPLOAD
from sprung.service.api.uploads import receive
from sprung.service.core import Core
from sprung.service.diagnosis.task import IMPROVED
from sprung.service.errors import NotFound
from sprung.service.notify.events import vehicle_page
from sprung.service.report.links import with_links
from sprung.service.store import fleet, work
from sprung.service.store.work import RecordingRow, ReportRow

router = APIRouter(tags=["diagnosis"])
MOST_REFERENCE_BYTES = 4096
PAGE = "report.html"

BODY = {
    "requestBody": {
        "required": True,
        "content": {
            "application/json": {"schema": DiagnoseBody.model_json_schema()},
        }
        | UPLOAD["content"],
    }
}


@router.post(
    "/diagnose", status_code=202, openapi_extra=BODY, summary="Look for missing physics", response_model=job_models.Job
)
async def diagnose(request: Request, core: CoreOf, actor: ActorOf, once: OnceOf) -> Response:
    """Accepts a job: of an uploaded file (multipart, as in `POST /recordings`), of a recording that was uploaded
    before (`{"recording": id}`), or of the last minute of a vehicle (`{"vehicle": id}`).  The job's result names
    the report."""

    async def act() -> None:
        core.jobs.reserve()
        kind = content_kind(request.headers)
        if kind == FORM:
            await _of_upload(request, core, actor, once)
        elif kind == "application/json":
            await _of_reference(request, core, actor, once)
        else:
            raise ApiProblem(415, "send multipart/form-data with a file, or application/json")

    return await once.answer(act)


@router.get("/reports/{id}", summary="A mismatch report", response_model=dict[str, Any])
async def report(request: Request, core: CoreOf, actor: ActorOf, id: str) -> Response:
    """The report as JSON, or its page where the client prefers `text/html`."""
    row = await _report(core, actor, id)
    accepted = request.headers.get("accept", "")
    if "text/html" in accepted and "application/json" not in accepted:
        return RedirectResponse(f"/reports/{row.id}/page", 303)
    return json_response(row.report | {"id": row.id})


@router.get("/reports/{id}/page", summary="A mismatch report as a page", response_class=HTMLResponse)
async def report_page(core: CoreOf, actor: ActorOf, id: str) -> Response:
    """A self-contained page with the pictures."""
    row = await _report(core, actor, id)
    path = core.settings.reports / row.id / PAGE  # the id is the store's, not the client's
    if not path.is_file():
        raise NotFound(f"the page of report {row.id} is no longer kept")
    page = await run_in_threadpool(path.read_text, "utf-8")
    links = {"/": "Fleet"} | ({vehicle_page("", row.vehicle_id): row.vehicle_id} if row.vehicle_id else {})
    links |= {"/pages/work": "Reports", f"/reports/{row.id}": "JSON"}
    if path.with_name(IMPROVED).is_file():
        links |= {f"/reports/{row.id}/system": "System file with the findings"}
        if row.vehicle_id is not None:  # the page itself may run nothing; the vehicle's asks once more
            links |= {f"{vehicle_page('', row.vehicle_id)}#use={row.id}": f"Use this model for {row.vehicle_id}"}
    return HTMLResponse(with_links(page, links))


@router.get("/reports/{id}/system", summary="The system file with the findings", response_class=PlainTextResponse)
async def report_system(core: CoreOf, actor: ActorOf, id: str) -> Response:
    """Nominal values, laws and noise as the diagnosis found them, in a copy of the system file: for `serve --system`,
    `replay --system` and the other commands."""
    row = await _report(core, actor, id)
    path = core.settings.reports / row.id / IMPROVED
    if not path.is_file():
        raise NotFound(f"the system file of report {row.id} is not kept")
    text = await run_in_threadpool(path.read_text, "utf-8")
    named = {"Content-Disposition": f'attachment; filename="{row.id}.yaml"'}
    return Response(text, media_type="application/yaml", headers=named)


async def _of_upload(request: Request, core: Core, actor: Actor, once: IdempotentRequests) -> None:
    async with receive(request, core) as found:
        once.received(found.identity)
        own_vehicle(actor, found.vehicle)
        noted = noting(actor, "diagnose", once)
        await run_in_threadpool(core.diagnoses.from_recording, found.row, found.vehicle, noted)


async def _of_reference(request: Request, core: Core, actor: Actor, once: IdempotentRequests) -> None:
    raw = await request.body()
    if len(raw) > MOST_REFERENCE_BYTES:
        raise ApiProblem(413, f"what names a recording or a vehicle has at most {MOST_REFERENCE_BYTES} bytes")
    try:
        body = DiagnoseBody.model_validate_json(raw)
    except ValidationError as error:
        raise from_validation(error) from None
    if (body.recording is None) == (body.vehicle is None):
        detail = "give either recording or vehicle"
        raise ApiProblem(422, detail, [{"field": "recording", "detail": detail}])
    noted = noting(actor, "diagnose", once)
    if body.recording is None:
        vehicle = str(body.vehicle)
        own_vehicle(actor, vehicle)
        known_vehicle(await read(core, lambda c: fleet.vehicle_exists(c, vehicle)), vehicle)
        await run_in_threadpool(core.diagnoses.from_excerpt, vehicle, noted)
        return
    recording = body.recording

    def query(connection: Connection) -> RecordingRow:
        row = work.get_recording(connection, recording)
        if row is None or not actor.sees(row.vehicle_id):
            raise NotFound(f"no recording {recording!r}")
        return row

    row = await read(core, query)
    await run_in_threadpool(core.diagnoses.from_recording, row, None, noted)


async def _report(core: Core, actor: Actor, report_id: str) -> ReportRow:
    def query(connection: Connection) -> ReportRow:
        row = work.get_report(connection, report_id)
        if row is None or not actor.sees(row.vehicle_id):
            raise NotFound(f"no report {report_id[:36]!r}")
        return row

    return await read(core, query)

"""`POST /recordings` and `GET /jobs/{id}`: uploads are accepted now and worked through later."""

from __future__ import annotations

from typing import Any

from fastapi import APIRouter, Request
from fastapi.concurrency import run_in_threadpool
from fastapi.responses import Response
from sqlalchemy import Connection

from sprung.service.access.tokens import Actor
from sprung.service.api import job_models
from sprung.service.api.access import CoreOf, read
from sprung.service.api.actors import ActorOf, own_vehicle
from sprung.service.api.answers import json_response
from sprung.service.api.idempotency import IdempotentRequests, OnceOf
from sprung.service.api.uploads import BODY, receive
from sprung.service.errors import NotFound
from sprung.service.jobs.queue import Noted
from sprung.service.store import audit, work
from sprung.service.store.work import JobRow
from sprung.service.times import now_ns, to_iso

router = APIRouter(tags=["recordings"])


@router.post(
    "/recordings",
    status_code=202,
    openapi_extra={"requestBody": BODY},
    summary="Upload a recording",
    response_model=job_models.Job,
)
async def upload(request: Request, core: CoreOf, actor: ActorOf, once: OnceOf) -> Response:
    """Replays the recording (MCAP, BLF, ASC, candump log, MF4, CSV and others) into the store as a job; the answer says
    where to ask for it.

    `vehicle` names whose it is; without it the recording's own metadata or the file's name does.  `start` says when
    it began, where its times count from 0.  A file that was sent before is not kept twice: while its job waits or
    runs, that job is the answer.
    """

    async def act() -> None:
        core.jobs.reserve()
        async with receive(request, core) as found:
            once.received(found.identity)
            own_vehicle(actor, found.vehicle)
            noted = noting(actor, "upload", once, {"name": found.row.name, "vehicle": found.vehicle})
            await run_in_threadpool(core.jobs.submit, "recording", found.row, found.vehicle, noted)

    return await once.answer(act)


@router.get("/jobs/{id}", summary="A job", response_model=job_models.Job)
async def job(core: CoreOf, actor: ActorOf, id: str) -> Response:
    """Where a job stands; `state` is queued, running, done or failed."""

    def query(connection: Connection) -> JobRow:
        row = work.get_job(connection, id)
        if row is None or not actor.sees(row.vehicle_id):
            raise NotFound(f"no job {id[:36]!r}")
        return row

    return json_response(job_dict(await read(core, query)))


@router.post("/jobs/{id}/cancel", summary="Cancel a job", response_model=job_models.Job)
async def cancel(core: CoreOf, actor: ActorOf, id: str) -> Response:
    """A job that waits or runs is given up; it is then `failed`, and its error says that it was cancelled.  What it
    stored before stays."""
    await job(core, actor, id)
    row = await run_in_threadpool(core.jobs.cancel, id, actor.name)
    return json_response(job_dict(row))


def noting(actor: Actor, action: str, once: IdempotentRequests, detail: dict[str, str | None] | None = None) -> Noted:
    """Writes who asked for a job into the audit log, and keeps the answer, in the transaction that stores the job."""
    keep = once.keeping(_accepted)

    def work(connection: Connection, job: JobRow) -> None:
        audit.record(connection, actor.name, action, job.id, detail or {"vehicle": job.vehicle_id}, now_ns())
        keep(connection, job)

    return work


def _accepted(_: Connection, job: JobRow) -> Response:
    return json_response(job_dict(job), 202, {"Location": f"/jobs/{job.id}"})


def job_dict(row: JobRow) -> dict[str, Any]:
    """JSON of a job."""
    return {
        "id": row.id,
        "kind": row.kind,
        "state": row.state,
        "recording": row.recording_id,
        "vehicle": row.vehicle_id,
        "progress": row.progress,
        "result": row.result,
        "error": row.error,
        "created": to_iso(row.created_ns),
        "updated": to_iso(row.updated_ns),
    }

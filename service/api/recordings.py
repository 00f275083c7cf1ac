"""`POST /recordings` and `GET /jobs/{id}`: uploads are accepted now and worked through later."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, BinaryIO

from fastapi import APIRouter, File, Form, UploadFile
from fastapi.concurrency import run_in_threadpool
from fastapi.responses import Response
from sqlalchemy import Connection

from sprung.replay.recording import EXTENSIONS
from sprung.service.api import models
from sprung.service.api.access import CoreOf, json_response, read
from sprung.service.api.bodies import VehicleId
from sprung.service.api.idempotency import OnceOf
from sprung.service.api.problems import Problem
from sprung.service.errors import NotFound
from sprung.service.settings import Settings
from sprung.service.store import work
from sprung.service.store.work import JobRow, RecordingRow
from sprung.service.times import now_ns, to_iso

router = APIRouter(tags=["recordings"])
CHUNK = 1 << 20


@router.post("/recordings", status_code=202, summary="Upload a recording", response_model=models.Job)
async def upload(
    core: CoreOf,
    once: OnceOf,
    file: Annotated[UploadFile, File(description="MCAP, BLF, ASC, candump log, MF4 or CSV")],
    vehicle: Annotated[VehicleId | None, Form()] = None,
) -> Response:
    """Replays the recording into the store as a job; the answer says where to ask for it.

    `vehicle` names whose it is; without it the recording's own metadata or the file's name does.
    """

    async def act() -> Response:
        core.jobs.reserve()
        row = await run_in_threadpool(keep_upload, core.settings, file.filename or "", file.file)
        job = await run_in_threadpool(core.jobs.submit, "recording", row, vehicle)
        return json_response(job_dict(job), 202, {"Location": f"/jobs/{job.id}"})

    return await once.answer(act)


@router.get("/jobs/{id}", summary="A job", response_model=models.Job)
async def job(core: CoreOf, id: str) -> Response:
    """Where a job stands; `state` is queued, running, done or failed."""

    def query(connection: Connection) -> JobRow:
        row = work.get_job(connection, id)
        if row is None:
            raise NotFound(f"no job {id[:36]!r}")
        return row

    return json_response(job_dict(await read(core, query)))


@router.delete("/jobs/{id}", summary="Cancel a job", response_model=models.Job)
async def cancel(core: CoreOf, id: str) -> Response:
    """A job that waits or runs is given up; it is then `failed`, and its error says that it was cancelled.  What it
    stored before stays."""
    return json_response(job_dict(await run_in_threadpool(core.jobs.cancel, id, "a user")))


def keep_upload(settings: Settings, name: str, stream: BinaryIO) -> RecordingRow:
    """Copy an upload into the folder, under a name that the client has no part in but its known extension.

    Raises a 422 Problem for a kind of file that no reader knows.
    """
    label = name.replace("\\", "/").rsplit("/", 1)[-1][-255:]
    extension = Path(label).suffix.lower()
    if extension not in EXTENSIONS:
        detail = f"has no known extension; known are {' '.join(EXTENSIONS)}"
        raise Problem(422, f"file {detail}", [{"field": "file", "detail": detail}])
    recording_id = work.new_id()
    stored = f"{recording_id}{extension}"
    settings.uploads.mkdir(parents=True, exist_ok=True)
    size = 0
    part = settings.uploads / f"{stored}.part"
    with open(part, "xb") as target:
        while chunk := stream.read(CHUNK):
            size += target.write(chunk)
    part.replace(settings.uploads / stored)
    return RecordingRow(recording_id, None, label, "upload", stored, size, None, now_ns(), None)


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

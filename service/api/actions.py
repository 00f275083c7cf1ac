"""What operators do: acknowledge, note, mark a maintenance, rename, retire, delete."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import APIRouter, Query
from fastapi.concurrency import run_in_threadpool
from fastapi.responses import Response
from pydantic import Field
from sqlalchemy import Connection

from sprung.model.tracking.tracker import TrackerStateError
from sprung.service.api import models
from sprung.service.api.access import CoreOf, known_vehicle, read
from sprung.service.api.actors import ActorOf
from sprung.service.api.answers import json_response
from sprung.service.api.bodies import LINE, TEXT, StrictBody
from sprung.service.api.fleet import vehicle_answer
from sprung.service.api.idempotency import OnceOf
from sprung.service.api.problems import ApiProblem
from sprung.service.api.queries import Id, Limit
from sprung.service.store import fleet, marks
from sprung.service.store.marks import MarkRow
from sprung.service.times import AHEAD, from_iso, now_ns, to_iso

router = APIRouter(tags=["operation"])
Text = Annotated[str, Field(min_length=1, max_length=2000, examples=["damper 2l replaced, order 4711"]), *TEXT]


class AcknowledgeBody(StrictBody):
    """Which alarm was seen."""

    alarm: int | None = Field(default=None, ge=1, le=2**53, description="its id; left out: all that are active")


class NoteBody(StrictBody):
    """A note on the time line."""

    text: Text
    time: str | None = Field(
        default=None,
        max_length=40,
        description="RFC 3339; now where left out",
        json_schema_extra={"format": "date-time"},
    )


class MaintenanceBody(NoteBody):
    """A repair or an overhaul, after which healthy values are other ones."""

    parameters: list[Annotated[str, Field(max_length=160)]] | None = Field(
        default=None,
        max_length=1000,
        description="whose baselines are learned anew: left out or null for all, [] for none",
        examples=[["secondary_2l.damping"]],
    )


class VehicleBody(StrictBody):
    """Fields to be changed; omitted ones are kept."""

    label: Annotated[str, Field(max_length=128), *LINE] | None = Field(
        default=None, description="display name; empty removes it"
    )
    retired: bool | None = Field(default=None, description="out of service: not listed, data kept")


@router.post("/vehicles/{id}/acknowledge", summary="Acknowledge alarms", response_model=models.VehicleAnswer)
async def acknowledge(core: CoreOf, actor: ActorOf, once: OnceOf, id_: Id, body: AcknowledgeBody) -> Response:
    """Somebody has seen them; they stay active until the vehicle is well again."""

    def respond(connection: Connection, _: int) -> Response:
        return json_response(vehicle_answer(core, connection, id_))

    async def act() -> None:
        await run_in_threadpool(core.operations.acknowledge, actor.name, id_, body.alarm, once.keeping(respond))

    return await once.answer(act)


@router.get("/vehicles/{id}/marks", summary="Notes and maintenance", response_model=models.Marks)
async def list_marks(core: CoreOf, id_: Id, limit: Limit = 100) -> Response:
    """Marks on the vehicle's time line, newest first."""

    def query(connection: Connection) -> list[MarkRow]:
        known_vehicle(fleet.vehicle_exists(connection, id_), id_)
        return marks.list_marks(connection, id_, limit)

    return json_response({"vehicle": id_, "marks": [mark_dict(row) for row in await read(core, query)]})


@router.post("/vehicles/{id}/notes", status_code=201, summary="Write a note", response_model=models.MarkAnswer)
async def note(core: CoreOf, actor: ActorOf, once: OnceOf, id_: Id, body: NoteBody) -> Response:
    """A line on the vehicle's time line."""

    async def act() -> None:
        keep = once.keeping(_mark_answer)
        await run_in_threadpool(core.operations.note, actor.name, id_, body.text, _time(body.time), keep)

    return await once.answer(act)


@router.post(
    "/vehicles/{id}/maintenance", status_code=201, summary="Mark a maintenance", response_model=models.MarkAnswer
)
async def maintenance(core: CoreOf, actor: ActorOf, once: OnceOf, id_: Id, body: MaintenanceBody) -> Response:
    """Closes the alarms of the parameters that were worked on and learns their baselines anew."""

    async def act() -> None:
        time, keep = _time(body.time), once.keeping(_mark_answer)
        try:
            await run_in_threadpool(
                core.operations.maintenance, actor.name, id_, body.text, time, body.parameters, keep
            )
        except TrackerStateError as error:
            raise ApiProblem(422, str(error), [{"field": "parameters", "detail": str(error)}]) from error

    return await once.answer(act)


@router.patch("/vehicles/{id}", summary="Rename or retire a vehicle", response_model=models.VehicleAnswer)
async def change(core: CoreOf, actor: ActorOf, id_: Id, body: VehicleBody) -> Response:
    """What is left out stays as it is."""
    if "label" in body.model_fields_set:
        await run_in_threadpool(core.operations.rename, actor.name, id_, (body.label or "").strip() or None)
    if body.retired is not None:
        await run_in_threadpool(core.operations.retire, actor.name, id_, body.retired)
    return json_response(await read(core, lambda connection: vehicle_answer(core, connection, id_)))


@router.delete("/vehicles/{id}", status_code=204, summary="Delete a vehicle and its data")
async def remove(
    core: CoreOf,
    actor: ActorOf,
    id_: Id,
    confirm: Annotated[str, Query(max_length=128, description="the vehicle's id once more")],
) -> Response:
    """Windows, alarms, marks, reports and uploaded files go; the audit log keeps that they did."""
    if confirm != id_:
        raise ApiProblem(422, "confirm must repeat the vehicle's id", [{"field": "confirm", "detail": "is another id"}])
    await run_in_threadpool(core.jobs.give_up, id_, actor.name)  # what they store would bring the vehicle back
    await run_in_threadpool(core.operations.remove, actor.name, id_)
    return Response(status_code=204)


def mark_dict(row: MarkRow) -> dict[str, Any]:
    """JSON of a mark."""
    return {
        "id": row.id,
        "kind": row.kind,
        "time": to_iso(row.time_ns),
        "text": row.text,
        "parameters": row.parameters,
        "author": row.author,
        "created": to_iso(row.created_ns),
    }


def _mark_answer(_: Connection, row: MarkRow) -> Response:
    return json_response(mark_dict(row), 201)


def _time(text: str | None) -> int | None:
    if text is None:
        return None
    try:
        time = from_iso(text)
    except (ValueError, OverflowError):
        time = -1
    wrong = "is no RFC 3339 time" if time < 0 else "is in the future" if time > now_ns() + AHEAD else None
    if wrong is not None:  # what is still to come would be the newest of the time line until then
        raise ApiProblem(422, f"time {wrong}", [{"field": "time", "detail": wrong}])
    return time

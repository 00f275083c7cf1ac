"""`POST /ingest/estimates`: what an edge identified on board, folded into its vehicle's tracker."""

from __future__ import annotations

from fastapi import APIRouter, Request
from fastapi.concurrency import run_in_threadpool
from fastapi.responses import Response
from pydantic import TypeAdapter, ValidationError

from sprung.service.api import models
from sprung.service.api.access import CoreOf
from sprung.service.api.actors import ActorOf, own_vehicle
from sprung.service.api.answers import json_response
from sprung.service.api.bodies import VehicleId
from sprung.service.api.problems import ApiProblem
from sprung.service.fleet.message import MEDIA_TYPE, OtherModel, read_messages

router = APIRouter(tags=["identify"])
BODY = {
    "requestBody": {
        "required": True,
        "description": f"As {MEDIA_TYPE}, which an edge says, or as any octets.",
        "content": {"application/octet-stream": {"schema": {"type": "string", "format": "binary"}}},
    }
}
_ID: TypeAdapter[str] = TypeAdapter(VehicleId)


@router.post(
    "/ingest/estimates",
    openapi_extra=BODY,
    summary="Take estimates of an edge",
    response_model=models.IngestAnswer,
)
async def ingest(request: Request, core: CoreOf, actor: ActorOf) -> Response:
    """One message of `sprung edge`, as docs/fleet.md describes it: estimates of one vehicle's windows.

    May be sent as often as it takes: a window is known by vehicle, start and model, and has its effect once.  The
    answer comes when everything is stored.  409: the estimates are of another system file or estimator than the
    service has.
    """
    body = await request.body()
    message = (await run_in_threadpool(read_messages, [body]))[0]
    try:
        _ID.validate_python(message.vehicle)
    except ValidationError:
        raise ApiProblem(422, "vehicle: letters, digits and . _ : - only, at most 128") from None
    own_vehicle(actor, message.vehicle)
    try:
        taken = (await run_in_threadpool(core.ingest.take, [message]))[0]
    except OtherModel as error:
        raise ApiProblem(409, str(error)) from error
    return json_response(
        {"vehicle": taken.vehicle, "folded": taken.folded, "waiting": taken.waiting, "known": taken.known}
    )

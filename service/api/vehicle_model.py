"""`POST /vehicles/{id}/model` and below: a vehicle is followed with a system file of its own, and back."""

from __future__ import annotations

from typing import Any

from fastapi import APIRouter
from fastapi.concurrency import run_in_threadpool
from fastapi.responses import PlainTextResponse, Response
from pydantic import ConfigDict, Field
from sqlalchemy import Connection

from sprung.service.access.tokens import Actor
from sprung.service.api import models
from sprung.service.api.access import CoreOf, known_vehicle, read
from sprung.service.api.actors import ActorOf
from sprung.service.api.answers import json_response
from sprung.service.api.bodies import StrictBody
from sprung.service.api.fleet import load_view
from sprung.service.api.idempotency import OnceOf
from sprung.service.api.problems import ApiProblem
from sprung.service.api.queries import Id, Version
from sprung.service.core import Core
from sprung.service.diagnosis.task import IMPROVED
from sprung.service.errors import NotFound, UserError
from sprung.service.operations import Noted
from sprung.service.store import fleet, vehicle_models, work
from sprung.service.store.vehicle_models import SERVICE_FILE, ModelVersion
from sprung.service.times import optional_iso, to_iso

router = APIRouter(tags=["operation"])
MOST_CHARACTERS = 100_000  # of a system file: within what bodies may hold; the bundled one has 7 000


GIVEN = {"report": "string", "version": "integer", "system": "string"}  # of which one says what to use


class ModelBody(StrictBody):
    """One of the three."""

    model_config = ConfigDict(
        json_schema_extra={
            "oneOf": [{"required": [name], "properties": {name: {"type": kind}}} for name, kind in GIVEN.items()],
            "maxProperties": 1,
        }
    )

    report: str | None = Field(default=None, max_length=36, description="a mismatch report: its system file is used")
    version: int | None = Field(default=None, ge=0, le=2**31 - 1, description="an earlier one; 0: the service's own")
    system: str | None = Field(default=None, max_length=MOST_CHARACTERS, description="a system file, as YAML")


@router.post("/vehicles/{id}/model", summary="Use a model for a vehicle", response_model=models.VehicleModels)
async def use(core: CoreOf, actor: ActorOf, once: OnceOf, id_: Id, body: ModelBody) -> Response:
    """From now on the vehicle's windows are identified with what a diagnosis found, with a system file that is sent,
    or with an earlier version again.

    Baselines are learned anew under another model.  What was estimated before stays, under its version; an alarm that
    windows do not fit closes with the model that it was said of.
    """
    if sum(value is not None for value in (body.report, body.version, body.system)) != 1:
        detail = "give one of report, version and system"
        raise ApiProblem(422, detail, [{"field": "report", "detail": detail}])

    def respond(connection: Connection, _: int) -> Response:
        return json_response(models_answer(core, connection, id_))

    async def act() -> None:
        try:
            async with core.trying:
                await _use(core, actor, id_, body, once.keeping(respond))
        except UserError as error:
            raise ApiProblem(422, str(error), [{"field": "system", "detail": str(error)}]) from error

    return await once.answer(act)


async def _use(core: Core, actor: Actor, vehicle: str, body: ModelBody, noted: Noted[int]) -> None:
    if body.version is not None:
        await run_in_threadpool(core.operations.use_model, actor.name, vehicle, body.version, noted)
        return
    text = body.system if body.system is not None else await _of_report(core, actor, vehicle, body.report or "")
    await run_in_threadpool(core.operations.give_model, actor.name, vehicle, text, body.report, noted)


@router.get("/vehicles/{id}/models", summary="A vehicle's models", response_model=models.VehicleModels)
async def versions(core: CoreOf, id_: Id) -> Response:
    """Every version that the vehicle was followed with: since when, how its windows fit, and its baselines."""
    return json_response(await read(core, lambda connection: models_answer(core, connection, id_)))


@router.get("/vehicles/{id}/models/{version}", summary="The system file of a version", response_class=PlainTextResponse)
async def version_file(core: CoreOf, id_: Id, version: Version) -> Response:
    """As YAML, for `--system` of the commands."""

    def query(connection: Connection) -> str | None:
        known_vehicle(fleet.vehicle_exists(connection, id_), id_)
        return vehicle_models.text_of(connection, id_, version)

    text = await read(core, query)
    if text is None:
        raise NotFound(f"vehicle {id_} has no model {version}")
    name = f"{id_}-model-{version}.yaml".replace(":", "_")
    return Response(
        text, media_type="application/yaml", headers={"Content-Disposition": f'attachment; filename="{name}"'}
    )


async def _of_report(core: Core, actor: Actor, vehicle: str, report_id: str) -> str:
    """The system file that a report of this vehicle, or of a recording without a vehicle, came with."""

    def query(connection: Connection) -> None:
        known_vehicle(fleet.vehicle_exists(connection, vehicle), vehicle)
        row = work.get_report(connection, report_id)
        if row is None or not actor.sees(row.vehicle_id):
            raise NotFound(f"no report {report_id!r}")
        if row.vehicle_id not in (None, vehicle):
            raise UserError(f"report {row.id} is of vehicle {row.vehicle_id}, not of {vehicle}")

    await read(core, query)
    path = core.settings.reports / report_id / IMPROVED  # the id is one of the store's
    if not path.is_file():
        raise NotFound(f"the system file of report {report_id} is not kept")
    return await run_in_threadpool(path.read_text, "utf-8")


def models_answer(core: Core, connection: Connection, vehicle: str) -> dict[str, Any]:
    """JSON of the versions of a known vehicle, the service's file first; 404 for an unknown one."""
    known_vehicle(fleet.vehicle_exists(connection, vehicle), vehicle)
    engines = core.pipeline.engines
    uses = vehicle_models.list_uses(connection, vehicle)
    shared = ModelVersion(SERVICE_FILE, engines.shared.model_id, None, "", 0)
    own = vehicle_models.list_versions(connection, vehicle)
    now = vehicle_models.current_version(connection, vehicle)
    return {
        "vehicle": vehicle,
        "in_use": now,
        "versions": [
            _version(core, connection, vehicle, row) | {"in_use": row.version == now} for row in (shared, *own)
        ],
        "uses": [{"version": use.version, "since": to_iso(use.since_ns), "by": use.author} for use in uses],
    }


def _version(core: Core, connection: Connection, vehicle: str, row: ModelVersion) -> dict[str, Any]:
    found = vehicle_models.fitting(connection, vehicle, row.model_id)
    answer: dict[str, Any] = {
        "version": row.version,
        "report": row.report_id,
        "created": to_iso(row.created_ns) if row.version != SERVICE_FILE else None,
        "by": row.author,
        "windows": found.windows,
        "fitting": found.adequate,
        "first_window": optional_iso(found.first_ns),
        "last_window": optional_iso(found.last_ns),
        "laws": [],
        "baselines": {},
        "error": None,
    }
    try:
        served = core.pipeline.engines.version(connection, vehicle, row.version)
    except UserError as error:  # the service has another system file by now
        return answer | {"error": str(error)}
    view = load_view(core, connection, vehicle, served)
    laws = [f"{law.location}: {law.law.name}" for law in served.engine.system.laws]
    baselines = {p.name: p.baseline for p in view.parameters if p.baseline is not None}
    return answer | {"laws": laws, "baselines": baselines}

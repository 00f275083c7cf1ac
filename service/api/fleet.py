"""`GET /vehicles` and below: the fleet, one vehicle, its alarms."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import APIRouter, Query
from fastapi.responses import Response
from sqlalchemy import Connection

from sprung.service.api import models
from sprung.service.api.access import CoreOf, known_vehicle, read
from sprung.service.api.actors import ActorOf
from sprung.service.api.answers import json_response
from sprung.service.api.queries import After, Id, Limit, with_cursor
from sprung.service.core import Core
from sprung.service.monitoring.engines import ServedModel
from sprung.service.monitoring.views import VehicleView, alarm_dict, vehicle_view
from sprung.service.store import fleet, status
from sprung.service.store.fleet import WantedAlarms
from sprung.service.store.status import FleetRow, Sort, StatusFilter
from sprung.service.store.windows import latest_window
from sprung.service.times import NANOSECONDS, now_ns, optional_iso, to_iso

router = APIRouter(tags=["vehicles"])
SHOWN_ALARMS = 1000  # active ones of one vehicle


@router.get("/vehicles", summary="The fleet", response_model=models.Vehicles)
async def vehicles(
    core: CoreOf,
    actor: ActorOf,
    limit: Limit = 100,
    after: After = None,
    sort: Annotated[Sort, Query(description="`urgency`: those that need attention first")] = "id",
    q: Annotated[str, Query(max_length=128, description="text in the id or the name")] = "",
    health: models.Health | None = None,
    silent: Annotated[bool, Query(description="only those from which nothing comes")] = False,
    acknowledged: Annotated[bool | None, Query(description="false: with unacknowledged alarms")] = None,
    retired: Annotated[bool, Query(description="those out of service instead")] = False,
) -> Response:
    """A page of vehicles; `next` is the `after` of the following page, null at the end."""
    wanted = StatusFilter(q, health, silent_before(core) if silent else None, acknowledged, retired, actor.fleet)

    def query(connection: Connection) -> dict[str, Any]:
        begin = after
        if after is not None and sort == "id" and after.startswith(actor.fleet or ""):
            begin = f":{after}" if fleet.vehicle_exists(connection, after) else after  # an id does as well
        rows = with_cursor(lambda: status.fleet_page(connection, wanted, sort, limit, after=begin))
        return {
            "vehicles": [line(core, row) for row in rows],
            "next": _next(sort, rows, limit),
            "counts": status.health_counts(connection, wanted),
        }

    return json_response(await read(core, query))


@router.get("/vehicles/{id}", summary="A vehicle as it stands", response_model=models.VehicleAnswer)
async def vehicle(core: CoreOf, id_: Id) -> Response:
    """Tracked parameters, fit, active alarms and health in the terms of NAMUR NE 107."""
    return json_response(await read(core, lambda connection: vehicle_answer(core, connection, id_)))


@router.get("/vehicles/{id}/alarms", summary="A vehicle's alarms", response_model=models.Alarms)
async def alarms(core: CoreOf, id_: Id, active: bool = False, limit: Limit = 100) -> Response:
    """Alarms, newest first, with the mismatch report that belongs to them where there is one."""

    def query(connection: Connection) -> list[fleet.AlarmRow]:
        known_vehicle(fleet.vehicle_exists(connection, id_), id_)
        return fleet.list_alarms(connection, WantedAlarms(id_, active), limit)

    return json_response({"vehicle": id_, "alarms": [alarm_dict(row) for row in await read(core, query)]})


def vehicle_answer(core: Core, connection: Connection, vehicle_id: str) -> dict[str, Any]:
    """JSON of one vehicle; 404 where nothing is known of it."""
    row = status.fleet_row(connection, vehicle_id)
    known_vehicle(row is not None, vehicle_id)
    assert row is not None
    served = core.pipeline.engines.of(connection, vehicle_id)
    view = load_view(core, connection, vehicle_id, served)
    active = fleet.list_alarms(connection, WantedAlarms(vehicle_id, active=True), SHOWN_ALARMS)
    reasons = status.reasons_of(connection, vehicle_id, served.model_id)
    return view.as_dict() | {
        "label": row.label,
        "model_version": served.version,
        "retired": optional_iso(row.retired_ns),
        "health": row.health,
        "received": to_iso(row.received_ns),
        "silent": row.received_ns < silent_before(core),
        "windows": row.windows,
        "alarms": [alarm_dict(alarm) for alarm in active],
        "reasons": [
            {"outcome": r.outcome, "reason": r.reason, "windows": r.windows, "last": to_iso(r.last_ns)} for r in reasons
        ],
    }


def line(core: Core, row: FleetRow) -> dict[str, Any]:
    """JSON of one line of the fleet."""
    return {
        "vehicle": row.id,
        "label": row.label,
        "health": row.health,
        "last_window": optional_iso(row.last_window_ns),
        "received": to_iso(row.received_ns),
        "silent": row.received_ns < silent_before(core),
        "alarms": row.alarms + row.warnings + row.earlier,
        "unacknowledged": row.unacknowledged,
        "largest": row.largest,
        "drift": row.drift,
        "learned": row.learned,
        "retired": optional_iso(row.retired_ns),
    }


def silent_before(core: Core) -> int:
    """Vehicles heard from last before this are silent, ns since epoch."""
    return now_ns() - round(core.settings.silent_seconds * NANOSECONDS)


def load_view(core: Core, connection: Connection, vehicle_id: str, served: ServedModel | None = None) -> VehicleView:
    """A vehicle's view from the store, under the model that it is followed with or under another one."""
    served = served or core.pipeline.engines.of(connection, vehicle_id)
    engine = served.engine
    row = fleet.load_tracker(connection, vehicle_id, served.model_id)
    state = engine.tracker.initial_state() if row is None else engine.load_state(row.state)
    return vehicle_view(engine, vehicle_id, state, latest_window(connection, vehicle_id, served.model_id))


def _next(sort: Sort, rows: list[FleetRow], limit: int) -> str | None:
    if len(rows) < limit:
        return None
    return status.cursor(sort, rows[-1])

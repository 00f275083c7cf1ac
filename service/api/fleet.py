"""`GET /vehicles` and below: the fleet, one vehicle, its history and its alarms."""

from __future__ import annotations

import math
from typing import Annotated, Any

import numpy as np
from fastapi import APIRouter, Path, Query
from fastapi.responses import Response
from sqlalchemy import Connection

from sprung.service.api.access import CoreOf, json_response, known_vehicle, read
from sprung.service.api.problems import Problem
from sprung.service.core import Core
from sprung.service.store import fleet
from sprung.service.store import history as store_history
from sprung.service.store.windows import latest_window
from sprung.service.times import from_iso, optional_iso, to_iso
from sprung.service.views import VehicleView, alarm_dict, vehicle_view

router = APIRouter(tags=["vehicles"])

MAX_POINTS = 5000
AUTO_POINTS = 2000  # where no resolution is asked for
UNITS = {"s": 1.0, "m": 60.0, "h": 3600.0, "d": 86400.0}

Id = Annotated[str, Path(alias="id", max_length=128)]


@router.get("/vehicles", summary="The fleet")
async def vehicles(
    core: CoreOf,
    limit: Annotated[int, Query(ge=1, le=1000)] = 100,
    after: Annotated[str, Query(max_length=128)] = "",
) -> Response:
    """Vehicles by id; `next` is the `after` of the following page, null at the end."""

    def query(connection: Connection) -> list[dict[str, Any]]:
        rows = []
        for row in fleet.list_vehicles(connection, limit, after):
            view = load_view(core, connection, row.id)
            rows.append(
                {
                    "vehicle": row.id,
                    "health": view.health,
                    "last_window": optional_iso(row.last_window_ns),
                    "alarms": len(view.active),
                }
            )
        return rows

    found = await read(core, query)
    following = found[-1]["vehicle"] if len(found) == limit else None
    return json_response({"vehicles": found, "next": following})


@router.get("/vehicles/{id}", summary="A vehicle as it stands")
async def vehicle(core: CoreOf, id_: Id) -> Response:
    """Tracked parameters, fit, active alarms and health in the terms of NAMUR NE 107."""

    def query(connection: Connection) -> dict[str, Any]:
        known_vehicle(fleet.vehicle_exists(connection, id_), id_)
        counts = fleet.window_counts(connection, id_, core.pipeline.model_id)
        return load_view(core, connection, id_).as_dict() | {"windows": counts}

    return json_response(await read(core, query))


@router.get("/vehicles/{id}/history", summary="One parameter over time")
async def history(
    core: CoreOf,
    id_: Id,
    parameter: Annotated[str, Query(max_length=160)],
    since: Annotated[str | None, Query(max_length=40)] = None,
    until: Annotated[str | None, Query(max_length=40)] = None,
    resolution: Annotated[str | None, Query(max_length=20)] = None,
) -> Response:
    """The newest points of a parameter's posterior with since <= time < until, oldest first.

    Times are RFC 3339 or seconds since the epoch.  `resolution` is seconds per point (`30`, `1m`, `6h`), `0` or
    `raw` gives every window; chosen to fit where it is left out.
    """
    names = [p.name for p in core.engine.system.parameters]
    if parameter not in names:
        raise _wrong_query("parameter", f"{parameter[:160]!r} is no parameter of {core.engine.system.name}")
    start = _time("since", since, 0)
    end = _time("until", until, 2**63 - 1)
    width = _resolution(resolution)

    def query(connection: Connection) -> tuple[float, list[store_history.Point]]:
        known_vehicle(fleet.vehicle_exists(connection, id_), id_)
        key = (id_, core.pipeline.model_id)
        chosen = width
        if chosen is None:
            chosen = store_history.fitting_resolution(connection, *key, start, end, AUTO_POINTS)
        return chosen, store_history.history(connection, *key, start, end, chosen, MAX_POINTS)

    chosen, points = await read(core, query)
    return json_response(
        {
            "vehicle": id_,
            "parameter": parameter,
            "unit": core.engine.system.parameters[names.index(parameter)].unit,
            "nominal": core.engine.system.parameters[names.index(parameter)].nominal,
            "resolution": chosen,
            "points": point_dicts(core, points, names.index(parameter)),
        }
    )


@router.get("/vehicles/{id}/alarms", summary="A vehicle's alarms")
async def alarms(
    core: CoreOf,
    id_: Id,
    active: bool = False,
    limit: Annotated[int, Query(ge=1, le=1000)] = 100,
) -> Response:
    """Alarms, newest first, with the mismatch report that belongs to them where there is one."""

    def query(connection: Connection) -> list[fleet.AlarmRow]:
        known_vehicle(fleet.vehicle_exists(connection, id_), id_)
        return fleet.list_alarms(connection, id_, core.pipeline.model_id, limit, active)

    return json_response({"vehicle": id_, "alarms": [alarm_dict(row) for row in await read(core, query)]})


def load_view(core: Core, connection: Connection, vehicle_id: str) -> VehicleView:
    """A vehicle's view from the store."""
    row = fleet.load_tracker(connection, vehicle_id, core.pipeline.model_id)
    state = core.engine.tracker.initial_state() if row is None else core.engine.load_state(row.state)
    last = latest_window(connection, vehicle_id, core.pipeline.model_id)
    return vehicle_view(core.engine, vehicle_id, state, last)


def point_dicts(core: Core, points: list[store_history.Point], index: int) -> list[dict[str, Any]]:
    """JSON of a parameter's points."""
    nominal = core.engine.system.parameters[index].nominal
    found = []
    for point in points:
        value = nominal * float(np.exp(point.mean[index]))
        found.append(
            {
                "time": to_iso(point.time),
                "value": value,
                "std": value * float(point.std[index]),
                "low": nominal * float(np.exp(point.low[index])),
                "high": nominal * float(np.exp(point.high[index])),
                "ratio": value / nominal,
                "windows": point.windows,
            }
        )
    return found


def _time(name: str, text: str | None, default: int) -> int:
    if text is None:
        return default
    try:
        value = from_iso(text)
    except (ValueError, OverflowError):
        raise _wrong_query(name, "is no RFC 3339 time and no number of seconds since the epoch") from None
    return min(max(value, 0), 2**63 - 1)


def _resolution(text: str | None) -> float | None:
    if text is None or text == "auto":
        return None
    if text == "raw":
        return 0.0
    unit = UNITS.get(text[-1:])
    try:
        value = float(text if unit is None else text[:-1]) * (unit or 1.0)
    except ValueError:
        value = math.nan
    if not 0 <= value <= 1e9:
        raise _wrong_query("resolution", "is no number of seconds, nor one with s, m, h or d behind it")
    return value


def _wrong_query(name: str, detail: str) -> Problem:
    return Problem(422, f"{name}: {detail}", [{"field": name, "detail": detail}])

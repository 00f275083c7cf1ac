"""`GET /pages/vehicles/{id}`: one vehicle as a person who must decide about it needs to see it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Annotated, Any

from fastapi import APIRouter, Query
from fastapi.concurrency import run_in_threadpool
from fastapi.responses import HTMLResponse, Response
from sqlalchemy import Connection

from sprung.model.system import System
from sprung.service.api.access import CoreOf, known_vehicle, read
from sprung.service.api.actions import mark_dict
from sprung.service.api.answers import json_response
from sprung.service.api.fleet import load_view, silent_before
from sprung.service.api.history import MAX_POINTS, served_by
from sprung.service.api.lists import report_dict
from sprung.service.api.queries import FOREVER, Since, Until, time_of
from sprung.service.api.vehicle_model import models_answer
from sprung.service.diagnosis.task import IMPROVED
from sprung.service.monitoring.views import ParameterView, VehicleView, alarm_dict, suspected
from sprung.service.pages.routes import HEALTH
from sprung.service.rendering.drawing import Mark, plan_view, side_view
from sprung.service.rendering.render import percent, render
from sprung.service.rendering.states import hints
from sprung.service.store import fleet, lists, marks, status
from sprung.service.store.fleet import WantedAlarms
from sprung.service.store.standstill import UNINFORMATIVE, standing_points
from sprung.service.store.status import FleetRow
from sprung.service.times import NANOSECONDS, to_iso

router = APIRouter(include_in_schema=False)
SHOWN = 50  # alarms, marks, reports
REPLAYED_NS = 24 * 3600 * NANOSECONDS  # windows that come later than this are of a ride that is played again


@router.get("/pages/vehicles/{id}")
async def vehicle_page(core: CoreOf, id: str) -> HTMLResponse:
    """One vehicle: drawing, history, alarms, sensors, what was done to it."""

    def query(connection: Connection) -> dict[str, Any]:
        row = status.fleet_row(connection, id)
        known_vehicle(row is not None, id)
        assert row is not None
        served = core.pipeline.engines.of(connection, id)
        return {
            "row": row,
            "view": load_view(core, connection, id, served),
            "alarms": [alarm_dict(a) for a in fleet.list_alarms(connection, WantedAlarms(id), SHOWN)],
            "active": fleet.list_alarms(connection, WantedAlarms(id, active=True), SHOWN),
            "marks": [mark_dict(mark) for mark in marks.list_marks(connection, id, SHOWN)],
            "reports": [
                report_dict(r) | {"usable": (core.settings.reports / r.id / IMPROVED).is_file()}
                for r in lists.list_reports(connection, SHOWN, vehicle_id=id)
            ],
            "diagnosis": next(iter(lists.list_jobs(connection, 1, kind="diagnosis", vehicle_id=id)), None),
            "reasons": status.reasons_of(connection, id, served.model_id),
            "models": models_answer(core, connection, id),
            "system": served.engine.system,
        }

    values = await read(core, query)
    view, row, system = values["view"], values["row"], values.pop("system")
    silent = row.received_ns < silent_before(core)
    parameters = {p.name: parameter_mark(p) for p in view.parameters}
    sensors = sensor_marks(system, view)
    return HTMLResponse(
        render(
            "vehicle.html",
            **values,
            health=HEALTH,
            silent=silent,
            marked_at=_marked_at(row),
            standing=view.last is not None and view.last.outcome == UNINFORMATIVE,
            hints=hints(row, view, values["active"], values["reasons"], silent, sensors),
            side=side_view(system, parameters, sensors),
            plan=plan_view(system, parameters),
            ride=await run_in_threadpool(core.rides.latest, id),
            sensors=sensors,
            data=page_data(system, view, values["alarms"], values["marks"]),
        )
    )


def _marked_at(row: FleetRow) -> str:
    """When a mark is proposed to be; empty: now.  Where a ride of another day is replayed, after its newest window."""
    if row.last_window_ns is None or row.received_ns - row.last_window_ns < REPLAYED_NS:
        return ""
    return to_iso(row.last_window_ns + NANOSECONDS)[:19]


@router.get("/pages/vehicles/{id}/standing")
async def standing(
    core: CoreOf,
    id: str,
    resolution: Annotated[float, Query(ge=0, le=1e9)] = 0.0,
    since: Since = None,
    until: Until = None,
    model: Annotated[int | None, Query(ge=0, le=2**31 - 1)] = None,
) -> Response:
    """Times of the history's points, ms, in which no window told anything: there the page draws no line."""
    start, end = time_of("since", since, 0), time_of("until", until, FOREVER)

    def query(connection: Connection) -> list[int]:
        known_vehicle(fleet.vehicle_exists(connection, id), id)
        served = served_by(core, connection, id, model)
        return standing_points(connection, id, served.model_id, start, end, resolution, MAX_POINTS)

    return json_response({"time": [point // 1_000_000 for point in await read(core, query)]})


def parameter_mark(p: ParameterView) -> Mark:
    """How a parameter is shown in the drawing."""
    text = percent(p.drift, 0).replace(" ", "") if p.alarm is not None else ""
    return Mark(p.state, {"learning": "…", "not_identifiable": "?"}.get(p.state, text))


def sensor_marks(system: System, view: VehicleView) -> dict[str, Mark]:
    """How sensors, and inputs that an alarm names, are shown: suspect where an alarm says so, absent where nothing is
    received of them by an alarm or by the newest window."""
    faults = [suspected(alarm) for alarm in view.active if alarm.kind == "sensor"]
    silent = {channel for channels, fault in faults if fault == "silent" for channel in channels}
    suspects = {channel for channels, _ in faults for channel in channels} - silent
    found = {}
    for name in system.sensors:
        if name in suspects:
            found[name] = Mark("suspect")
        elif name in silent:
            found[name] = Mark("absent")
        elif name in view.per_sensor:
            found[name] = Mark("ok")
        else:
            found[name] = Mark("absent" if view.per_sensor else "learning")
    inputs = {channel.name for channel in system.inputs}
    return found | {
        name: Mark("absent" if name in silent else "suspect") for name in sorted((suspects | silent) & inputs)
    }


def page_data(
    system: System, view: VehicleView, alarms: list[dict[str, Any]], made: list[dict[str, Any]]
) -> dict[str, Any]:
    """What the page's script needs."""
    first = max(view.parameters, key=_attention, default=None)
    return {
        "vehicle": view.vehicle,
        "hop": system.hop / system.sample_rate,
        "first": None if first is None else first.name,
        "parameters": {p.name: {"unit": p.unit, "nominal": p.nominal, "baseline": p.baseline} for p in view.parameters},
        "twins": twins(system, view.parameters),
        "alarms": [{key: a[key] for key in ("parameter", "kind", "onset", "recovered", "severity")} for a in alarms],
        "marks": [{key: m[key] for key in ("kind", "time", "text")} for m in made],
        "last": view.last_window_ns and view.last_window_ns // 1_000_000,
    }


def twins(system: System, parameters: tuple[ParameterView, ...]) -> dict[str, dict[str, list[str]]]:
    """For every parameter those of the same kind: on the other side, at the other end, all."""
    places = {name: item.position for name, item in system.file.elements.items()}
    found: dict[str, dict[str, list[str]]] = {}
    for p in parameters:
        same = [q for q in parameters if q.quantity == p.quantity and q.unit == p.unit and q.name != p.name]
        alike = [q for q in same if _head(q.element) == _head(p.element)]
        side = [q.name for q in alike if _mirrored(places, p, q, x=1, y=-1)]
        end = [q.name for q in alike if _mirrored(places, p, q, x=-1, y=1)]
        found[p.name] = {"side": side, "end": end, "all": [q.name for q in alike]}
    return found


def _mirrored(places: Mapping[str, Any], p: ParameterView, q: ParameterView, x: int, y: int) -> bool:
    one, other = places.get(p.element), places.get(q.element)
    if one is None or other is None:
        return False
    return math.isclose(other[0], x * one[0], abs_tol=0.05) and math.isclose(other[1], y * one[1], abs_tol=0.05)


def _head(element: str) -> str:
    return element.split("_", 1)[0]


def _attention(p: ParameterView) -> tuple[int, float]:
    return ("not_identifiable", "learning", "ok", "warning", "alarm").index(p.state), abs(p.drift or 0.0)

"""`GET /vehicles/{id}/history`: parameters over time, as JSON for people and programs, or as a file."""

from __future__ import annotations

from typing import Annotated, Any, Literal

import numpy as np
from fastapi import APIRouter, Query
from fastapi.concurrency import run_in_threadpool
from fastapi.responses import Response
from sqlalchemy import Connection

from sprung.model.signals import FloatArray
from sprung.model.system import System
from sprung.service.api import models
from sprung.service.api.access import CoreOf, known_vehicle, read
from sprung.service.api.answers import json_response
from sprung.service.api.fleet import load_view
from sprung.service.api.queries import FOREVER, Id, Since, Until, resolution_of, time_of, wrong_query
from sprung.service.core import Core
from sprung.service.errors import NotFound, UserError
from sprung.service.export.tables import MEDIA_TYPES, history_file
from sprung.service.monitoring.engine import Engine
from sprung.service.monitoring.engines import ServedModel
from sprung.service.monitoring.views import VehicleView, known_limit
from sprung.service.store import fleet
from sprung.service.store import history as store_history
from sprung.service.store.history import Series
from sprung.service.times import to_iso

router = APIRouter(tags=["vehicles"])

MAX_POINTS = 5000
AUTO_POINTS = 2000  # where no resolution is asked for
BAND = 1.96  # standard deviations
DIGITS = 7  # significant ones in `columns`: far below any standard deviation

FILE_SCHEMA = {"type": "string", "format": "binary"}
Format = Literal["json", "columns", "csv", "parquet", "mcap"]


@router.get(
    "/vehicles/{id}/history",
    summary="Parameters over time",
    response_model=models.History | models.Histories | models.ColumnsAnswer,
    responses={200: {"content": {media: {"schema": FILE_SCHEMA} for media in MEDIA_TYPES.values()}}},
)
async def history(
    core: CoreOf,
    id_: Id,
    parameter: Annotated[list[str] | None, Query(max_length=400, description="ELEMENT.QUANTITY; repeatable")] = None,
    since: Since = None,
    until: Until = None,
    resolution: Annotated[
        str | None,
        Query(max_length=20, description="seconds per point (30, 1m, 6h), `raw` for single windows; else it fits"),
    ] = None,
    format: Annotated[Format, Query(description="files hold all parameters unless some are named")] = "json",
    model: Annotated[
        int | None, Query(ge=0, le=2**31 - 1, description="a version of the vehicle's model; the one in use")
    ] = None,
) -> Response:
    """The newest points of a parameter's posterior with since <= time < until, oldest first, at most 5000.

    What was estimated while another version of the vehicle's model was in use stays there: `model` asks for it.

    One `parameter` gives one history, several give `histories`.
    """
    start, end = time_of("since", since, 0), time_of("until", until, FOREVER)
    if end <= start:
        raise wrong_query("until", "is not later than `since`, so there is nothing between them")
    width = resolution_of(resolution)

    def query(connection: Connection) -> tuple[Engine, list[str], float, Series, VehicleView]:
        known_vehicle(fleet.vehicle_exists(connection, id_), id_)
        served = served_by(core, connection, id_, model)
        chosen = _names(served.engine.system, parameter, needed=format in ("json", "columns"))
        key = (id_, served.model_id)
        fit = width
        if fit is None:
            fit = store_history.fitting_resolution(connection, *key, start, end, AUTO_POINTS)
        view = load_view(core, connection, id_, served)
        older = store_history.older_windows(core.archive, id_, fleet.digest_of(connection, served.model_id))
        found = store_history.series(connection, *key, start, end, fit, MAX_POINTS, older)
        return served.engine, chosen, fit, found, view

    engine, chosen, step, found, view = await read(core, query)
    if format == "columns":
        return json_response(columns(engine, id_, chosen, step, found, view))
    if format in MEDIA_TYPES:
        body = await run_in_threadpool(history_file, engine, id_, chosen, found, format)
        name = f"{id_}-history.{format}".replace(":", "_")
        headers = {"Content-Disposition": f'attachment; filename="{name}"'}
        return Response(body, media_type=MEDIA_TYPES[format], headers=headers)
    answers = [{"vehicle": id_, "parameter": name, "resolution": step} | points(engine, name, found) for name in chosen]
    if len(answers) == 1:
        return json_response(answers[0])
    return json_response({"vehicle": id_, "resolution": step, "histories": answers})


def points(engine: Engine, name: str, found: Series) -> dict[str, Any]:
    """JSON of one parameter's points; those where nothing but the prior was known are left out."""
    index = [p.name for p in engine.system.tracked].index(name)
    parameter = engine.system.tracked[index]
    rows = []
    if len(found.time):
        known = found.std[:, index] < known_limit(engine)
        ratio, low, high = (np.exp(a[:, index]).tolist() for a in (found.mean, found.low, found.high))
        spread = found.std[:, index].tolist()
        for i in np.flatnonzero(known).tolist():
            value = parameter.nominal * ratio[i]
            std = value * spread[i]
            rows.append(
                {
                    "time": to_iso(int(found.time[i])),
                    "value": value,
                    "std": std,
                    "lower95": value - BAND * std,
                    "upper95": value + BAND * std,
                    "low": parameter.nominal * low[i],
                    "high": parameter.nominal * high[i],
                    "ratio": ratio[i],
                    "windows": int(found.windows[i]),
                }
            )
    return {"unit": parameter.unit, "nominal": parameter.nominal, "points": rows}


def columns(
    engine: Engine, vehicle: str, names: list[str], step: float, found: Series, view: VehicleView
) -> dict[str, Any]:
    """JSON for plots: a list a parameter instead of an object a point."""
    by_name = {p.name: (i, p) for i, p in enumerate(view.parameters)}
    answer: dict[str, Any] = {}
    for name in names:
        index, parameter = by_name[name]
        value, std = [], []
        if len(found.time):
            known = found.std[:, index] < known_limit(engine)
            values = parameter.nominal * np.exp(found.mean[:, index])
            value, std = _rounded(values, known), _rounded(values * found.std[:, index], known)
        answer[name] = {
            "unit": parameter.unit,
            "nominal": parameter.nominal,
            "baseline": parameter.baseline,
            "value": value,
            "std": std,
        }
    return {
        "vehicle": vehicle,
        "resolution": step,
        "time": (found.time // 1_000_000).tolist(),
        "windows": found.windows.tolist(),
        "parameters": answer,
    }


def _rounded(values: FloatArray, known: Any) -> list[float | None]:
    """Values with `DIGITS` significant digits; None where they are not known."""
    with np.errstate(divide="ignore"):
        places = np.where(values != 0.0, DIGITS - 1 - np.floor(np.log10(np.abs(values))), 0.0)
    up, down = 10.0 ** np.maximum(places, 0.0), 10.0 ** np.maximum(-places, 0.0)  # both whole: divisions stay exact
    short = np.round(values * up / down) / up * down
    return [value if ok else None for value, ok in zip(short.tolist(), known.tolist(), strict=True)]


def served_by(core: Core, connection: Connection, vehicle: str, version: int | None) -> ServedModel:
    """What a vehicle is followed with, or another version of it; 404 where there is none."""
    if version is None:
        return core.pipeline.engines.of(connection, vehicle)
    try:
        return core.pipeline.engines.version(connection, vehicle, version)
    except UserError as error:
        raise NotFound(str(error)) from error


def _names(system: System, asked: list[str] | None, needed: bool) -> list[str]:
    """The parameters asked for, all where none is needed; 422 for one that the system does not have."""
    known = [p.name for p in system.tracked]
    if not asked:
        if needed:
            raise wrong_query("parameter", "is needed; name one or more, as in parameter=ELEMENT.stiffness")
        return known
    for name in asked:
        if name not in known:
            raise wrong_query("parameter", f"{name[:160]!r} is no parameter of {system.name}")
    return list(dict.fromkeys(asked))

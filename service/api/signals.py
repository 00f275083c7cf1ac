"""Signals that are still held of a vehicle: the newest window compared, and everything as a bundle for other tools."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from typing import Any

import numpy as np
from fastapi import APIRouter
from fastapi.concurrency import run_in_threadpool
from fastapi.responses import Response
from sqlalchemy import Connection

from sprung.service.api import models
from sprung.service.api.access import CoreOf, json_response, known_vehicle, read
from sprung.service.api.queries import FOREVER, Id
from sprung.service.compute import Priority
from sprung.service.core import Core
from sprung.service.engines import ServedModel
from sprung.service.export.bundle import BUNDLE_MEDIA, Bundle, bundle
from sprung.service.simulated import Compared, compare, newest_window, whole_windows
from sprung.service.store import fleet, history, marks
from sprung.service.store.fleet import WantedAlarms
from sprung.service.times import NANOSECONDS, to_iso
from sprung.service.views import finite

router = APIRouter(tags=["vehicles"])
DIGITS = 5
BUNDLE_SECONDS = 3600  # of estimates beside the signals
BUNDLE_POINTS = 5000


@router.get(
    "/vehicles/{id}/window", summary="Measured against simulated, newest window", response_model=models.WindowAnswer
)
async def window(core: CoreOf, id_: Id) -> Response:
    """Every sensor of the newest window that is held in memory, with what the identified model makes of it."""
    served = await read(core, lambda connection: _served(core, connection, id_))
    start, values = newest_window(served.engine, core.diagnoses.excerpt(id_), id_)
    work = core.compute.submit(lambda: compare(served.engine, start, values), Priority.REQUEST)
    return json_response(window_dict(served.engine.system, id_, await asyncio.wrap_future(work)))


@router.get(
    "/vehicles/{id}/bundle",
    summary="Signals, simulation, estimates and events as MCAP",
    response_class=Response,
    responses={200: {"content": {BUNDLE_MEDIA: {"schema": {"type": "string", "format": "binary"}}}}},
)
async def vehicle_bundle(core: CoreOf, id_: Id) -> Response:
    """One MCAP file with JSON schemas: the last minute of raw signals, simulation and residuals, the last hour of
    estimates, alarms and marks as `foxglove.Log`."""

    served = await read(core, lambda connection: _served(core, connection, id_))

    def query(connection: Connection) -> Bundle:
        key = (id_, served.model_id)
        newest = history.series(connection, *key, 0, FOREVER, 0, 1)
        since = int(newest.time[-1]) - BUNDLE_SECONDS * NANOSECONDS if len(newest.time) else 0
        return Bundle(
            vehicle=id_,
            series=history.series(connection, *key, since, FOREVER, 1, BUNDLE_POINTS),
            alarms=fleet.list_alarms(connection, WantedAlarms(id_), 1000),
            marks=marks.list_marks(connection, id_, 1000),
        )

    found = await read(core, query)
    excerpt = core.diagnoses.excerpt(id_)
    windows = list(whole_windows(served.engine, excerpt))

    def compared() -> Sequence[Compared]:
        return [compare(served.engine, *held) for held in windows]

    work = core.compute.submit(compared, Priority.BATCH)
    body = await run_in_threadpool(bundle, served.engine, found, excerpt, await asyncio.wrap_future(work))
    headers = {"Content-Disposition": f'attachment; filename="{id_.replace(":", "_")}.mcap"'}
    return Response(body, media_type=BUNDLE_MEDIA, headers=headers)


def _served(core: Core, connection: Connection, vehicle: str) -> ServedModel:
    """What a known vehicle is followed with; 404 for an unknown one."""
    known_vehicle(fleet.vehicle_exists(connection, vehicle), vehicle)
    return core.pipeline.engines.of(connection, vehicle)


def window_dict(system: Any, vehicle: str, found: Compared) -> dict[str, Any]:
    """JSON of a compared window."""
    units = {channel.name: channel.unit for channel in system.channels}
    sensors = {}
    for i, name in enumerate(system.sensors):
        measured, simulated = found.measured[:, i], found.simulated[:, i]
        sensors[name] = {
            "unit": units[name],
            "measured": _short(measured),
            "simulated": _short(simulated),
            "residual": _short(measured - simulated),
            "nrmse": finite(float(found.estimate.per_sensor[i])),
        }
    return {
        "vehicle": vehicle,
        "start": to_iso(found.start),
        "sample_rate": found.sample_rate,
        "adequate": bool(found.estimate.adequate),
        "sensors": sensors,
    }


def _short(values: Any) -> list[float | None]:
    return [float(f"{v:.{DIGITS}g}") if np.isfinite(v) else None for v in values.tolist()]

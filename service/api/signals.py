"""Signals that are still held of a vehicle: the newest window compared, and everything as a bundle for other tools."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from functools import partial
from typing import Annotated, Any

import numpy as np
from fastapi import APIRouter, Query, Request
from fastapi.concurrency import run_in_threadpool
from fastapi.responses import Response
from sqlalchemy import Connection

from sprung.service.api import models
from sprung.service.api.access import CoreOf, known_vehicle, read
from sprung.service.api.answers import json_response
from sprung.service.api.head import headers_only
from sprung.service.api.queries import FOREVER, Id
from sprung.service.core import Core
from sprung.service.diagnosis import alarm_signals
from sprung.service.diagnosis.alarm_signals import Stretch
from sprung.service.errors import NotFound
from sprung.service.export.bundle import BUNDLE_MEDIA, Bundle, bundle
from sprung.service.monitoring.compute import Priority
from sprung.service.monitoring.engines import ServedModel
from sprung.service.monitoring.simulated import Compared, compare, compare_all, newest_window, whole_windows
from sprung.service.monitoring.views import finite
from sprung.service.store import fleet, history, marks, work
from sprung.service.store.fleet import AlarmRow, WantedAlarms
from sprung.service.times import NANOSECONDS, to_iso

router = APIRouter(tags=["vehicles"])
DIGITS = 5
BUNDLE_SECONDS = 1800  # of estimates around an alarm, half before and half after it
BUNDLE_POINTS = 5000
AT_ONCE = 10  # windows simulated before others have their turn


@router.get(
    "/vehicles/{id}/window", summary="Measured against simulated, newest window", response_model=models.WindowAnswer
)
async def window(core: CoreOf, id_: Id) -> Response:
    """Every sensor of the newest window that is held in memory, with what the identified model makes of it."""
    served = await read(core, lambda connection: _served(core, connection, id_))
    start, values = newest_window(served.engine, core.diagnoses.excerpt(id_), id_)
    work = core.pipeline.compute_of(served).submit(lambda: compare(served.engine, start, values), Priority.REQUEST)
    return json_response(window_dict(served.engine.system, id_, await asyncio.wrap_future(work)))


@router.get(
    "/vehicles/{id}/bundle",
    summary="Signals, simulation, estimates and events as MCAP",
    response_class=Response,
    responses={200: {"content": {BUNDLE_MEDIA: {"schema": {"type": "string", "format": "binary"}}}}},
)
async def vehicle_bundle(
    core: CoreOf,
    request: Request,
    id_: Id,
    alarm: Annotated[
        int | None, Query(ge=1, le=2**31 - 1, description="one of the vehicle's; else the newest active one")
    ] = None,
) -> Response:
    """One MCAP file with JSON schemas: raw signals, simulation and residuals of the minute in which an alarm was
    raised, estimates around it, alarms and marks as `foxglove.Log`.

    An event says which stretch the file holds, and why where the alarm's onset is not in it.  Without `alarm` and
    without signals of an active alarm it is the newest minute.
    """

    def query(connection: Connection) -> tuple[ServedModel, Bundle]:
        served = _served(core, connection, id_)
        chosen = _alarm(connection, id_, alarm)
        stretches = [*alarm_signals.kept(connection, id_), *_in_memory(core, id_)]
        stretch, message = choose(connection, id_, chosen, stretches, newest=alarm is None)
        return served, Bundle(
            vehicle=id_,
            series=_estimates(core, connection, id_, served, stretch, chosen),
            alarms=fleet.list_alarms(connection, WantedAlarms(id_), 1000),
            marks=marks.list_marks(connection, id_, 1000),
            stretch=stretch,
            reason=message,
        )

    if headers_only(request):
        await read(core, lambda connection: (_served(core, connection, id_), _alarm(connection, id_, alarm)))
        return Response(media_type=BUNDLE_MEDIA, headers=_file_headers(id_, alarm))
    served, found = await read(core, query)
    system, excerpt = served.engine.system, None
    if found.stretch is not None:
        excerpt = await run_in_threadpool(core.alarm_signals.load, found.stretch, id_, system)
    windows = list(whole_windows(served.engine, excerpt))
    compared: list[Compared] = []
    while windows:  # in parts: windows that come live have their turn between them
        at_once = core.pipeline.pace.windows(served, AT_ONCE)
        part, windows = windows[:at_once], windows[at_once:]
        some = core.pipeline.compute_of(served).submit(partial(compare_all, served.engine, part), Priority.REQUEST)
        simulated = await asyncio.wrap_future(some)
        compared += simulated
    body = await run_in_threadpool(bundle, served.engine, found, excerpt, compared)
    return Response(body, media_type=BUNDLE_MEDIA, headers=_file_headers(id_, alarm))


def _file_headers(vehicle: str, alarm: int | None) -> dict[str, str]:
    name = vehicle.replace(":", "_") + ("" if alarm is None else f"-alarm-{alarm}")
    return {"Content-Disposition": f'attachment; filename="{name}.mcap"'}


def _alarm(connection: Connection, vehicle: str, number: int | None) -> AlarmRow | None:
    """The alarm that is asked for, else the newest active one; 404 where the vehicle has no such alarm."""
    if number is None:
        return next(iter(fleet.list_alarms(connection, WantedAlarms(vehicle, active=True), 1)), None)
    found = fleet.list_alarms(connection, WantedAlarms(vehicle, number=number), 1)
    if not found:
        raise NotFound(f"vehicle {vehicle} has no alarm {number}")
    return found[0]


def _in_memory(core: Core, vehicle: str) -> list[Stretch]:
    excerpt = core.diagnoses.excerpt(vehicle)
    return [] if excerpt is None else [alarm_signals.held(excerpt)]


def choose(
    connection: Connection, vehicle: str, alarm: AlarmRow | None, stretches: Sequence[Stretch], newest: bool
) -> tuple[Stretch | None, str]:
    """Which samples a bundle holds, and a sentence that says so.

    newest: whether the newest samples serve where those of the alarm are not kept.
    """
    last = next((one for one in stretches if one.recording is None), None)
    if alarm is None:
        return last, _of(last, "the newest samples of the vehicle") if last else "no recent samples are held"
    stretch = alarm_signals.best(stretches, alarm.onset, alarm.opened)
    what = f"alarm {alarm.id} ({alarm.parameter or 'windows do not fit the model'})"
    if stretch is not None and stretch.covers(alarm.onset):
        return stretch, _of(stretch, f"the onset of {what} at {to_iso(alarm.onset)}")
    if stretch is not None:
        message = f"the raising of {what} at {to_iso(alarm.opened)}"
        gone = f"its onset at {to_iso(alarm.onset)} lies before: samples are held for a minute only"
        return stretch, f"{_of(stretch, message)}; {gone}"
    message = f"no raw signals of {what} are kept: it was found in a recording, or they were given up for room or age"
    source = work.recording_at(connection, vehicle, alarm.onset)
    if source is not None:
        there = "whose file is still here" if source.file is not None else "whose file is gone"
        message += f"; its onset at {to_iso(alarm.onset)} is in the recording {source.name} ({source.id}), {there}"
    if newest and last is not None:
        return last, f"{message}; {_of(last, 'the newest samples instead')}"
    return None, message


def _of(stretch: Stretch, what: str) -> str:
    return f"signals from {to_iso(stretch.start)} to {to_iso(stretch.end)}: {what}"


def _estimates(
    core: Core,
    connection: Connection,
    vehicle: str,
    served: ServedModel,
    stretch: Stretch | None,
    alarm: AlarmRow | None,
) -> history.Series:
    """Estimates around an alarm, else up to the newest: single windows where they are still stored."""
    key = (vehicle, served.model_id)
    around = round(BUNDLE_SECONDS / 2 * NANOSECONDS)
    times = [] if alarm is None else [alarm.onset, alarm.opened]
    times += [] if stretch is None else [stretch.start, stretch.end]
    if not times:
        times = history.series(connection, *key, 0, FOREVER, 0, 1).time.tolist() or [0]
    since, until = max(0, min(times) - around), max(times) + around
    step = history.fitting_resolution(connection, *key, since, until, BUNDLE_POINTS)
    older = history.older_windows(core.archive, vehicle, served.engine.digest)
    return history.series(connection, *key, since, until, step, BUNDLE_POINTS, older)


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
        "reason": found.estimate.reason,
        "sensors": sensors,
    }


def _short(values: Any) -> list[float | None]:
    return [float(f"{v:.{DIGITS}g}") if np.isfinite(v) else None for v in values.tolist()]

"""`GET /pages/vehicles/{id}`: one vehicle."""

from __future__ import annotations

from typing import Any

import numpy as np
from fastapi import APIRouter
from fastapi.responses import HTMLResponse
from sqlalchemy import Connection

from sprung.service.api.access import CoreOf, known_vehicle, read
from sprung.service.api.fleet import load_view
from sprung.service.core import Core
from sprung.service.pages.plot import Trace, drift_svg
from sprung.service.pages.render import render
from sprung.service.pages.routes import HEALTH
from sprung.service.store import fleet, history, status, work
from sprung.service.store.fleet import WantedAlarms
from sprung.service.times import to_iso
from sprung.service.views import VehicleView, alarm_dict

router = APIRouter(include_in_schema=False)

SHOWN_ALARMS = 50
PLOT_POINTS = 180
FOREVER = 2**63 - 1


@router.get("/pages/vehicles/{id}")
async def vehicle_page(core: CoreOf, id: str) -> HTMLResponse:
    """One vehicle: parameters, drift, alarms, reports."""

    def query(connection: Connection) -> dict[str, Any]:
        row = status.fleet_row(connection, id)
        known_vehicle(row is not None, id)
        view = load_view(core, connection, id)
        return {
            "view": view,
            "plots": _plots(core, connection, view),
            "alarms": [alarm_dict(a) for a in fleet.list_alarms(connection, WantedAlarms(id), SHOWN_ALARMS)],
            "reports": work.list_reports(connection, id, SHOWN_ALARMS),
            "windows": row.windows if row is not None else {},
        }

    values = await read(core, query)
    return HTMLResponse(render("vehicle.html", **values, health=HEALTH, to_iso=to_iso))


def _plots(core: Core, connection: Connection, view: VehicleView) -> list[str]:
    key = (view.vehicle, core.pipeline.model_id)
    resolution = history.fitting_resolution(connection, *key, 0, FOREVER, PLOT_POINTS)
    points = history.history(connection, *key, 0, FOREVER, resolution, 2 * PLOT_POINTS)
    if not points:
        return []
    ratio = np.exp(np.stack([p.mean for p in points]))  # shape (n, P)
    std = ratio * np.stack([p.std for p in points])
    times = [p.time for p in points]
    return [
        drift_svg(
            Trace(
                p.name,
                times,
                ratio[:, i],
                std[:, i],
                None if p.baseline is None else p.baseline / p.nominal,
                p.alarm,
            )
        )
        for i, p in enumerate(view.parameters)
    ]

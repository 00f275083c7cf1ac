"""`GET /vehicles/{id}/circumstances`: how a vehicle ran, to be laid below the history of its parameters."""

from __future__ import annotations

from fastapi import APIRouter
from fastapi.responses import Response
from sqlalchemy import Connection

from sprung.service.api.access import CoreOf, known_vehicle, read
from sprung.service.api.answers import json_response
from sprung.service.api.circumstance_models import CircumstancesAnswer
from sprung.service.api.queries import FOREVER, Id, Since, Until, time_of
from sprung.service.monitoring.views import UNITS
from sprung.service.store import fleet
from sprung.service.store.circumstances import CircumstanceSeries, circumstances_between

router = APIRouter(tags=["vehicles"])
MOST_POINTS = 2000
DIGITS = 7  # significant ones


@router.get(
    "/vehicles/{id}/circumstances", summary="Load, temperature, speed over time", response_model=CircumstancesAnswer
)
async def circumstances(core: CoreOf, id_: Id, since: Since = None, until: Until = None) -> Response:
    """Means of what each body carried, and of the temperature, speed and pressures where the system file says where
    they are measured, with since <= time < until, oldest first."""
    start, end = time_of("since", since, 0), time_of("until", until, FOREVER)

    def query(connection: Connection) -> CircumstanceSeries:
        known_vehicle(fleet.vehicle_exists(connection, id_), id_)
        return circumstances_between(connection, id_, start, end, MOST_POINTS)

    found = await read(core, query)
    series = {
        name: {
            "unit": UNITS.get(name.rpartition(".")[2], ""),
            "value": [None if value is None else float(f"{value:.{DIGITS}g}") for value in values],
        }
        for name, values in sorted(found.values.items())
    }
    time = [start // 1_000_000 for start in found.time]
    return json_response({"vehicle": id_, "resolution": found.resolution, "time": time, "series": series})

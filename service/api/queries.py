"""What routes read from a query: times, resolutions, cursors; and no parameter that they do not know."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Annotated, TypeVar, get_args, get_origin

from fastapi import Path, Query, Request
from fastapi.routing import APIRoute

from sprung.service.api.bodies import VehicleId
from sprung.service.api.problems import ApiProblem
from sprung.service.times import from_iso

T = TypeVar("T")
UNITS = {"s": 1.0, "m": 60.0, "h": 3600.0, "d": 86400.0}
FOREVER = 2**63 - 1

Id = Annotated[str, Path(alias="id", max_length=128, description="the vehicle, as recordings call it")]
OfVehicle = Annotated[VehicleId | None, Query(description="of this vehicle only")]
Version = Annotated[int, Path(ge=0, le=2**31 - 1, description="of the vehicle's model")]
Limit = Annotated[int, Query(ge=1, le=1000, description="rows of one page")]
After = Annotated[str | None, Query(max_length=200, description="`next` of the page before")]
Since = Annotated[str | None, Query(max_length=40, description="RFC 3339, or seconds since the epoch; inclusive")]
Until = Annotated[str | None, Query(max_length=40, description="RFC 3339, or seconds since the epoch; exclusive")]


async def only_known_parameters(request: Request) -> None:
    """422 for a query parameter that the route does not have, or takes once: others would be ignored in silence."""
    route = request.scope.get("route")
    if not isinstance(route, APIRoute) or not request.query_params:
        return
    for name, value in request.query_params.multi_items():
        if any(ord(sign) < 32 for sign in value):
            raise wrong_query(name[:100], "holds a control character")
    known = {field.alias for field in route.dependant.query_params}
    wrong = [name for name in request.query_params if name not in known]
    if wrong:
        allowed = f"the route has {', '.join(sorted(known))}" if known else "the route has none"
        errors = [{"field": name[:100], "detail": f"is not a query parameter here; {allowed}"} for name in wrong[:20]]
        raise ApiProblem(422, f"{errors[0]['field']} {errors[0]['detail']}", errors)
    for field in route.dependant.query_params:
        takes_several = any(get_origin(part) is list for part in get_args(field.field_info.annotation))
        if not takes_several and len(request.query_params.getlist(field.alias)) > 1:
            raise wrong_query(field.alias, "is there more than once")


def time_of(name: str, text: str | None, default: int) -> int:
    """Nanoseconds since the epoch of a query's time."""
    if text is None:
        return default
    try:
        value = from_iso(text)
    except (ValueError, OverflowError):
        detail = "is no RFC 3339 time with a zone (2026-09-21T14:13:20Z) and no number of seconds since the epoch"
        raise wrong_query(name, detail) from None
    return min(max(value, 0), FOREVER)


def resolution_of(text: str | None) -> float | None:
    """Seconds per point; None where the service chooses."""
    if text is None or text == "auto":
        return None
    if text == "raw":
        return 0.0
    unit = UNITS.get(text[-1:])
    try:
        value = float(text if unit is None else text[:-1]) * (unit or 1.0)
    except ValueError:
        value = math.nan
    if not (value == 0 or 1e-3 <= value <= 1e9):
        raise wrong_query("resolution", "is no number of seconds, nor one with s, m, h or d behind it")
    return value


def wrong_query(name: str, detail: str) -> ApiProblem:
    """422 that names a query parameter."""
    return ApiProblem(422, f"{name}: {detail}", [{"field": name, "detail": detail}])


def with_cursor(query: Callable[[], T]) -> T:
    """Run a query that reads a cursor; 422 for one that no page gave."""
    try:
        return query()
    except ValueError as error:
        raise wrong_query("after", "is no `next` of a page before") from error


def one_of(name: str, value: str | None, known: Sequence[str]) -> str | None:
    """A value out of a list; 422 for another."""
    if value is not None and value not in known:
        raise wrong_query(name, f"{value[:60]!r} is none of {', '.join(known)}")
    return value

"""Every error as RFC 9457 `application/problem+json`."""

from __future__ import annotations

import errno
import json
import logging
from collections.abc import Mapping, Sequence
from http import HTTPStatus
from typing import Any

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import HTMLResponse, Response
from pydantic import ValidationError
from sqlalchemy.exc import DBAPIError, InterfaceError, OperationalError, SQLAlchemyError
from sqlalchemy.exc import TimeoutError as PoolTimeout
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect
from starlette.routing import BaseRoute, Match, Route

from sprung.model.text import first_line
from sprung.service.errors import NO_THREAD, Busy, NoSpace, NotFound, TooManyOfOne, UserError
from sprung.service.observability.logs import LOGGED
from sprung.service.rendering.render import render

MEDIA_TYPE = "application/problem+json"
SHOWN_ERRORS = 20  # of a body with thousands of wrong numbers

NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
WAIT = {"Retry-After": "10"}
ROOM = {"Retry-After": "600"}  # for which an upload waits: housekeeping makes room every hour

log = logging.getLogger("sprung.api")


class ApiProblem(Exception):
    """An answer that is an error.  `errors` name the fields: `{"field": "channels.car_1l", "detail": "..."}`."""

    def __init__(
        self,
        status: int,
        detail: str,
        errors: Sequence[Mapping[str, str]] = (),
        headers: Mapping[str, str] | None = None,
    ) -> None:
        super().__init__(detail)
        self.status = status
        self.detail = detail
        self.errors = list(errors)
        self.headers = dict(headers or {})


def problem_response(problem: ApiProblem, instance: str) -> Response:
    """The answer on the wire."""
    body: dict[str, Any] = {
        "type": "about:blank",
        "title": HTTPStatus(problem.status).phrase,
        "status": problem.status,
        "detail": problem.detail,
        "instance": instance,
    }
    if problem.errors:
        body["errors"] = problem.errors
    headers = {"X-Content-Type-Options": "nosniff"} | problem.headers  # details may contain client input
    return Response(json.dumps(body), problem.status, headers, MEDIA_TYPE)


def wants_page(method: str, headers: Mapping[str, str]) -> bool:
    """Whether a person's browser asks for something to look at; programs, and `fetch` without more, take anything."""
    accepted = headers.get("accept", "")
    return method in ("GET", "HEAD") and "text/html" in accepted and "application/json" not in accepted


def problem_page(problem: ApiProblem, instance: str) -> Response:
    """The same answer as a page: the error, and a link back; as for programs where no file can be read any more."""
    title = HTTPStatus(problem.status).phrase
    try:
        page = render("problem.html", title=title, status=problem.status, detail=problem.detail)
    except (OSError, MemoryError):
        return problem_response(problem, instance)
    return HTMLResponse(page, problem.status, {"X-Content-Type-Options": "nosniff"} | problem.headers)


def from_validation(error: ValidationError, prefix: str = "") -> ApiProblem:
    """422 that names the fields which are wrong; the values themselves are not repeated."""
    found = error.errors(include_url=False, include_input=False, include_context=False)
    errors = [
        {"field": (prefix + ".".join(map(str, e["loc"]))).strip(".") or "body", "detail": e["msg"]}
        for e in found[:SHOWN_ERRORS]
    ]
    first = errors[0]
    more = f" (and {len(found) - 1} more)" if len(found) > 1 else ""
    return ApiProblem(422, f"{first['field']}: {first['detail']}{more}", errors)


EXPECTED = (
    ApiProblem,
    ClientDisconnect,
    HTTPException,
    RequestValidationError,
    UserError,
    Busy,
    NotFound,
    NoSpace,
    SQLAlchemyError,
    OSError,
    MemoryError,
)


def install(app: FastAPI) -> None:
    """Answer every exception of the app with a problem."""

    async def on_problem(request: Request, error: Exception) -> Response:
        if isinstance(error, ClientDisconnect):  # the client is gone
            return Response(status_code=499)
        problem = _as_problem(error)
        if problem.status == 405:
            problem.headers["Allow"] = ", ".join(_methods(app, request))
        if wants_page(request.method, request.headers):
            return problem_page(problem, request.url.path)
        return problem_response(problem, request.url.path)

    for kind in (*EXPECTED, Exception):
        app.add_exception_handler(kind, on_problem)


def _methods(app: FastAPI, request: Request) -> list[str]:
    """The methods of all routes at a path: a single route only knows its own."""
    found: set[str] = set()

    def walk(routes: Sequence[BaseRoute]) -> None:
        for route in routes:
            inside = getattr(route, "original_router", None)  # routers stay whole inside the application
            if inside is not None:
                walk(inside.routes)
            elif isinstance(route, Route) and route.matches(dict(request.scope))[0] is not Match.NONE:
                found.update(route.methods or ())

    walk(app.routes)
    found = found or {"GET"}  # no route at all: a file of /static
    return sorted(found | ({"HEAD"} if "GET" in found else set()))


def _as_problem(error: Exception) -> ApiProblem:
    match error:
        case ApiProblem():
            return error
        case HTTPException():
            return ApiProblem(error.status_code, str(error.detail), headers=error.headers)
        case RequestValidationError():
            errors = [_fault(e) for e in error.errors()[:SHOWN_ERRORS]]
            return ApiProblem(422, "; ".join(f"{e['field']}: {e['detail']}" for e in errors[:3]), errors)
        case TooManyOfOne():
            return ApiProblem(429, str(error), headers={"Retry-After": str(error.retry_after)})
        case Busy():
            return ApiProblem(503, str(error), headers={"Retry-After": str(error.retry_after)})
        case NotFound():
            return ApiProblem(404, str(error))
        case UserError():
            return ApiProblem(422, str(error))
        case NoSpace():
            return ApiProblem(507, str(error), headers=ROOM)
        case SQLAlchemyError() | OSError() | MemoryError() | RuntimeError() if found := _resource_problem(error):
            log.error("%s: %s", found.detail, first_line(error))
            return found
        case _:
            log.error("unexpected error", exc_info=error)
            setattr(error, LOGGED, True)
            return ApiProblem(500, "an unexpected error; the service's log has the details")


def _fault(error: Mapping[str, Any]) -> dict[str, str]:
    """A field and its error; `body` for errors of no field."""
    if error["type"] == "json_invalid":
        place = f"is no JSON: {error.get('ctx', {}).get('error', error['msg'])}, character {error['loc'][-1]}"
        return {"field": "body", "detail": place}
    field = ".".join(str(part) for part in error["loc"] if part != "body")
    return {"field": field or "body", "detail": str(error["msg"])}


def _resource_problem(error: BaseException) -> ApiProblem | None:
    """What the machine lacks, as the client should know it; None for an error of another kind."""
    if isinstance(error, MemoryError) or str(error) == NO_THREAD:
        return ApiProblem(503, "the service is out of memory", headers=WAIT)
    if isinstance(error, OSError):
        if error.errno in NO_ROOM:
            return ApiProblem(507, "there is no room left on the service's disk", headers=WAIT)
        if error.errno in (errno.EMFILE, errno.ENFILE):
            return ApiProblem(503, "the service has too many files open", headers=WAIT)
        if error.errno in (errno.EROFS, errno.EIO, errno.EACCES, errno.EPERM):
            return ApiProblem(503, "the service cannot write to its disk", headers=WAIT)
        return None
    if isinstance(error, OperationalError | InterfaceError | PoolTimeout):
        if "full" in str(error.orig if isinstance(error, DBAPIError) else error):
            return ApiProblem(507, "there is no room left for the store", headers=WAIT)
        return ApiProblem(503, "the store does not take anything at the moment", headers=WAIT)
    return None

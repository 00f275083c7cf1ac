"""HTTP ingest of the fleet variant: receives estimates and windows and passes them to identification and folding.

It is the same guard, the same bodies and the same answers as in the single process; behind it is anything that
implements `Behind`, such as Ray Serve (`service.api.ray_serving`).  It loads no model: what windows have to look like
it asks those who identify them.
"""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Protocol

from fastapi import FastAPI, Request
from fastapi.concurrency import run_in_threadpool
from fastapi.responses import Response
from pydantic import TypeAdapter, ValidationError
from sqlalchemy.exc import SQLAlchemyError

from sprung import __version__
from sprung.service.access.tokens import Tokens
from sprung.service.api import models, problems
from sprung.service.api.actors import ActorOf, own_vehicle
from sprung.service.api.answers import json_response
from sprung.service.api.bodies import VehicleId, read_windows
from sprung.service.api.guard import Guard
from sprung.service.api.limits import BodyLimit
from sprung.service.api.problems import ApiProblem
from sprung.service.errors import Busy
from sprung.service.fleet.message import IngestResult, OtherModel, SentWindows, read_messages
from sprung.service.monitoring.form import WindowForm
from sprung.service.settings import Settings
from sprung.service.store import Store
from sprung.service.times import now_ns

_ID: TypeAdapter[str] = TypeAdapter(VehicleId)


class Behind(Protocol):
    """Who does the work.  Raises Busy when too much waits."""

    async def form(self) -> WindowForm:
        """What windows look like that are identified; asked once, before the first request."""

    async def fold(self, body: bytes) -> IngestResult:
        """Fold a message of estimates; it is stored when this returns."""

    async def identify_and_fold(self, sent: SentWindows) -> IngestResult:
        """Identify windows and fold their estimates."""


def ingest_app(settings: Settings, store: Store, behind: Behind) -> FastAPI:
    """`POST /ingest/estimates`, `POST /ingest/windows` and the health of a replica."""

    @asynccontextmanager
    async def asked(app: FastAPI) -> AsyncIterator[None]:
        app.state.form = await behind.form()
        yield

    app = FastAPI(title="Sprung ingest", version=__version__, docs_url=None, redoc_url=None, lifespan=asked)
    problems.install(app)

    @app.post("/ingest/estimates", response_model=models.IngestAnswer)
    async def estimates(request: Request, actor: ActorOf) -> Response:
        """One message of an edge."""
        body = await request.body()
        message = (await run_in_threadpool(read_messages, [body]))[0]
        _check_id(message.vehicle)
        own_vehicle(actor, message.vehicle)
        try:
            return _answer(await behind.fold(body))
        except OtherModel as error:
            raise ApiProblem(409, str(error)) from error
        except Busy as error:
            raise _too_many(error) from error

    @app.post("/ingest/windows", response_model=models.IngestAnswer)
    async def windows(request: Request, actor: ActorOf) -> Response:
        """Windows of a vehicle: one as `POST /identify` takes it, with vehicle and start, or a list `windows`."""
        sent = await run_in_threadpool(read_windows, await request.body(), app.state.form, now_ns())
        own_vehicle(actor, sent.vehicle)
        try:
            return _answer(await behind.identify_and_fold(sent))
        except Busy as error:
            raise _too_many(error) from error

    @app.get("/health/live")
    async def live() -> Response:
        """The replica answers."""
        return json_response({"status": "ok"})

    @app.get("/health/ready")
    async def ready() -> Response:
        """The store can be written."""
        try:
            await run_in_threadpool(store.probe)
        except (SQLAlchemyError, OSError, TimeoutError) as error:
            detail = "the store does not take anything at the moment"
            raise ApiProblem(503, detail, headers={"Retry-After": "5"}) from error
        return json_response({"status": "ok"})

    app.add_middleware(BodyLimit, limit=settings.max_body_bytes, paths={})
    secret = None if settings.admin_token is None else settings.admin_token.get_secret_value()
    app.add_middleware(Guard, settings=settings, tokens=Tokens(store, secret))
    return app


def _check_id(vehicle: str) -> None:
    try:
        _ID.validate_python(vehicle)
    except ValidationError:
        raise ApiProblem(422, "vehicle: letters, digits and . _ : - only, at most 128") from None


def _answer(taken: IngestResult) -> Response:
    return json_response(
        {"vehicle": taken.vehicle, "folded": taken.folded, "waiting": taken.waiting, "known": taken.known}
    )


def _too_many(error: Busy) -> ApiProblem:
    return ApiProblem(429, str(error), headers={"Retry-After": str(error.retry_after)})

"""The FastAPI application: every route in one list, limits before them, problems after them."""

from __future__ import annotations

from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager

from fastapi import Depends, FastAPI
from fastapi.concurrency import run_in_threadpool

from sprung import __version__
from sprung.service.api import (
    actions,
    admin,
    circumstances,
    diagnose,
    docs,
    events,
    fleet,
    fleet_knowledge,
    health,
    history,
    idempotency,
    identify,
    ingest,
    lists,
    problems,
    recordings,
    signals,
    signin,
    vehicle_model,
)
from sprung.service.api.description import PROBLEMS, describe
from sprung.service.api.duplicate_keys import refuse_duplicate_keys
from sprung.service.api.guard import Guard
from sprung.service.api.head import HeadAsGet
from sprung.service.api.limits import BodyLimit
from sprung.service.api.queries import only_known_parameters
from sprung.service.api.scopes import FORM, NEEDS
from sprung.service.core import Core
from sprung.service.pages import routes as fleet_page
from sprung.service.pages import vehicle as vehicle_page
from sprung.service.pages import work as work_pages
from sprung.service.pages.static import assets

DESCRIPTION = (
    "Springs and dampers of rail vehicles, identified from running recordings. "
    "Times are RFC 3339 in UTC, values SI; every error is `application/problem+json` (RFC 9457)."
)

VALUE_BYTES = 40  # of one value of a window as JSON, generously: a minute of a vehicle without inputs is 1.5 MB
WITH_SAMPLES = ("/identify", "/ingest/estimates")
OTHER_BYTES = 1 << 17  # of bodies that hold no samples: their errors are found in milliseconds


_PARTS = (
    identify,
    ingest,
    admin,
    fleet,
    fleet_knowledge,
    history,
    circumstances,
    signals,
    actions,
    vehicle_model,
    lists,
    events,
    recordings,
    diagnose,
    health,
    docs,
)


def create_app(
    core: Core, on_start: Callable[[], None] = lambda: None, on_stop: Callable[[], None] | None = None
) -> FastAPI:
    """The application around a core.

    on_start: called once the core runs; on_stop: called when the last request was answered, closes the core.
    """

    @asynccontextmanager
    async def lifespan(_app: FastAPI) -> AsyncIterator[None]:
        core.start()
        on_start()
        yield
        await run_in_threadpool(on_stop or core.close)

    app = FastAPI(
        title="Sprung",
        version=__version__,
        description=DESCRIPTION,
        lifespan=lifespan,
        openapi_url=None,  # `docs` answers it, with the checks of every other route
        docs_url=None,  # both load scripts from other hosts; `docs` draws a page of its own
        redoc_url=None,
        redirect_slashes=False,  # to an address made of the Host header, whatever that says
    )
    app.state.core = core
    app.state.keys_at_work = idempotency.KeysAtWork()
    problems.install(app)
    describe(app)
    _route(app)
    _guard(app, core)
    return app


def _route(app: FastAPI) -> None:
    """Give the application its API, pages and static files."""
    checks = [Depends(only_known_parameters), Depends(refuse_duplicate_keys)]
    for router in (
        *(part.router for part in (*_PARTS, fleet_page, vehicle_page, work_pages)),
        admin.pages,
        signin.pages,
    ):
        app.include_router(router, responses=PROBLEMS, dependencies=checks)
    app.include_router(signin.returns)
    app.mount("/static", assets(), name="static")


def _guard(app: FastAPI, core: Core) -> None:
    """Put what every request passes first before the routes: access, HEAD, the size of bodies."""
    uploads = core.settings.max_upload_bytes
    system = core.engine.system
    windows = max(core.settings.max_body_bytes, VALUE_BYTES * system.window * len(system.channels))
    app.add_middleware(
        BodyLimit,
        limit=min(windows, OTHER_BYTES),
        paths={(path, FORM): uploads for path in ("/recordings", "/diagnose")}
        | {(path, kind): windows for path in WITH_SAMPLES for kind in NEEDS["POST", path].body},
    )
    app.add_middleware(HeadAsGet)
    app.add_middleware(
        Guard,
        settings=core.settings,
        tokens=core.tokens,
        requests=core.requests,
        oidc=core.oidc,
        on_wait=core.waits.of("threads"),
    )

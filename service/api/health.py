"""`/health/live`, `/health/ready` and `/metrics`: for machines that watch the service."""

from __future__ import annotations

from fastapi import APIRouter
from fastapi.concurrency import run_in_threadpool
from fastapi.responses import Response
from prometheus_client import CONTENT_TYPE_LATEST
from sqlalchemy import text
from sqlalchemy.exc import SQLAlchemyError

from sprung.service.api.access import CoreOf, json_response, read
from sprung.service.api.problems import Problem

router = APIRouter(tags=["health"])


@router.get("/health/live", summary="The process runs")
async def live() -> Response:
    """Answers as long as the event loop turns."""
    return json_response({"status": "ok"})


@router.get("/health/ready", summary="The service can work")
async def ready(core: CoreOf) -> Response:
    """503 while the store does not answer or the service is stopping."""
    if core.stopping.is_set():
        raise Problem(503, "the service is stopping", headers={"Retry-After": "5"})
    try:
        await read(core, lambda connection: connection.execute(text("SELECT 1")).scalar_one())
    except SQLAlchemyError as error:
        raise Problem(503, "the store does not answer", headers={"Retry-After": "5"}) from error
    return json_response({"status": "ok", "model": core.engine.digest, "waiting": core.compute.waiting})


@router.get("/metrics", summary="Prometheus metrics")
async def metrics(core: CoreOf) -> Response:
    """The text exposition format."""
    return Response(await run_in_threadpool(core.metrics.render), media_type=CONTENT_TYPE_LATEST)

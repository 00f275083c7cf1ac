"""`/health/live`, `/health/ready` and `/metrics`: for machines that watch the service."""

from __future__ import annotations

from dataclasses import asdict

from fastapi import APIRouter
from fastapi.concurrency import run_in_threadpool
from fastapi.responses import Response
from prometheus_client import CONTENT_TYPE_LATEST

from sprung.service.api import models
from sprung.service.api.access import CoreOf
from sprung.service.api.answers import json_response
from sprung.service.api.problems import ApiProblem

router = APIRouter(tags=["health"])


@router.get("/health/live", summary="The process runs", response_model=models.Live)
async def live() -> Response:
    """Answers as long as the event loop turns."""
    return json_response({"status": "ok"})


@router.get("/health/ready", summary="The service can work", response_model=models.Ready)
async def ready(core: CoreOf) -> Response:
    """503 with the reason while the store cannot be written, a live feed does not work, or the service is stopping."""
    if core.stopping.is_set():
        raise ApiProblem(503, "the service is stopping", headers={"Retry-After": "5"})
    feeds = [feed.status() for feed in core.feeds]
    troubles = await run_in_threadpool(core.condition.troubles)
    troubles += [f"feed {feed.name} is {feed.state}: {feed.detail}" for feed in feeds if not feed.works]
    if troubles:
        raise ApiProblem(503, "; ".join(troubles)[:1000], headers={"Retry-After": "5"})
    return json_response(
        {
            "status": "ok",
            "model": core.engine.digest,
            "waiting": core.compute.waiting,
            "feeds": [asdict(feed) for feed in feeds],
            "processes": [asdict(process.status) for process in core.processes],
        }
    )


@router.get(
    "/metrics",
    summary="Prometheus metrics",
    response_class=Response,
    responses={200: {"content": {"text/plain": {"schema": {"type": "string"}}}}},
)
async def metrics(core: CoreOf) -> Response:
    """The text exposition format."""
    return Response(await run_in_threadpool(core.metrics.render), media_type=CONTENT_TYPE_LATEST)

"""`GET /fleet/knowledge`: usual values in the fleet, outliers, trends, and predicted crossings of limits."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Query
from fastapi.concurrency import run_in_threadpool
from fastapi.responses import Response

from sprung.service.api import models
from sprung.service.api.access import CoreOf
from sprung.service.api.actors import ActorOf
from sprung.service.api.answers import json_response
from sprung.service.fleet.statistics import DAYS, knowledge_dict

router = APIRouter(tags=["vehicles"])


@router.get("/fleet/knowledge", summary="Statistics of the fleet", response_model=models.KnowledgeAnswer)
async def fleet_knowledge(
    core: CoreOf,
    actor: ActorOf,
    days: Annotated[int, Query(ge=3, le=730, description="how far back")] = DAYS,
    limit: Annotated[int, Query(ge=1, le=200, description="of the worst and of the fastest")] = 20,
) -> Response:
    """From the roll-ups of the last days, as of the last ten minutes: the usual level of every type of element in every
    class of vehicles, the vehicles that depart most from it, those that get worse fastest, what all vehicles of a class
    did together, and how many will be an alarm's change off their own first level."""
    found = await run_in_threadpool(core.statistics.known, actor.fleet, days)
    return json_response(knowledge_dict(found, limit))

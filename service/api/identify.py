"""`POST /identify`: one window in, its parameters out."""

from __future__ import annotations

from typing import Any

import numpy as np
from fastapi import APIRouter, Request
from fastapi.responses import Response

from sprung.model.identifier import UnusableWindow
from sprung.model.signals import Estimate, FloatArray
from sprung.service.access.tokens import Actor
from sprung.service.api import models
from sprung.service.api.access import CoreOf
from sprung.service.api.actors import ActorOf, own_vehicle
from sprung.service.api.answers import json_response
from sprung.service.api.bodies import WindowBody, read_window, start_of
from sprung.service.api.problems import ApiProblem
from sprung.service.core import Core
from sprung.service.monitoring.batching import AskedWindow
from sprung.service.monitoring.engine import Engine
from sprung.service.monitoring.views import fit_dict, physical, sensor_dict
from sprung.service.store.windows import StoredEstimate
from sprung.service.times import NANOSECONDS, now_ns

router = APIRouter(tags=["identify"])

# the body is parsed by hand, strictly and once; this is how clients see it
BODY = {
    "requestBody": {
        "required": True,
        "content": {"application/json": {"schema": WindowBody.model_json_schema()}},
    }
}


@router.post("/identify", openapi_extra=BODY, summary="Identify one window", response_model=models.IdentifyAnswer)
async def identify(
    request: Request, core: CoreOf, actor: ActorOf, states: bool = False, track: bool = False
) -> Response:
    """Parameters of one window, with standard deviations and how well the model fits.

    `states=true` adds the simulated states.  `track=true` stores the window and feeds the vehicle's tracker; the
    answer then also has the tracked `posterior`, and `start` in the body says when the window began (the window
    is taken to end now where it does not).
    """
    content = await request.body()
    try:
        answered = await core.batcher.ask(lambda: _read(core, content, actor, states, track))
    except UnusableWindow as error:
        raise ApiProblem(422, str(error)) from error
    engine = answered.asked.served.engine
    answer = _answer(engine, answered.asked.vehicle, answered.estimate)
    if answered.record is not None:
        posterior = answered.record.posterior
        answer["tracked"] = answered.record.tracked
        if posterior is not None:
            answer["posterior"] = _parameters(engine, posterior.log_ratio, posterior.std, None)
    return json_response(answer)


def _read(core: Core, content: bytes, actor: Actor, states: bool, track: bool) -> AskedWindow:
    """What was sent, and what the vehicle's windows are identified with; runs in a thread."""
    head, values = read_window(content, core.engine.form)
    if track:
        _needed(head.vehicle)
    if head.vehicle is not None:  # named without being tracked, it is identified with its own model all the same
        own_vehicle(actor, head.vehicle)
    engines, now = core.pipeline.engines, now_ns()
    served = engines.shared if head.vehicle is None else engines.lately(core.store, head.vehicle)
    start = start_of(head, now)  # wrong ones are refused also where nobody needs them
    if track and start is None:
        system = served.engine.system
        start = now - round(system.window / system.sample_rate * NANOSECONDS)
    return AskedWindow(values, served, head.vehicle, states, start if track else None)


def _needed(vehicle: str | None) -> None:
    if vehicle is None:
        detail = "is needed to track"
        raise ApiProblem(422, f"vehicle {detail}", [{"field": "vehicle", "detail": detail}])


def _answer(engine: Engine, vehicle: str | None, estimate: Estimate) -> dict[str, Any]:
    solved = StoredEstimate.of(estimate)
    answer: dict[str, Any] = {
        "vehicle": vehicle,
        "model": engine.digest,
        "parameters": _parameters(engine, solved.log_ratio, solved.std, estimate.identifiable.tolist()),
        "fit": fit_dict(solved.nrmse, sensor_dict(engine, solved.per_sensor))
        | {"adequate": solved.adequate, "converged": solved.converged, "reason": estimate.reason},
    }
    if estimate.states is not None:
        answer["states"] = dict(zip(state_names(engine), estimate.states.T.tolist(), strict=True))
    return answer


def _parameters(
    engine: Engine, log_ratio: FloatArray, std: FloatArray, identifiable: list[bool] | None
) -> list[dict[str, Any]]:
    reported = identifiable or [True] * len(log_ratio)
    pairs = physical(engine, log_ratio, std)
    ratios = np.exp(log_ratio).tolist()
    return [
        {
            "name": p.name,
            "value": value,
            "std": spread,
            "unit": p.unit,
            "nominal": p.nominal,
            "ratio": ratio,
        }
        | ({} if identifiable is None else {"identifiable": ok})
        for p, (value, spread), ratio, ok in zip(engine.system.tracked, pairs, ratios, reported, strict=True)
    ]


def state_names(engine: Engine) -> list[str]:
    """`car.z`, `car.roll`, ... then their rates `car.z_rate`, ..."""
    dofs = engine.system.whole_system.mechanics.dofs
    return [*dofs, *(f"{dof}_rate" for dof in dofs)]

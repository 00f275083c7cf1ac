"""`estimator`: what the trained start is worth, and what the estimator's design is worth.

Iterations to converge from the estimator, from nominal values and from the tracker's last state, on windows whose
parameters are drawn within +-50 %.  Designs: the force balance with equal weights, with the weights that the noise
of the rows suggests, and as trained (the network whose weights are learned, that removes noise power and corrects).
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import torch

from sprung.model.identification.amortised.estimator import EstimatorNet, bundled_estimator
from sprung.model.identification.amortised.features import ForceBalance
from sprung.model.identification.excitation import draw_log_ratios, simulate_runs
from sprung.model.identification.refinement.refine import Refiner
from sprung.model.signals import FloatArray
from sprung.model.system import System, load_system


def run(windows: int = 500, seed: int = 201) -> Iterator[dict[str, Any]]:
    """One dict per figure."""
    system = load_system()
    rng = np.random.default_rng(seed)
    truth = draw_log_ratios(system, windows, 0.5, rng)
    values = simulate_runs(system, truth, system.window, rng).values
    estimator = bundled_estimator(system)
    assert estimator is not None
    starts = {
        "nominal": np.zeros_like(truth),
        "estimator": estimator.estimate(values).log_ratio,
        "tracker": _tracked(system, truth, rng),
    }
    refiner = Refiner(system)
    mean = {}
    for name, start in starts.items():
        refined = refiner.refine(values, start)
        mean[name] = float(refined.iterations.mean())
        yield {
            "name": f"iterations from {name}",
            "value": round(mean[name], 3),
            "largest": int(refined.iterations.max()),
            "converged": round(float(refined.converged.mean()), 4),
            "start_error_percent": round(100 * float(np.abs(np.expm1(start - truth)).mean()), 3),
            "end_error_percent": round(100 * float(np.abs(np.expm1(refined.log_ratio - truth)).mean()), 3),
        }
    yield {
        "name": "share of iterations saved by the estimator",
        "value": round(1 - mean["estimator"] / mean["nominal"], 3),
        "target": ">= 0.5",
    }
    yield from _designs(system, estimator.net, values, truth)


def _tracked(system: System, truth: FloatArray, rng: np.random.Generator) -> FloatArray:
    """The posterior of a tracker that has seen many windows of the vehicle: errors of a fifth of one window's."""
    earlier = simulate_runs(system, truth, system.window, rng).values
    one = Refiner(system).refine(earlier, truth)
    return truth + 0.2 * (one.log_ratio - truth)


def _designs(system: System, trained: EstimatorNet, values: FloatArray, truth: FloatArray) -> Iterator[dict[str, Any]]:
    features = ForceBalance(system, system.window)
    target, regressors = features(values)
    plain = EstimatorNet(trained.architecture).double()
    plain.compensation.data = torch.tensor(-30.0, dtype=torch.float64)
    plain.log_weight.data = -torch.log(target.square().mean(dim=0).sqrt())
    by_noise = EstimatorNet(trained.architecture).double()
    by_noise.noise.copy_(trained.noise)
    by_noise.compensation.data = torch.tensor(-30.0, dtype=torch.float64)
    direction = torch.cat([torch.ones(len(system.parameters)), -torch.ones(1)]).double()
    power = torch.einsum("rij,i,j->r", trained.noise, direction, direction)
    by_noise.log_weight.data = -0.5 * torch.log(power.clamp_min(power.max() * 1e-12))
    groups = {"primary": [], "secondary": []}  # type: dict[str, list[int]]
    for i, parameter in enumerate(system.parameters):
        groups["primary" if parameter.element.startswith("primary") else "secondary"].append(i)
    for name, net in (("rows weighed equally", plain), ("rows weighed by their noise", by_noise), ("trained", trained)):
        with torch.no_grad():
            error = np.abs(np.expm1(net(target, regressors)[0].numpy() - truth))
        yield {
            "name": f"median error, force balance, {name}",
            "unit": "%",
            **{
                f"{group} {quantity}": round(
                    100 * float(np.median(error[:, [i for i in at if system.parameters[i].quantity == quantity]])), 2
                )
                for group, at in groups.items()
                for quantity in ("stiffness", "damping")
            },
        }

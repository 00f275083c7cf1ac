"""`sprung bench paper train_drifting`: the train's parameters drift while it runs, each along a line in its logarithm.

An estimator that takes a window's parameters for constant is off by what they do within the window, or within the
trajectory: how much, for windows of 1 s and for whole trajectories of 5 s, over the size of the drift.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from sprung.benchmarks.paper_settings import PaperSettings
from sprung.model.alps import train_fit
from sprung.model.alps.task import WINDOW, windows
from sprung.model.alps.train_fit import StateEstimator, TrainConfig
from sprung.model.alps.train_system import STATE_NOISE, STEPS, TrainData, full_state_system, generate, to_points
from sprung.model.identification.refinement.refine import Refiner
from sprung.model.simulate.linear import LinearSimulator
from sprung.model.system import load_system

METHODS = ("guess", "alps", "refined", "refined_trajectory")
DRIFTS = (0.0, 0.05, 0.2, 0.5)  # log-ratio over the 5 s of a trajectory, at most, either way
HOLD = 5  # samples over which parameters are held in the simulation
HOP = 50  # samples between windows that are judged
UPDATES = {"quick": 400, "full": 5000}


def rows(settings: PaperSettings) -> Iterator[dict[str, Any]]:
    """One row per drift and method: PE_relative against the parameters in the middle of the window."""
    for drift in DRIFTS:
        data, slope = drifting_data(settings.seed, drift)
        _, test = train_fit.halves(data)
        starts = torch.arange(0, STEPS - WINDOW + 1, HOP)
        many, at = test.repeat_interleave(len(starts)), starts.repeat(len(test))
        truth = at_sample(data.log_ratio[many], slope[many], at + (WINDOW - 1) / 2)
        for method in METHODS:
            if not settings.wants(method):
                continue
            if method == "refined_trajectory":
                found = _refined(data, test, torch.zeros_like(test), STEPS)
                figures = train_fit.parameter_figures(found, data.log_ratio[test])
            else:
                found = torch.zeros_like(truth)
                if method == "alps":
                    found = _alps(settings, data, drift, many, at)
                elif method == "refined":
                    found = _refined(data, many, at, WINDOW)
                figures = train_fit.parameter_figures(found, truth)
            yield {
                "task": settings.task, "method": f"{method} drift {drift:g}", "drift": drift, "windows": len(found),
                **{key: None if value is None else float(f"{value:.4g}") for key, value in figures.items()},
                "seed": settings.seed, "budget": settings.budget,
            }  # fmt: skip


def drifting_data(seed: int, drift: float, trajectories: int = 20) -> tuple[TrainData, Tensor]:
    """Trajectories whose parameters drift, and by how much each does over a whole one (R, 24).

    `log_ratio` holds the parameters in the middle.  Accelerometers (`observations`) are those without drift: not used.
    """
    rng = np.random.default_rng([9, seed])
    data = generate(True, rng, trajectories)
    slope = torch.from_numpy(drift * rng.uniform(-1, 1, tuple(data.log_ratio.shape)))
    states = follow(LinearSimulator(load_system()), data.log_ratio, slope, data.known, data.states[:, 0])
    size = states.square().mean((0, 1)).sqrt()
    noise = STATE_NOISE * size
    measured = states + noise * torch.from_numpy(rng.standard_normal(tuple(states.shape)))
    return replace(data, measured=measured, states=states, noise=noise, size=size), slope


def at_sample(middle: Tensor, slope: Tensor, sample: Tensor | float) -> Tensor:
    """Log-ratios (R, 24) at a sample of the trajectory, for each row its own."""
    share = torch.as_tensor(sample, dtype=middle.dtype) / (STEPS - 1) - 0.5
    return middle + slope * share.reshape(-1, 1)


def follow(
    simulator: LinearSimulator, middle: Tensor, slope: Tensor, known: Tensor, start: Tensor, hold: int = HOLD
) -> Tensor:
    """States (R, T, 18) of parameters that go along a line, held over `hold` samples each, exact within these."""
    parts, state = [start[:, None]], start
    for first in range(0, known.shape[1] - 1, hold):
        last = min(first + hold, known.shape[1] - 1)
        values = simulator.element_values(at_sample(middle, slope, 0.5 * (first + last)))
        part = simulator.states(simulator.discretise(values), known[:, first : last + 1], state)
        parts.append(part[:, 1:])
        state = part[:, -1]
    return torch.cat(parts, dim=1)


def _alps(settings: PaperSettings, data: TrainData, drift: float, many: Tensor, at: Tensor) -> Tensor:
    """The paper's estimator, without the decay that suits constants, trained on trajectories that drift alike."""
    config = TrainConfig(seed=settings.seed, updates=UPDATES[settings.budget], decay=0.0)
    folder = settings.folder / f"drift-{drift:g}"
    folder.mkdir(parents=True, exist_ok=True)
    model = train_fit.fit("alps", data, config, folder, settings.clock, f"train drifting by {drift:g}")
    assert isinstance(model, StateEstimator)
    with torch.no_grad():
        log_ratio, _ = model(windows(data.measured, at, many), windows(data.known, at, many))
    found: Tensor = log_ratio
    return found


def _refined(data: TrainData, many: Tensor, at: Tensor, length: int) -> Tensor:
    """Output error from the nominal values, the parameters of a stretch taken for constant."""
    points = to_points(windows(data.measured, at, many, length).numpy())
    measured = np.concatenate([windows(data.known, at, many, length).numpy(), points], axis=2)
    system = full_state_system(load_system(), data.noise.numpy())
    return torch.from_numpy(Refiner(system, length).refine(measured, None).log_ratio)

"""`sprung bench paper window_information`: what the states of a window, and their magnitudes, tell of the parameter.

No network, no training: what the best estimator could do.  States are true ones with white noise of a given deviation,
in units of their size (`Task.to_chart`); the start of the window is unknown.

Where the motion follows from start and parameter alone, or the inputs are known, the charts c of a window have the
Fisher information J'J / s^2 about these unknowns, J the derivative of c.  Magnitudes m = |DFT c| have noise of
covariance D D' s^2, D = dm/dc, and the information J'D' (D D')^-1 D J / s^2: what of J lies in the row space of D.
The parameter's deviation at the bound includes the prior, as a Gaussian of the variance of its range; a Gaussian error
of that deviation has the mean size sqrt(2 / pi) times as large.

The estimator of the paper sees states and no inputs.  The states of the double mass-spring-damper are then a Gaussian
process, white noise through a system whose stiffness is sought, and their posterior is known: its median on a grid has
the smallest mean error that there is.  For the magnitudes there is an estimator rather than a limit: the same median
with Whittle's likelihood, in which every |DFT|^2 is exponential about its mean and all are independent (Whittle 1953).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import torch
from torch import Tensor

from sprung.benchmarks.paper_settings import PaperSettings
from sprung.model.alps import mass_spring_damper, pendulum, two_body
from sprung.model.alps.mass_spring_damper import INPUT_STD
from sprung.model.alps.task import ROLLOUT, WINDOW, Rollouts, Task, windows

NOISES = (0.01, 0.05)  # deviation of the states, in units of their size
TRAJECTORIES = 200
GRID = 160  # values of the parameter over its range
_STEP = 1e-5  # of central differences, in units of the unknowns


def rows(settings: PaperSettings) -> Iterator[dict[str, Any]]:
    """One row per system and noise: mean error of the parameter, from states and from magnitudes."""
    tasks = {module.TASK.name: module.TASK for module in (pendulum, mass_spring_damper, two_body)}
    for number, (name, task) in enumerate(tasks.items()):
        drawn = task.sample(TRAJECTORIES, np.random.default_rng([12, number, settings.seed]), task.seen)
        jacobian, at = sensitivity(task, drawn)
        spread = task.seen.high[0] - task.seen.low[0]
        for noise in NOISES:
            kept = {"states": jacobian, "magnitudes": seen_in_magnitudes(jacobian, at)}
            found = {key: bound(part, noise, spread / 12**0.5) for key, part in kept.items()}
            if task.inputs:
                found = {f"{key}_inputs_known": value for key, value in found.items()}
                found |= posterior_errors(task, drawn, noise, np.random.default_rng([13, number, settings.seed]))
            figures = {f"PE_{key}": float(f"{value:.4g}") for key, value in found.items()}
            yield {
                "task": settings.task, "method": f"{name} noise {noise:g}", **figures, "PE_guess": spread / 4,
                "windows": len(at), "seed": settings.seed, "budget": settings.budget,
            }  # fmt: skip


def _first_samples(count: int) -> Tensor:
    """Where the windows of so many trajectories begin: every place in turn."""
    return torch.arange(count) % (ROLLOUT - WINDOW + 1)


def sensitivity(task: Task, drawn: Rollouts) -> tuple[Tensor, Tensor]:
    """Derivative of every window's chart by its unknowns, the parameter last (B, T, C, K), and the charts (B, T, C).

    The unknowns are start and parameter; where a start implies the parameter (`Task.read_off`), directions of the start
    along which it rests, and the parameter.
    """
    at, every = _first_samples(len(drawn.states)), torch.arange(len(drawn.states))
    states, inputs = windows(drawn.states, at, every), windows(drawn.inputs, at, every)
    size = torch.tensor(task.state_scale, dtype=torch.float64)
    span = torch.tensor(task.seen.high, dtype=torch.float64) - torch.tensor(task.seen.low, dtype=torch.float64)

    def read_off(start: Tensor) -> Tensor:
        assert task.read_off is not None
        parameter: Tensor = task.read_off(start * size)
        return parameter

    def charts(unknown: Tensor) -> Tensor:
        start, parameter = unknown[:, : len(size)], unknown[:, len(size) :] * span
        if task.read_off is not None:
            parameter = read_off(start)
        return task.to_chart(task.simulate(start * size, parameter, inputs))

    start = states[:, 0] / size
    if task.read_off is not None:
        jacobian = _by_value(_derivative(charts, start), _derivative(read_off, start)[:, 0])
        return jacobian, charts(start)
    unknown = torch.cat([start, drawn.parameters / span], dim=1)
    jacobian = _derivative(charts, unknown)
    jacobian[..., len(size) :] /= span
    return jacobian, charts(unknown)


def _derivative(function: Callable[[Tensor], Tensor], at: Tensor) -> Tensor:
    """Central differences of function (B, K) -> (B, ...) by its K unknowns: (B, ..., K)."""
    steps = _STEP * torch.eye(at.shape[1], dtype=at.dtype)
    return torch.stack([(function(at + step) - function(at - step)) / (2 * _STEP) for step in steps], dim=-1)


def _by_value(jacobian: Tensor, slope: Tensor) -> Tensor:
    """Derivatives by K unknowns (B, T, C, K) -> by K - 1 directions along which a value rests, and by the value.

    `slope` (B, K): derivative of the value by the unknowns.
    """
    steep = slope / slope.norm(dim=1, keepdim=True)
    _, _, turned = torch.linalg.svd(steep[:, None])  # its first row is `steep`, up to sign; the others are level
    level = jacobian @ turned[:, None, 1:].mT
    along = (jacobian @ steep[:, None, :, None]) / slope.norm(dim=1)[:, None, None, None]
    return torch.cat([level, along], dim=-1)


def seen_in_magnitudes(jacobian: Tensor, charts: Tensor) -> Tensor:
    """What of a derivative (B, T, C, K) of charts (B, T, C) lies in the row space of d|DFT|/dc: its projection."""
    spectrum = torch.fft.rfft(charts, dim=1)  # (B, F, C)
    samples = charts.shape[1]
    turn = torch.arange(samples)[None] * torch.arange(spectrum.shape[1])[:, None] * (-2 * np.pi / samples)
    waves = torch.polar(torch.ones_like(turn, dtype=torch.float64), turn.double())  # (F, T)
    direction = (spectrum / spectrum.abs().clamp_min(1e-300)).conj().permute(0, 2, 1)  # (B, C, F)
    rows = (direction[..., None] * waves).real  # (B, C, F, T)
    basis, _ = torch.linalg.qr(rows.mT)  # (B, C, T, F)
    by_column = jacobian.permute(0, 2, 1, 3)  # (B, C, T, K)
    kept: Tensor = (basis @ (basis.mT @ by_column)).permute(0, 2, 1, 3)
    return kept


def bound(jacobian: Tensor, noise: float, prior: float) -> float:
    """Mean absolute error of the last unknown at the Cramer-Rao bound, over windows (B, T, C, K).

    `prior`: the deviation of that unknown before anything is seen.
    """
    flat = jacobian.flatten(1, 2) / noise
    information = flat.mT @ flat
    information[:, -1, -1] += prior**-2
    scale = information.diagonal(dim1=1, dim2=2).sqrt()
    scaled = information / (scale[:, :, None] * scale[:, None])
    deviation = torch.linalg.inv(scaled)[:, -1, -1].sqrt() / scale[:, -1]
    return float(np.sqrt(2 / np.pi) * deviation.mean())


def posterior_errors(
    task: Task, drawn: Rollouts, noise: float, rng: np.random.Generator, grid: int = GRID
) -> dict[str, float]:
    """PE of posterior medians, white inputs of known deviation not seen: from states and from magnitudes.

    `grid`: values of the parameter over its range.
    """
    values = torch.linspace(task.seen.low[0], task.seen.high[0], grid, dtype=torch.float64)
    at, every = _first_samples(len(drawn.states)), torch.arange(len(drawn.states))
    charts = task.to_chart(windows(drawn.states, at, every))
    charts = charts + noise * torch.from_numpy(rng.standard_normal(tuple(charts.shape)))
    power = torch.fft.rfft(charts, dim=1).abs().square()  # (B, F, C)
    by_states, by_magnitudes = torch.zeros(2, len(at), grid, dtype=torch.float64)
    for begin in at.unique():
        here = torch.nonzero(at == begin)[:, 0]
        for index, value in enumerate(values):
            factor = response(task, value, int(begin))  # (T, C, inputs)
            flat = factor.flatten(0, 1)
            covariance = flat @ flat.mT + noise**2 * torch.eye(len(flat), dtype=flat.dtype)
            lower = torch.linalg.cholesky(covariance)
            white = torch.linalg.solve_triangular(lower, charts[here].flatten(1).mT, upper=False)
            by_states[here, index] = -0.5 * white.square().sum(0) - lower.diagonal().log().sum()
            mean = torch.fft.rfft(factor, dim=0).abs().square().sum(-1) + noise**2 * WINDOW  # (F, C)
            by_magnitudes[here, index] = -(power[here] / mean + mean.log()).sum((1, 2))
    truth = drawn.parameters[:, 0]
    return {
        "states": float((_median(by_states, values) - truth).abs().mean()),
        "magnitudes": float((_median(by_magnitudes, values) - truth).abs().mean()),
    }


def response(task: Task, parameter: Tensor, begin: int) -> Tensor:
    """What every input sample, of one deviation, does to the chart of the window from `begin` on: (T, C, samples I).

    From rest; the sum of its squares over the last axis is the covariance of the window.
    """
    count = (begin + WINDOW - 1) * task.inputs
    pushes = INPUT_STD * torch.eye(count, dtype=torch.float64).reshape(count, -1, task.inputs)
    pushes = torch.nn.functional.pad(pushes, (0, 0, 0, 1))  # the last sample's input acts after the window
    rest = torch.zeros(count, len(task.states), dtype=torch.float64)
    path = task.simulate(rest, parameter.expand(count, 1), pushes)
    return task.to_chart(path[:, begin:]).permute(1, 2, 0)


def _median(log_likelihood: Tensor, grid: Tensor) -> Tensor:
    """Median of the posterior (B, G) under a uniform prior over the grid (G,)."""
    share = torch.softmax(log_likelihood, dim=1).cumsum(1)
    return grid[(share < 0.5).sum(1).clamp_max(len(grid) - 1)]

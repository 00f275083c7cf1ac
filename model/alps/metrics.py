"""State, observation and parameter errors as the paper defines them, and relative ones.

SE = mean over windows of sum over samples of |simulated - true|^2, angles wrapped to half a turn
OE = mean over windows of sum over samples and pixels of |decoded - observed|^2
PE = mean over windows of |estimated - true|_1

SE depends on the gauge in which a method keeps its states, which nothing observable fixes where it has no physics.
`affine_gauge` takes that freedom away, for every method alike.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from sprung.model.alps.task import Task


def state_error(task: Task, simulated: Tensor, true: Tensor) -> float:
    """SE of states (B, T, N), in the units of the states."""
    return float(state_errors(task, simulated, true).mean())


def state_errors(task: Task, simulated: Tensor, true: Tensor) -> Tensor:
    """Squared error of each window, summed over samples and states (B, T, N) -> (B,)."""
    return task.difference(simulated, true).square().sum((1, 2))


def explained(task: Task, simulated: Tensor, true: Tensor) -> list[float]:
    """R^2 of each state over all windows (B, T, N); of an angle, 1 - E(1 - cos error) / (1 - |mean direction|)."""
    found = []
    for index in range(true.shape[-1]):
        error, truth = task.difference(simulated, true)[..., index], true[..., index]
        if index in task.angles:
            spread = 1 - torch.hypot(torch.cos(truth).mean(), torch.sin(truth).mean())
            found.append(float(1 - (1 - torch.cos(error)).mean() / spread))
        else:
            found.append(float(1 - error.square().mean() / truth.var()))
    return found


def relative_state_error(task: Task, simulated: Tensor, true: Tensor) -> float:
    """rms of the error over rms of the truth's variation, states (B, T, N) each in units of its scale."""
    scale = true.new_tensor(task.state_scale)
    error = (task.difference(simulated, true) / scale).square().mean()
    spread = (task.difference(true, true.mean((0, 1), keepdim=True)) / scale).square().mean()
    return float((error / spread).sqrt())


def parameter_error(estimated: Tensor, true: Tensor) -> float:
    """PE of parameters (B, P)."""
    return float((estimated - true).abs().sum(-1).mean())


def relative_parameter_error(estimated: Tensor, true: Tensor) -> float:
    """Mean of |estimated - true| / true over windows and parameters (B, P)."""
    return float(((estimated - true).abs() / true.abs()).mean())


def aligned(task: Task, encoded: Tensor, true: Tensor) -> Callable[[Tensor], Tensor]:
    """Map from a model's states to the true ones, by the symmetries that nothing observable breaks.

    Fitted once per model on training windows (B, T, N), used for figures only, for every method alike.
    """
    return task.align(encoded.double(), true)


def affine_gauge(task: Task, seen: Tensor, true: Tensor) -> Callable[[Tensor], Tensor]:
    """The affine map of charts that brings a method's states nearest to the true ones, by least squares.

    Fitted on labelled training windows, both (B, T, N), used for figures only, for every method alike.  Angles are
    mapped as cosine and sine.  A latent that is an affine image of the state scores as the state itself.
    """
    source, aim = task.to_chart(seen.double()).flatten(0, 1), task.to_chart(true).flatten(0, 1)
    matrix = torch.linalg.lstsq(_with_one(source), aim, driver="gelsd").solution

    def move(states: Tensor) -> Tensor:
        return task.from_chart(_with_one(task.to_chart(states.double())) @ matrix)

    return move


def _with_one(chart: Tensor) -> Tensor:
    return torch.cat([chart, torch.ones_like(chart[..., :1])], dim=-1)

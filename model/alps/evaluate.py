"""Figures of a model on test windows: SE, OE, PE, relative and gauge-free ones, forecasts, picture noise."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from sprung.model.alps import metrics
from sprung.model.alps.fit import Split, VisualModel
from sprung.model.alps.frames import FrameAutoencoder
from sprung.model.alps.task import ROLLOUT, WINDOW, Task, windows

_CHUNK = 100  # windows at a time
SHOWN_WINDOWS = 50  # on which pictures are compared: pictures are the slow part
PICTURE_NOISE = 0.05  # standard deviation of the noise on pixels in [0, 1], for the figures with it
_GAUGE_WINDOWS = 400  # labelled training windows on which the affine gauge is fitted

Move = Callable[[Tensor], Tensor]


@dataclass(frozen=True)
class Predicted:
    """Means over many windows: encoded and simulated states in true coordinates, decoded embeddings."""

    true: Tensor  # (B, T, N)
    encoded: Tensor
    simulated: Tensor
    observed: Tensor | None  # (B, T, E); None without a decoder
    parameters: Tensor | None  # (B, P)
    true_parameters: Tensor


def predict(model: VisualModel, split: Split, rows: Tensor, starts: Tensor, move: Move) -> Predicted:
    """Predict windows (rows, starts); `move` brings the model's states to the true ones."""
    found = _passed(model, split, rows, starts)
    return replace(found, encoded=move(found.encoded), simulated=move(found.simulated))


@torch.no_grad()
def _passed(model: VisualModel, split: Split, rows: Tensor, starts: Tensor) -> Predicted:
    """The same in the model's own coordinates."""
    device = next(model.parameters()).device
    encoded, simulated, observed, parameters = [], [], [], []
    for row, start in zip(rows.split(_CHUNK), starts.split(_CHUNK), strict=True):
        embeddings = windows(split.embeddings, start, row).to(device)
        passed = model.network(embeddings, windows(split.rollouts.inputs, start, row).to(device))
        encoded.append(passed.encoded.mean.double().cpu())
        simulated.append(passed.simulated.double().cpu())
        if passed.observed is not None:
            observed.append(passed.observed.cpu())
        if passed.parameters is not None:
            parameters.append(passed.parameters.double().cpu())
    return Predicted(
        windows(split.rollouts.states, starts, rows),
        torch.cat(encoded),
        torch.cat(simulated),
        torch.cat(observed) if observed else None,
        torch.cat(parameters) if parameters else None,
        split.rollouts.parameters[rows],
    )


def symmetry(task: Task, model: VisualModel, like: Split) -> Move:
    """The map by the symmetries that nothing observable breaks, fitted on windows of the training split `like`."""
    found = _passed(model, like, *_few(like, 100))
    return metrics.aligned(task, found.encoded, found.true)


def gauge(task: Task, model: VisualModel, like: Split) -> Move:
    """The affine map of the scored states, fitted on labelled windows of the training split `like`."""
    found = _passed(model, like, *_few(like, _GAUGE_WINDOWS))
    return metrics.affine_gauge(task, found.simulated, found.true)


def _few(split: Split, count: int) -> tuple[Tensor, Tensor]:
    rows = torch.arange(min(count, len(split.embeddings)))
    return rows, rows % (ROLLOUT - WINDOW + 1)


def every_window(split: Split) -> tuple[Tensor, Tensor]:
    """Rows and starts of all 26 windows of every one of N trajectories, each (26 N,)."""
    each = ROLLOUT - WINDOW + 1
    count = len(split.embeddings)
    return torch.arange(count).repeat_interleave(each), torch.arange(each).repeat(count)


def state_figures(task: Task, found: Predicted) -> dict[str, float | None]:
    """SE, PE and relative ones."""
    figures: dict[str, float | None] = {
        "SE": metrics.state_error(task, found.simulated, found.true),
        "SE_relative": metrics.relative_state_error(task, found.simulated, found.true),
        "encoded_relative": metrics.relative_state_error(task, found.encoded, found.true),
        "PE": None,
        "PE_relative": None,
        "PE_of_guessing_the_middle": None,
    }
    if found.parameters is not None:
        middle = torch.tensor([(a + b) / 2 for a, b in zip(task.seen.low, task.seen.high, strict=True)])
        figures["PE"] = metrics.parameter_error(found.parameters, found.true_parameters)
        figures["PE_relative"] = metrics.relative_parameter_error(found.parameters, found.true_parameters)
        figures["PE_of_guessing_the_middle"] = metrics.parameter_error(middle, found.true_parameters)
    return figures


def by_trajectory(task: Task, found: Predicted, rows: Tensor) -> dict[str, np.ndarray]:
    """SE and PE of each trajectory, means over its windows: what tests and intervals draw from, (R,) each."""
    errors = {"SE": metrics.state_errors(task, found.simulated, found.true)}
    if found.parameters is not None:
        errors["PE"] = (found.parameters - found.true_parameters).abs().sum(-1)
    count = torch.bincount(rows)
    return {name: (torch.bincount(rows, weights=error) / count).numpy() for name, error in errors.items()}


@torch.no_grad()
def forecast_error(task: Task, model: VisualModel, split: Split, move: Move) -> float | None:
    """Relative error of the states that follow the first window of each trajectory, forecast from it alone."""
    device = next(model.parameters()).device
    found = model.network.forecast(split.embeddings[:, :WINDOW].to(device), split.rollouts.inputs.to(device))
    if found is None:
        return None
    beyond = move(found.cpu())[:, WINDOW:]
    return metrics.relative_state_error(task, beyond, split.rollouts.states[:, WINDOW:])


@torch.no_grad()
def noisy(frames: FrameAutoencoder, task: Task, split: Split, trajectories: int = 50) -> Split:
    """The first trajectories of a split as seen through pictures with noise."""
    assert task.render is not None
    few = split.rollouts.first(trajectories)
    device = next(frames.parameters()).device
    draw = torch.Generator().manual_seed(11)
    parts = []
    for states in few.states:
        pictures = task.render(states)
        pictures = (pictures + PICTURE_NOISE * torch.randn(pictures.shape, generator=draw)).clamp(0, 1)
        parts.append(frames.encode(pictures.to(device)).cpu())
    return Split(few, torch.stack(parts))


@torch.no_grad()
def observation_error(task: Task, model: VisualModel, found: Predicted) -> float | None:
    """OE on the first windows given: decoded against true pictures, in the paper's pixel scale."""
    assert task.render is not None
    if found.observed is None:
        return None
    total, count = 0.0, min(SHOWN_WINDOWS, len(found.true))
    for index in range(count):
        pictures = task.render(found.true[index])
        drawn = model.frames.decode(found.observed[index].to(next(model.parameters()).device)).cpu()
        total += float((drawn - pictures).square().sum()) * task.pixel_scale**2
    return total / count

"""Figures of a trained model on test windows: SE, OE, PE, relative ones, unseen parameters."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from sprung.model.alps import metrics
from sprung.model.alps.fit import Split, VisualModel
from sprung.model.alps.task import ROLLOUT, WINDOW, Task, windows

_CHUNK = 100  # windows at a time
SHOWN_WINDOWS = 50  # on which pictures are compared: pictures are the slow part


@dataclass(frozen=True)
class Predicted:
    """Means over many windows: encoded and simulated states in true coordinates, decoded embeddings."""

    true: Tensor  # (B, T, N)
    encoded: Tensor
    simulated: Tensor
    observed: Tensor  # (B, T, E)
    parameters: Tensor | None  # (B, P)
    true_parameters: Tensor


@torch.no_grad()
def predict(task: Task, model: VisualModel, split: Split, rows: Tensor, starts: Tensor, like: Split) -> Predicted:
    """Predict windows (rows, starts); the symmetry is fitted on windows of the training split `like`."""
    move = _alignment(task, model, like)
    device = next(model.parameters()).device
    encoded, simulated, observed, parameters = [], [], [], []
    for row, start in zip(rows.split(_CHUNK), starts.split(_CHUNK), strict=True):
        embeddings = windows(split.embeddings, start, row).to(device)
        passed = model.network(embeddings, windows(split.rollouts.inputs, start, row).to(device))
        encoded.append(move(passed.encoded.mean.double().cpu()))
        simulated.append(move(passed.simulated.double().cpu()))
        observed.append(passed.observed.cpu())
        if passed.parameters is not None:
            parameters.append(passed.parameters.double().cpu())
    return Predicted(
        windows(split.rollouts.states, starts, rows),
        torch.cat(encoded),
        torch.cat(simulated),
        torch.cat(observed),
        torch.cat(parameters) if parameters else None,
        split.rollouts.parameters[rows],
    )


def _alignment(task: Task, model: VisualModel, like: Split):  # type: ignore[no-untyped-def]
    count = min(100, len(like.embeddings))
    rows, starts = torch.arange(count), torch.arange(count) % (ROLLOUT - WINDOW + 1)
    device = next(model.parameters()).device
    seen = model.network.encoder(windows(like.embeddings, starts, rows).to(device)).mean.double().cpu()
    return metrics.aligned(task, seen, windows(like.rollouts.states, starts, rows))


def every_window(split: Split) -> tuple[Tensor, Tensor]:
    """Rows and starts of all 26 windows of every trajectory."""
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


@torch.no_grad()
def observation_error(task: Task, model: VisualModel, found: Predicted) -> float:
    """OE on the first windows given: decoded against true pictures, in the paper's pixel scale."""
    assert task.render is not None
    total, count = 0.0, min(SHOWN_WINDOWS, len(found.true))
    for index in range(count):
        pictures = task.render(found.true[index])
        drawn = model.frames.decode(found.observed[index].to(next(model.parameters()).device)).cpu()
        total += float((drawn - pictures).square().sum()) * task.pixel_scale**2
    return total / count

"""Classical identification on pictures: output error from the untrained opening, without any network trained for it.

Positions are an affine image of the embedding, opened as the networks' are (`Task.opening`; where inputs are known,
by regression on what they do to the system at mid-range).  Each window's start and parameters then follow from
non-linear least squares of the simulated on the read positions (Ljung 1999, ch. 5; Levenberg-Marquardt), over a
growing part of the window, since over the whole of it a wrong start has many minima.  Simulation of training windows
and their embeddings give a better affine image, and so on: separable least squares by turns (Golub & Pereyra 1973).
No label is used.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from sprung.model.alps.encoder import opened_positions
from sprung.model.alps.fit import Split
from sprung.model.alps.task import ROLLOUT, WINDOW, Task, windows

HORIZONS = (13, 25, 50, WINDOW)  # samples of the window that are fitted, one after the other
ITERATIONS = 12
ROUNDS = 5  # of reading and fitting by turns
CALIBRATION_WINDOWS = 200
_STEP = 1e-5  # of finite differences, in units of the unknowns
_RIDGE = 1e-6
_CONVERGED = 1e-6  # relative change of the sum of squares


@dataclass(frozen=True)
class PositionReading:
    """An affine map from embeddings to positions: angles as (sin, cos), the rest in units of their size."""

    task: Task
    matrix: Tensor  # (E, C)
    offset: Tensor  # (C,)

    def __call__(self, embeddings: Tensor) -> Tensor:
        """(..., E) -> positions (..., n) in the units of the states."""
        read = embeddings.double() @ self.matrix + self.offset
        columns, at = [], 0
        for index in self.task.placed:
            if index in self.task.angles:
                columns.append(torch.atan2(read[..., at], read[..., at + 1]))
                at += 2
            else:
                columns.append(self.task.state_scale[index] * read[..., at])
                at += 1
        return torch.stack(columns, dim=-1)


@dataclass(frozen=True)
class FittedWindows:
    """Windows explained by the simulator."""

    parameters: Tensor  # (B, P)
    simulated: Tensor  # (B, T, N)
    misfit: Tensor  # (B,): rms of the positions' error, in units of their size

    def forecast(self, task: Task, inputs: Tensor) -> Tensor:
        """States (B, T', N) from the start of each window on, as long as its inputs (B, T', I) are known."""
        return task.simulate(self.simulated[:, 0], self.parameters, inputs)


def _columns(task: Task, states: Tensor) -> Tensor:
    """Positions (..., N) as a reading gives them before it makes angles of them (..., C)."""
    columns = []
    for index in task.placed:
        place = states[..., index]
        if index in task.angles:
            columns += [torch.sin(place), torch.cos(place)]
        else:
            columns.append(place / task.state_scale[index])
    return torch.stack(columns, dim=-1)


def regressed(task: Task, embeddings: Tensor, states: Tensor) -> PositionReading:
    """The reading that brings embeddings (..., E) nearest to the positions of states (..., N)."""
    x, y = embeddings.double().flatten(0, -2), _columns(task, states).flatten(0, -2)
    mean, aim = x.mean(0), y.mean(0)
    x, y = x - mean, y - aim
    normal = x.mT @ x
    normal += _RIDGE * normal.diagonal().mean() * torch.eye(len(normal), dtype=x.dtype)
    matrix = torch.linalg.solve(normal, x.mT @ y)
    return PositionReading(task, matrix, aim - mean @ matrix)


def opened(task: Task, data: Split) -> PositionReading:
    """The untrained reading.  Errors: `ValueError` for a task with neither opening nor inputs."""
    if task.opening is not None:
        weights, offsets = opened_positions(task.opening, data.embeddings.flatten(0, 1)[::7])
        return PositionReading(task, weights.mT, offsets)
    if not task.inputs:
        raise ValueError(f"{task.name}: nothing says where positions start: no opening, no inputs")
    count = len(data.embeddings)
    rest = torch.zeros(count, len(task.states), dtype=torch.float64)
    driven = task.simulate(rest, _middle(task).expand(count, -1), data.rollouts.inputs)
    return regressed(task, data.embeddings, driven)


def differences(task: Task, read: Tensor) -> Tensor:
    """States (B, T, N) of read positions (B, T, n), rates by central differences; nothing is simulated."""
    columns = {index: read[..., at] for at, index in enumerate(task.placed)}
    for rate, place in task.velocity_of:
        step = columns[place].diff(dim=-1)
        if place in task.angles:
            step = torch.atan2(torch.sin(step), torch.cos(step))
        step = step * task.sample_rate
        middle = 0.5 * (step[..., 1:] + step[..., :-1])
        columns[rate] = torch.cat([step[..., :1], middle, step[..., -1:]], dim=-1)
    return torch.stack([columns[index] for index in range(len(task.states))], dim=-1)


def fit_windows(task: Task, read: Tensor, inputs: Tensor) -> FittedWindows:
    """Start and parameters of each window from its read positions (B, T, n) and inputs (B, T, I)."""
    best: FittedWindows | None = None
    low, high = (torch.tensor(bound, dtype=torch.float64) for bound in (task.seen.low, task.seen.high))
    for share in (0.2, 0.5, 0.8):
        found = _from(task, read, inputs, low + share * (high - low))
        if best is None:
            best = found
            continue
        better = found.misfit < best.misfit
        best = FittedWindows(
            torch.where(better[:, None], found.parameters, best.parameters),
            torch.where(better[:, None, None], found.simulated, best.simulated),
            torch.where(better, found.misfit, best.misfit),
        )
    assert best is not None
    return best


def _from(task: Task, read: Tensor, inputs: Tensor, parameters: Tensor) -> FittedWindows:
    """Levenberg-Marquardt from one start of the parameters, all windows at once, finite differences."""
    scale = torch.tensor(task.state_scale, dtype=torch.float64)
    size = len(scale)
    low, high = (torch.tensor(bound, dtype=torch.float64) for bound in (task.seen.low, task.seen.high))
    span = high - low
    start = differences(task, read[:, :5])[:, 0] / scale
    unknown = torch.cat([start, ((parameters - low) / span).expand(len(read), -1)], dim=1)  # (B, K)
    floor, ceiling = (0.5 * low - low) / span, (1.5 * high - low) / span

    def states(x: Tensor, samples: int) -> Tensor:
        each = inputs if len(x) == len(inputs) else inputs.repeat(len(x) // len(inputs), 1, 1)
        return task.simulate(x[:, :size] * scale, low + span * x[:, size:], each[:, :samples])

    def error(x: Tensor, samples: int) -> Tensor:
        aim = read[:, :samples].repeat(len(x) // len(read), 1, 1)
        return _position_error(task, states(x, samples), aim).flatten(1)

    for samples in HORIZONS:
        damping = torch.full((len(read),), 1e-2, dtype=torch.float64)
        now = error(unknown, samples)
        for _ in range(ITERATIONS):
            jacobian = _jacobian(lambda x, n=samples: error(x, n), unknown, now)
            normal = jacobian.mT @ jacobian
            gradient = (jacobian.mT @ now[..., None])[..., 0]
            weight = damping[:, None] * (normal.diagonal(dim1=1, dim2=2) + 1e-6)
            step = torch.linalg.solve(normal + torch.diag_embed(weight), gradient)
            tried = unknown - step
            tried[:, size:] = tried[:, size:].clamp(floor, ceiling)  # as wide as the networks' range
            after = error(tried, samples)
            gain = 1 - after.square().sum(1) / now.square().sum(1)
            better = gain > 0  # False where it is not a number
            unknown, now = torch.where(better[:, None], tried, unknown), torch.where(better[:, None], after, now)
            damping = torch.where(better, damping / 5, damping * 5).clamp(1e-8, 1e6)
            if bool((gain.abs() < _CONVERGED).all()):
                break
    path = states(unknown, read.shape[1])
    misfit = _position_error(task, path, read).square().mean((1, 2)).sqrt()
    return FittedWindows(low + span * unknown[:, size:], path, misfit)


def _position_error(task: Task, states: Tensor, read: Tensor) -> Tensor:
    """Simulated states (B, T, N) less read positions (B, T, n), in units of their size, angles wrapped."""
    columns = []
    for at, index in enumerate(task.placed):
        gap = states[..., index] - read[..., at]
        turns = index in task.angles
        columns.append(torch.atan2(torch.sin(gap), torch.cos(gap)) if turns else gap / task.state_scale[index])
    return torch.stack(columns, dim=-1)


def _jacobian(function, at: Tensor, value: Tensor) -> Tensor:  # type: ignore[no-untyped-def]  # any function of one tensor
    """Forward differences of function (B, K) -> (B, R), all columns in one call: (B, R, K)."""
    batch, count = at.shape
    moved = at.repeat(count, 1)
    for column in range(count):
        moved[column * batch : (column + 1) * batch, column] += _STEP
    shifted = function(moved).unflatten(0, (count, batch))
    return ((shifted - value) / _STEP).permute(1, 2, 0)


def calibrated(task: Task, data: Split) -> PositionReading:
    """A reading that agrees with the simulator: opened, then fitted windows and regression by turns."""
    reading = opened(task, data)
    count = min(CALIBRATION_WINDOWS, len(data.embeddings))
    rows = torch.arange(count)
    # inputs that start with the system at rest say most of it
    starts = torch.zeros_like(rows) if task.inputs else rows % (ROLLOUT - WINDOW + 1)
    embeddings = windows(data.embeddings, starts, rows)
    inputs = windows(data.rollouts.inputs, starts, rows)
    for _ in range(ROUNDS):
        found = fit_windows(task, reading(embeddings), inputs)
        good = found.misfit <= found.misfit.median()
        reading = regressed(task, embeddings[good], found.simulated[good])
    return reading


def _middle(task: Task) -> Tensor:
    return 0.5 * (torch.tensor(task.seen.low, dtype=torch.float64) + torch.tensor(task.seen.high, dtype=torch.float64))

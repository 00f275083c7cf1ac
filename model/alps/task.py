"""What every system of the paper is made of: states, parameters, a simulator, a way to draw rollouts and pictures.

A task is a bundle of facts and pure functions; `pendulum.py`, `mass_spring_damper.py`, `two_body.py` and
`train_system.py` each build one.  Letters: B batch, T samples, N states, P parameters, I inputs, M frames.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

WINDOW = 100  # tau of the paper
ROLLOUT = 125  # steps of one visual trajectory: 26 windows each

Simulate = Callable[[Tensor, Tensor, Tensor], Tensor]
Sample = Callable[[int, np.random.Generator, "Range"], "Rollouts"]

Opening = Callable[[Tensor], tuple[Tensor, Tensor]]  # whitened components (M, 2) -> weights (P, 2), offsets (P,)


@dataclass(frozen=True)
class Range:
    """Bounds of the parameters that are drawn uniformly, each of shape (P,)."""

    low: tuple[float, ...]
    high: tuple[float, ...]

    def draw(self, count: int, rng: np.random.Generator) -> np.ndarray:
        """Uniform draws, shape (count, P)."""
        return rng.uniform(self.low, self.high, size=(count, len(self.low)))


@dataclass(frozen=True)
class Rollouts:
    """True trajectories with what drives them."""

    states: Tensor  # (R, T, N), float64
    inputs: Tensor  # (R, T, I), float64; I may be 0
    parameters: Tensor  # (R, P), float64

    def first(self, count: int) -> Rollouts:
        """The first `count` trajectories."""
        return Rollouts(self.states[:count], self.inputs[:count], self.parameters[:count])


@dataclass(frozen=True)
class Task:
    """One system of the paper."""

    name: str
    sample_rate: float  # Hz
    states: tuple[str, ...]  # name and unit of each state
    angles: tuple[int, ...]  # which states are angles, rad
    velocity_of: tuple[tuple[int, int], ...]  # (velocity state, state it is the rate of)
    state_scale: tuple[float, ...]  # size of each state: the networks work in units of it
    parameters: tuple[str, ...]
    seen: Range
    unseen: Range  # for the generalisation figures: just above `seen`
    below: Range  # and just below
    inputs: int
    simulate: Simulate  # (x0 (B, N), parameters (B, P), inputs (B, T, I)) -> (B, T, N)
    sample: Sample  # (rollouts, rng, range) -> Rollouts of ROLLOUT steps
    align: Callable[[Tensor, Tensor], Callable[[Tensor], Tensor]]  # see `metrics.py`
    render: Callable[[Tensor], Tensor] | None = None  # (M, N) -> (M, 3, 64, 64) in [0, 1]
    opening: Opening | None = None  # how a picture's two principal components start the positions
    read_off: Callable[[Tensor], Tensor] | None = None  # (B, N) -> (B, P): parameters that a state implies, if it does
    pixel_scale: float = 255.0  # of the observation error (1 or 255), as the paper's printed values imply

    @property
    def step(self) -> float:
        """Sampling interval, s."""
        return 1.0 / self.sample_rate

    @property
    def placed(self) -> tuple[int, ...]:
        """States that are positions or angles: what a picture shows."""
        rates = {rate for rate, _ in self.velocity_of}
        return tuple(index for index in range(len(self.states)) if index not in rates)

    def to_chart(self, states: Tensor, only: tuple[int, ...] | None = None) -> Tensor:
        """States as networks see them: angles as (cos, sin), the rest in units of `state_scale`.

        (..., N) -> (..., N + number of angles); `only` picks states.
        """
        columns = []
        for index, scale in enumerate(self.state_scale):
            if only is not None and index not in only:
                continue
            column = states[..., index]
            if index in self.angles:
                columns += [torch.cos(column), torch.sin(column)]
            else:
                columns.append(column / scale)
        return torch.stack(columns, dim=-1)

    def from_chart(self, chart: Tensor) -> Tensor:
        """The states of a full chart: the inverse of `to_chart`, angles from any length of (cos, sin)."""
        columns, at = [], 0
        for index, scale in enumerate(self.state_scale):
            if index in self.angles:
                columns.append(torch.atan2(chart[..., at + 1], chart[..., at]))
                at += 2
            else:
                columns.append(scale * chart[..., at])
                at += 1
        return torch.stack(columns, dim=-1)

    def chart_width(self) -> int:
        """Number of columns of `to_chart`."""
        return len(self.states) + len(self.angles)

    def difference(self, left: Tensor, right: Tensor) -> Tensor:
        """left - right with angles wrapped to (-pi, pi]: an angle is only known modulo a turn."""
        delta = left - right
        if not self.angles:
            return delta
        wrapped = delta.clone()
        for index in self.angles:
            wrapped[..., index] = torch.atan2(torch.sin(delta[..., index]), torch.cos(delta[..., index]))
        return wrapped


def windows(trajectories: Tensor, starts: Tensor, rows: Tensor, length: int = WINDOW) -> Tensor:
    """Cut windows out of trajectories (R, T, ...) at (rows, starts), both (B,) -> (B, length, ...)."""
    steps = starts[:, None] + torch.arange(length, device=starts.device)
    return trajectories[rows[:, None], steps]

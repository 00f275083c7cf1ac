"""Damped pendulum, 20 Hz: states (angle, rate), parameter friction.

    d angle / dt = rate
    d rate / dt  = -friction * rate - (G / L) sin(angle)

The paper prints the two rows swapped.  G = 10 m/s^2, L = 1 m; friction ~ U(0.1, 1) 1/s, angle ~ U(-pi, pi),
rate ~ U(0.5, 4) rad/s, as the paper says.  Sizes of the picture are ours: rod 22 px, bob radius 5 px.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from sprung.model.alps import rendering
from sprung.model.alps.rollout import runge_kutta
from sprung.model.alps.task import ROLLOUT, Range, Rollouts, Task

GRAVITY = 10.0  # m/s^2
LENGTH = 1.0  # m
SAMPLE_RATE = 20.0  # Hz
ROD = 22.0  # px


def derivative(state: Tensor, friction: Tensor) -> Tensor:
    """(B, 2), (B, 1) -> (B, 2)."""
    angle, rate = state[..., 0], state[..., 1]
    return torch.stack([rate, -friction[..., 0] * rate - GRAVITY / LENGTH * torch.sin(angle)], dim=-1)


def simulate(start: Tensor, friction: Tensor, inputs: Tensor) -> Tensor:
    """(B, 2), (B, 1), (B, T, 0) -> (B, T, 2)."""
    return runge_kutta(derivative, start, inputs.shape[1], 1 / SAMPLE_RATE, friction)


def sample(count: int, rng: np.random.Generator, bounds: Range) -> Rollouts:
    """Draw rollouts as the paper does; the truth is integrated with a quarter of the step."""
    friction = torch.from_numpy(bounds.draw(count, rng))
    start = torch.from_numpy(np.stack([rng.uniform(-math.pi, math.pi, count), rng.uniform(0.5, 4, count)], axis=1))
    fine = runge_kutta(derivative, start, 4 * ROLLOUT, 0.25 / SAMPLE_RATE, friction)
    return Rollouts(fine[:, ::4], torch.zeros(count, ROLLOUT, 0, dtype=torch.float64), friction)


def render(states: Tensor) -> Tensor:
    """(M, 2) -> (M, 3, 64, 64): a rod from the centre and its bob; angle 0 hangs down."""
    angle = states[:, 0].float()
    pivot = torch.full_like(angle, rendering.CENTRE)
    column, row = pivot + ROD * torch.sin(angle), pivot + ROD * torch.cos(angle)
    rod = rendering.bar((pivot, pivot), (column, row), 1.0)
    return rendering.compose([(rod, (0.5, 0.5, 0.5)), (rendering.disc(column, row, 5.0), (0.95, 0.35, 0.2))])


def align(encoded: Tensor, true: Tensor) -> Callable[[Tensor], Tensor]:
    """The sign that nothing in pictures and dynamics tells: (angle, rate) -> -(angle, rate) solves the same equation.

    Both (..., 2); returns the map from the model's states to the true ones.
    """
    same = torch.cos(encoded[..., 0] - true[..., 0]).mean()
    mirrored = torch.cos(-encoded[..., 0] - true[..., 0]).mean()
    sign = 1.0 if same >= mirrored else -1.0
    return lambda states: sign * states


def opening(components: Tensor) -> tuple[Tensor, Tensor]:
    """Sine and cosine: the ellipse on which components (M, 2) lie made a circle, its angle zero where most of them are.

    Conic x'Qx + l'x = 1 by least squares; the prior too puts the angle's mode at zero.
    """
    x, y = components.T
    conic = torch.linalg.lstsq(torch.stack([x * x, x * y, y * y, x, y], dim=1), torch.ones_like(x)).solution
    form = torch.stack([conic[0], conic[1] / 2, conic[1] / 2, conic[2]]).reshape(2, 2)
    centre = -torch.linalg.solve(form, conic[3:]) / 2
    size, axes = torch.linalg.eigh(form / (1 + centre @ form @ centre))
    root = axes @ torch.diag(size.clamp_min(1e-6).sqrt()) @ axes.T
    most = root @ (components.mean(0) - centre)
    across, along = most / most.norm()
    weights = torch.stack([along, -across, across, along]).reshape(2, 2) @ root
    return weights, -weights @ centre


TASK = Task(
    name="pendulum",
    sample_rate=SAMPLE_RATE,
    states=("angle [rad]", "rate [rad/s]"),
    angles=(0,),
    velocity_of=((1, 0),),
    state_scale=(1.0, 3.0),
    parameters=("friction [1/s]",),
    seen=Range((0.1,), (1.0,)),
    unseen=Range((1.0,), (1.3,)),
    below=Range((0.02,), (0.1,)),
    inputs=0,
    simulate=simulate,
    sample=sample,
    align=align,
    render=render,
    opening=opening,
    pixel_scale=1.0,
)

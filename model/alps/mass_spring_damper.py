"""Double mass-spring-damper, 100 Hz: quarter of a rail vehicle on a shaken base; parameter: primary stiffness a2.

    m1 x2' = -(a1 + a2) x1 - (a3 + a4) x2 + a1 x3 + a3 x4 + a2 u1 + a4 u2
    m2 x4' =   a1 (x1 - x3) + a3 (x2 - x4)

x1, x2 displacement and velocity of mass 1; x3, x4 of mass 2; u1, u2 displacement and velocity of the base.  Two slips
of the paper are corrected: its entry A[4, 4] has the wrong sign (mass 2 would be driven by its own damper), and its
text pairs the states (1, 3) and (2, 4).  a2 ~ U(4e3, 4e6) N/m and u ~ N(0, 0.05) per sample, white and held between
samples, as the paper says.  It gives no masses, no other coefficients and no start; ours are a quarter of the
Manchester vehicle (car 32 t / 4; half a bogie; one secondary element; two primary dampers), starting at rest.  From
rest the known inputs explain everything that moves, so that origin, sign and size of the states are identifiable; a
large free oscillation would hide them, for it looks the same with any sign and size.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from sprung.model.alps import rendering
from sprung.model.alps.rollout import held
from sprung.model.alps.task import ROLLOUT, Range, Rollouts, Task

SAMPLE_RATE = 100.0  # Hz
MASS = (1307.5, 8000.0)  # kg
SECONDARY_STIFFNESS = 4.3e5  # N/m, a1
SECONDARY_DAMPING = 2.0e4  # N s/m, a3
PRIMARY_DAMPING = 8.0e3  # N s/m, a4
INPUT_STD = 0.05  # m, m/s
PIXELS_PER_METRE = 100.0
REST = (20.0, 48.0)  # px, rest columns of the two masses


def matrices(stiffness: Tensor) -> tuple[Tensor, Tensor]:
    """A (B, 4, 4) and B (B, 4, 2) for the primary stiffness (B, 1), N/m."""
    a2 = stiffness[:, 0]
    m1, m2 = MASS
    a1, a3, a4 = SECONDARY_STIFFNESS, SECONDARY_DAMPING, PRIMARY_DAMPING
    zero, one = torch.zeros_like(a2), torch.ones_like(a2)
    rows = [
        [zero, one, zero, zero],
        [-(a1 + a2) / m1, -(a3 + a4) / m1 * one, a1 / m1 * one, a3 / m1 * one],
        [zero, zero, zero, one],
        [a1 / m2 * one, a3 / m2 * one, -a1 / m2 * one, -a3 / m2 * one],
    ]
    inputs = [[zero, zero], [a2 / m1, a4 / m1 * one], [zero, zero], [zero, zero]]
    return (
        torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2),
        torch.stack([torch.stack(row, dim=-1) for row in inputs], dim=-2),
    )


def sample(count: int, rng: np.random.Generator, bounds: Range) -> Rollouts:
    """Draw rollouts as the paper does."""
    stiffness = torch.from_numpy(bounds.draw(count, rng))
    inputs = torch.from_numpy(rng.normal(0, INPUT_STD, (count, ROLLOUT, 2)))
    start = torch.zeros(count, 4, dtype=torch.float64)
    return Rollouts(simulate(start, stiffness, inputs), inputs, stiffness)


def simulate(start: Tensor, stiffness: Tensor, inputs: Tensor) -> Tensor:
    """(B, 4), (B, 1), (B, T, 2) -> (B, T, 4), exact for inputs held between samples."""
    a, b = matrices(stiffness)
    return held(a, b, start, inputs, 1 / SAMPLE_RATE)


def render(states: Tensor) -> Tensor:
    """(M, 4) -> (M, 3, 64, 64): a wall, two springs drawn as bars, two boxes that slide along the middle row."""
    first = REST[0] + PIXELS_PER_METRE * states[:, 0].float()
    second = REST[1] + PIXELS_PER_METRE * states[:, 2].float()
    middle = torch.full_like(first, rendering.CENTRE)
    wall = rendering.box(torch.full_like(first, 1.0), middle, 1.5, 20.0)
    springs = rendering.bar((torch.zeros_like(first), middle), (second, middle), 1.0)
    return rendering.compose(
        [
            (springs, (0.5, 0.5, 0.5)),
            (wall, (0.7, 0.7, 0.7)),
            (rendering.box(first, middle, 5.0, 8.0), (0.2, 0.6, 0.95)),
            (rendering.box(second, middle, 5.0, 11.0), (0.95, 0.6, 0.1)),
        ]
    )


def align(encoded: Tensor, true: Tensor) -> Callable[[Tensor], Tensor]:
    """Nothing to align: the known inputs fix origin, direction and scale."""
    del encoded, true
    return lambda states: states


TASK = Task(
    name="mass_spring_damper",
    sample_rate=SAMPLE_RATE,
    states=("x1 [m]", "v1 [m/s]", "x2 [m]", "v2 [m/s]"),
    angles=(),
    velocity_of=((1, 0), (3, 2)),
    state_scale=(0.03, 1.4, 0.015, 0.13),
    parameters=("primary stiffness [N/m]",),
    seen=Range((4e3,), (4e6,)),
    unseen=Range((4e6,), (5e6,)),
    below=Range((1e3,), (4e3,)),
    inputs=2,
    simulate=simulate,
    sample=sample,
    align=align,
    render=render,
)

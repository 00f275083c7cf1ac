"""Two bodies that attract each other, 6 Hz: states positions and momenta, parameter their energy.

    H = |p1|^2 / 2 m1 + |p2|^2 / 2 m2 - G m1 m2 / |q1 - q2|,   q' = p / m,   p' = -dH/dq

q positions, p momenta (the paper's text swaps the letters), and the potential with the sign of attraction (the paper
prints +, which repels).  G = 10, m1 = m2 = 1.  With attraction an orbit is bound only for H < 0, so the paper's
H ~ U(0.4, 1) is taken as the binding energy -H: periodic orbits of separation 5 to 12.5.  The paper does not say how
H enters its simulator, whose equations do not contain it; here it sets the size of the initial momenta (their ratio
and directions come from the encoder), so that the estimate shapes the whole path.  Ours: eccentricity ~ U(0, 0.3),
any orientation, any point of the orbit, counter-clockwise, centre of mass at rest in the middle.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from sprung.model.alps import rendering
from sprung.model.alps.rollout import runge_kutta
from sprung.model.alps.task import ROLLOUT, Range, Rollouts, Task

GRAVITY = 10.0
SAMPLE_RATE = 6.0  # Hz
MAX_ECCENTRICITY = 0.3
PIXELS_PER_UNIT = 3.2
CORE = 2.5  # separation below which the force grows no more: no orbit drawn here comes so close, networks do
MIN_KINETIC = 0.05  # keeps the momenta finite where a network asks for less energy than the potential has


def derivative(state: Tensor) -> Tensor:
    """(B, 8) -> (B, 8), states q1 (2), q2 (2), p1 (2), p2 (2), unit masses."""
    separation = state[..., 2:4] - state[..., 0:2]
    pull = GRAVITY * separation / separation.square().sum(-1, keepdim=True).clamp_min(CORE**2) ** 1.5
    return torch.cat([state[..., 4:8], pull, -pull], dim=-1)


def energy(state: Tensor) -> Tensor:
    """Binding energy -H of states (..., 8) -> (...)."""
    distance = (state[..., 2:4] - state[..., 0:2]).norm(dim=-1).clamp_min(CORE)
    return GRAVITY / distance - 0.5 * state[..., 4:8].square().sum(-1)


def with_energy(state: Tensor, binding: Tensor) -> Tensor:
    """Scale the momenta of states (B, 8) so that they have the binding energy (B, 1)."""
    distance = (state[..., 2:4] - state[..., 0:2]).norm(dim=-1, keepdim=True).clamp_min(CORE)
    kinetic = (GRAVITY / distance - binding).clamp_min(MIN_KINETIC)
    now = 0.5 * state[..., 4:8].square().sum(-1, keepdim=True).clamp_min(1e-4)
    return torch.cat([state[..., 0:4], state[..., 4:8] * torch.sqrt(kinetic / now)], dim=-1)


def simulate(start: Tensor, binding: Tensor, inputs: Tensor) -> Tensor:
    """(B, 8), (B, 1), (B, T, 0) -> (B, T, 8)."""
    return runge_kutta(derivative, with_energy(start, binding), inputs.shape[1], 1 / SAMPLE_RATE)


def sample(count: int, rng: np.random.Generator, bounds: Range) -> Rollouts:
    """Draw rollouts; the truth is integrated with a quarter of the step."""
    binding = bounds.draw(count, rng)
    axis = GRAVITY / (2 * binding[:, 0])  # semi-major axis of the separation
    eccentricity = rng.uniform(0, MAX_ECCENTRICITY, count)
    anomaly, tilt = rng.uniform(0, 2 * np.pi, (2, count))
    parameter = axis * (1 - eccentricity**2)
    distance = parameter / (1 + eccentricity * np.cos(anomaly))
    direction = np.stack([np.cos(anomaly + tilt), np.sin(anomaly + tilt)], axis=1)
    across = np.stack([-direction[:, 1], direction[:, 0]], axis=1)
    speed = np.sqrt(2 * GRAVITY / parameter)  # relative motion with G (m1 + m2) = 2 G
    velocity = speed[:, None] * (
        eccentricity[:, None] * np.sin(anomaly)[:, None] * direction
        + (1 + eccentricity * np.cos(anomaly))[:, None] * across
    )
    separation = distance[:, None] * direction
    start = torch.from_numpy(np.concatenate([-separation / 2, separation / 2, -velocity / 2, velocity / 2], axis=1))
    path = runge_kutta(derivative, start, 4 * ROLLOUT, 0.25 / SAMPLE_RATE)[:, ::4]
    return Rollouts(path, torch.zeros(count, ROLLOUT, 0, dtype=torch.float64), torch.from_numpy(binding))


def render(states: Tensor) -> Tensor:
    """(M, 8) -> (M, 3, 64, 64): two discs of different colours."""
    column = rendering.CENTRE + PIXELS_PER_UNIT * states[:, [0, 2]].float()
    row = rendering.CENTRE - PIXELS_PER_UNIT * states[:, [1, 3]].float()
    first = rendering.disc(column[:, 0], row[:, 0], 4.5)
    second = rendering.disc(column[:, 1], row[:, 1], 4.5)
    return rendering.compose([(first, (0.95, 0.35, 0.2)), (second, (0.2, 0.6, 0.95))])


def align(encoded: Tensor, true: Tensor) -> Callable[[Tensor], Tensor]:
    """The rotation, reflection and shift that dynamics can't tell, fitted to positions (Procrustes).

    Which body is which can't be told either: both orders are tried.  `encoded`, `true` (..., 8).
    """
    aims = true.reshape(-1, 8)[:, :4].reshape(-1, 2)
    aim = aims.mean(0)
    best: tuple[float, Callable[[Tensor], Tensor]] | None = None
    for order in ([0, 1, 2, 3, 4, 5, 6, 7], [2, 3, 0, 1, 6, 7, 4, 5]):
        source = encoded.reshape(-1, 8)[:, order]
        points = source[:, :4].reshape(-1, 2)
        shift = points.mean(0)
        u, _, vh = torch.linalg.svd((points - shift).T @ (aims - aim))
        turn = u @ vh

        def move(states: Tensor, order: list[int] = order, turn: Tensor = turn, away: Tensor = shift) -> Tensor:
            states = states[..., order]
            pairs = states.reshape(*states.shape[:-1], 4, 2)
            offset = torch.stack([away, away, torch.zeros_like(away), torch.zeros_like(away)])
            back = torch.stack([aim, aim, torch.zeros_like(aim), torch.zeros_like(aim)])
            return ((pairs - offset) @ turn + back).reshape(states.shape)

        error = float((move(encoded) - true).square().mean())
        if best is None or error < best[0]:
            best = (error, move)
    assert best is not None
    return best[1]


def opening(components: Tensor) -> tuple[Tensor, Tensor]:
    """Bodies opposite each other about the middle: a map (4, 2) and an offset (4,)."""
    eye = torch.eye(2).to(components)
    return torch.cat([eye, -eye]), components.new_zeros(4)


TASK = Task(
    name="two_body",
    sample_rate=SAMPLE_RATE,
    states=("q1x", "q1y", "q2x", "q2y", "p1x", "p1y", "p2x", "p2y"),
    angles=(),
    velocity_of=((4, 0), (5, 1), (6, 2), (7, 3)),
    state_scale=(3.0, 3.0, 3.0, 3.0, 0.7, 0.7, 0.7, 0.7),
    parameters=("binding energy",),
    seen=Range((0.4,), (1.0,)),
    unseen=Range((1.0,), (1.2,)),
    below=Range((0.38,), (0.4,)),  # larger orbits leave the picture
    inputs=0,
    simulate=simulate,
    sample=sample,
    align=align,
    render=render,
    opening=opening,
    read_off=lambda states: energy(states)[..., None],
)

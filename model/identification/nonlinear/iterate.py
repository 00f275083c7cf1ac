"""Iterates of Gauss-Newton on windows of a system with laws: unknowns, simulated motion, normal equations."""

from __future__ import annotations

from dataclasses import dataclass, fields

import torch
from torch import Tensor

from sprung.model.simulate.linear import Discrete, ElementValues


@dataclass(frozen=True, slots=True)
class Iterate:
    """Unknowns, initial states and law forces of B windows."""

    unknowns: Tensor  # log-ratios of the linear parameters and laws' values, loads, then first memories, (B, U)
    x0: Tensor  # initial states, (B, N)
    force: Tensor  # of the laws at the samples, (B, T, L)

    def take(self, at: Tensor) -> Iterate:
        """Some of the windows."""
        return Iterate(self.unknowns[at], self.x0[at], self.force[at])

    def stepped(self, step: Tensor, dx0: Tensor) -> Iterate:
        """The iterate after a step of the unknowns and of the initial state."""
        return Iterate(self.unknowns + step, self.x0 + dx0, self.force)

    def interpolated(self, other: Iterate, share: float) -> Iterate:
        """The iterate `share` of the way to another one."""
        pairs = ((self.unknowns, other.unknowns), (self.x0, other.x0), (self.force, other.force))
        return Iterate(*(a + share * (b - a) for a, b in pairs))

    def where(self, mask: Tensor, other: Iterate) -> Iterate:
        """This iterate where the mask (B,) holds, the other one elsewhere."""
        return Iterate(
            torch.where(mask[:, None], self.unknowns, other.unknowns),
            torch.where(mask[:, None], self.x0, other.x0),
            torch.where(mask[:, None, None], self.force, other.force),
        )

    def put(self, at: Tensor, some: Iterate) -> None:
        """Replace some of the windows."""
        self.unknowns[at], self.x0[at], self.force[at] = some.unknowns, some.x0, some.force


@dataclass(frozen=True, slots=True)
class LinearStep:
    """Exact discretisation of the linear part at the values of an iterate."""

    values: ElementValues
    discrete: Discrete  # outputs not compressed, absent sensors left out
    force_response: tuple[Tensor, Tensor, Tensor, Tensor]  # P0, S0, P1, S1, (B, N, n)
    compliance: Tensor  # accelerations by generalised forces, (B, n, n)
    direct: Tensor  # feedthrough of generalised forces to the sensors, (B, S', n)
    force_rows: Tensor  # of element forces to the sensors, (S', E)

    def take(self, at: Tensor) -> LinearStep:
        """Some of the windows."""
        d = self.discrete
        return LinearStep(
            self.values.take(at),
            Discrete(d.Ad[at], d.G0[at], d.G1[at], d.C[at], d.D[at]),
            (
                self.force_response[0][at],
                self.force_response[1][at],
                self.force_response[2][at],
                self.force_response[3][at],
            ),
            self.compliance[at],
            self.direct[at],
            self.force_rows,
        )


@dataclass(frozen=True, slots=True)
class SimulatedMotion:
    """Simulated response of B windows."""

    states: Tensor  # (B, T, N)
    outputs: Tensor  # (B, T, S')
    diverged: (
        Tensor  # whether Newton's iteration for the forces left all bounds; they are then not those of the laws, (B,)
    )


@dataclass(frozen=True, slots=True)
class NormalEquations:
    """Normal equations at one iterate; U unknowns: linear parameters, law parameters, loads, memories."""

    whiten: Tensor  # (B, F, R, R)
    carried: Tensor  # noise of the drives in the compressed signals, (B, F, R, W/2)
    compliance: Tensor  # (B, F, n, n)
    free: Tensor  # whitened responses to the initial state, normalised, (B, N, K)
    free_scale: Tensor  # (B, N)
    sensitivities: Tensor  # whitened, (B, U, K)
    factor: Tensor  # Cholesky factor of the free responses' products, (B, N, N)
    across: Tensor  # free responses solved for the sensitivities, (B, N, U)
    information: Tensor  # on the unknowns, (B, U, U)
    covariance: Tensor  # of the unknowns, weak prior included, (B, U, U)
    precision: Tensor  # of the prior, (B, U)

    def take(self, at: Tensor) -> NormalEquations:
        """Some of the windows."""
        return NormalEquations(**{f.name: getattr(self, f.name)[at] for f in fields(self)})

    def solve(self, residual: Tensor, unknowns: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Cost (B,) with the initial state profiled out, steps of unknowns (B, U) and of that state alone (B, N).

        residual: whitened, (B, K, 1); unknowns: current values, (B, U), with the prior around 0.  Far from a fit the
        residual counts as noise, so that the prior holds weakly determined unknowns.  A window without finite steps has
        an infinite cost and stays where it is.
        """
        along = self.free @ residual
        part = torch.cholesky_solve(along, self.factor)
        gradient = self.sensitivities @ residual - self.across.mT @ along
        cost = residual.square().sum(dim=(1, 2)) - (along * part).sum(dim=(1, 2))
        noise = (cost / residual.shape[1]).clamp_min(1.0)[:, None]
        held = torch.linalg.inv(self.information + torch.diag_embed(noise * self.precision))
        step = held @ (gradient - (noise * self.precision * unknowns).unsqueeze(2))
        step, alone = step.squeeze(2), part.squeeze(2) / self.free_scale
        sound = torch.cat([cost[:, None], step, alone], dim=1).isfinite().all(dim=1)
        here = sound[:, None]
        return cost.where(sound, torch.inf), step.where(here, 0.0), alone.where(here, 0.0)

    def state_step(self, state_alone: Tensor, step: Tensor) -> Tensor:
        """Step of the initial state (B, N) that goes with a step of the unknowns (B, U)."""
        return state_alone - (self.across @ step.unsqueeze(2)).squeeze(2) / self.free_scale

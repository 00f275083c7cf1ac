"""Where windows of a system with laws stand: their unknowns, motion, and Gauss-Newton's products there."""

from __future__ import annotations

from dataclasses import dataclass, fields

import torch
from torch import Tensor

from sprung.model.simulate.linear import Discrete, ElementValues


@dataclass(frozen=True, slots=True)
class WindowPoint:
    """Where B windows stand."""

    unknowns: Tensor  # log-ratios of the linear parameters and laws' values, loads, then first memories, (B, U)
    x0: Tensor  # states at the first sample, (B, N)
    force: Tensor  # of the laws at the samples, (B, T, L)

    def take(self, at: Tensor) -> WindowPoint:
        """Some of the windows."""
        return WindowPoint(self.unknowns[at], self.x0[at], self.force[at])

    def moved(self, step: Tensor, dx0: Tensor) -> WindowPoint:
        """After steps of the unknowns and of the first state."""
        return WindowPoint(self.unknowns + step, self.x0 + dx0, self.force)

    def towards(self, other: WindowPoint, share: float) -> WindowPoint:
        """Between this and another one."""
        pairs = ((self.unknowns, other.unknowns), (self.x0, other.x0), (self.force, other.force))
        return WindowPoint(*(a + share * (b - a) for a, b in pairs))

    def where(self, mask: Tensor, other: WindowPoint) -> WindowPoint:
        """This one for windows of the mask (B,), the other one for the rest."""
        return WindowPoint(
            torch.where(mask[:, None], self.unknowns, other.unknowns),
            torch.where(mask[:, None], self.x0, other.x0),
            torch.where(mask[:, None, None], self.force, other.force),
        )

    def put(self, at: Tensor, some: WindowPoint) -> None:
        """Replace some of the windows."""
        self.unknowns[at], self.x0[at], self.force[at] = some.unknowns, some.x0, some.force


@dataclass(frozen=True, slots=True)
class Steps:
    """The linear system over one sample at the point's values."""

    values: ElementValues
    discrete: Discrete  # outputs not compressed, absent sensors left out
    push: tuple[Tensor, Tensor, Tensor, Tensor]  # P0, S0, P1, S1, (B, N, n)
    compliance: Tensor  # accelerations by generalised forces, (B, n, n)
    direct: Tensor  # what sensors show of generalised forces at once, (B, S', n)
    shown: Tensor  # and of forces of elements, (S', E)

    def take(self, at: Tensor) -> Steps:
        """Some of the windows."""
        v, d = self.values, self.discrete
        coupling = None if v.coupling is None else v.coupling[at]
        return Steps(
            ElementValues(v.stiffness[at], v.damping[at], v.mass[at], coupling),
            Discrete(d.Ad[at], d.G0[at], d.G1[at], d.C[at], d.D[at]),
            (self.push[0][at], self.push[1][at], self.push[2][at], self.push[3][at]),
            self.compliance[at],
            self.direct[at],
            self.shown,
        )


@dataclass(frozen=True, slots=True)
class Moved:
    """What a point's window does."""

    states: Tensor  # (B, T, N)
    outputs: Tensor  # (B, T, S')
    lost: Tensor  # whether Newton's method left all bounds, so that the forces are not those of the laws, (B,)


@dataclass(frozen=True, slots=True)
class Columns:
    """Gauss-Newton's products at one point; U unknowns: linear parameters, laws' values, loads, memories."""

    whiten: Tensor  # (B, F, R, R)
    carried: Tensor  # noise of the drives in the compressed signals, (B, F, R, W/2)
    compliance: Tensor  # (B, F, n, n)
    free: Tensor  # whitened responses to the first state, normalised, (B, N, K)
    free_scale: Tensor  # (B, N)
    sensitivities: Tensor  # whitened, (B, U, K)
    factor: Tensor  # Cholesky factor of the free responses' products, (B, N, N)
    across: Tensor  # free responses solved for the sensitivities, (B, N, U)
    information: Tensor  # on the unknowns, (B, U, U)
    covariance: Tensor  # of the unknowns, weak prior included, (B, U, U)
    precision: Tensor  # of the prior, (B, U)

    def take(self, at: Tensor) -> Columns:
        """Some of the windows."""
        return Columns(**{f.name: getattr(self, f.name)[at] for f in fields(self)})

    def solve(self, residual: Tensor, unknowns: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Cost with the best first state (B,), step of the unknowns (B, U), step of the first state without it (B, N).

        residual: whitened, (B, K, 1); unknowns: where they are, (B, U), the prior being around 0.  Far from a fit the
        residual counts as so much more noise, so that the prior holds what is only weakly told.
        """
        along = self.free @ residual
        part = torch.cholesky_solve(along, self.factor)
        gradient = self.sensitivities @ residual - self.across.mT @ along
        cost = residual.square().sum(dim=(1, 2)) - (along * part).sum(dim=(1, 2))
        noise = (cost / residual.shape[1]).clamp_min(1.0)[:, None]
        held = torch.linalg.inv(self.information + torch.diag_embed(noise * self.precision))
        step = held @ (gradient - (noise * self.precision * unknowns).unsqueeze(2))
        return cost, step.squeeze(2), part.squeeze(2) / self.free_scale

    def state_step(self, alone: Tensor, step: Tensor) -> Tensor:
        """Step of the first state (B, N) beside a step of the unknowns (B, U)."""
        return alone - (self.across @ step.unsqueeze(2)).squeeze(2) / self.free_scale

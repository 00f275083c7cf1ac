"""Tangent-linear model along a motion, with the laws and their memories, and its adjoint."""

from __future__ import annotations

from copy import copy

import numpy as np
import torch
from torch import Tensor

from sprung.model.identification.nonlinear.forces import Slopes
from sprung.model.identification.nonlinear.iterate import LinearStep


class TangentModel:
    """The linear system with the laws linearised around a motion, from sample to sample.

    x, f and z are variations of the state, of the laws' forces and of their memories.  With

        f_k = K_k [x_k; z_k] + given_k,        z_{k+1} = memory_by_state_k [x_k; z_k] + memory_by_next_k x_{k+1},

    and forces interpolated linearly between samples,

        x_{k+1} = Ad x_k + g0 f_k + g1 f_{k+1} + excitation_k.
    """

    def __init__(self, slopes: list[Slopes], memories: list[int], pull: Tensor, steps: LinearStep, dt: float) -> None:
        """memories: indices of the laws with memory; pull: deflections by the coordinates, (L, n); dt: s."""

        def stacked(name: str) -> Tensor:
            return torch.as_tensor(np.stack([getattr(s, name) for s in slopes], axis=2))

        N, (L, n) = steps.discrete.Ad.shape[1], pull.shape
        self.memories, self.N = memories, N
        self._closed: Tensor | None = None  # for `closed_loop`, computed when it is first needed
        rows = torch.zeros(2, L, N, dtype=torch.float64)  # deflections and rates by the state
        rows[0, :, :n], rows[1, :, n:] = pull, pull
        self.rows = rows.flatten(0, 1).expand(len(steps.discrete.Ad), -1, -1)
        self.slopes = stacked("by_deflection"), stacked("by_rate")  # (B, T, L)
        P0, S0, P1, S1 = steps.force_response
        g0, g1 = -(P0 - (S0 + S1) / dt) @ pull.T, -(P1 + (S0 + S1) / dt) @ pull.T  # (B, N, L)
        K = self.slopes[0].unsqueeze(3) * rows[0] + self.slopes[1].unsqueeze(3) * rows[1]  # (B, T, L, N)
        self.at_first = K[:, 0]
        after = K[:, 1:]
        self.memory_size = torch.zeros(len(K), 0, dtype=torch.float64)  # (B, Z)
        if memories:
            self.memory_size = torch.as_tensor(np.stack([slopes[i].memory_size for i in memories], axis=1))
            by_memory = stacked("by_memory")[:, :, memories]  # (B, T, Z)
            d0, d1, v0, v1, keep = (
                stacked(name)[:, :, memories].unsqueeze(3) for name in ("by_d0", "by_d1", "by_v0", "by_v1", "keep")
            )
            self.memory_gains_of_motion = tuple(x.squeeze(3) for x in (d0, d1, v0, v1))  # (B, T-1, Z)
            self.memory_by_state = d0 * rows[0, memories] + v0 * rows[1, memories]  # (B, T-1, Z, N)
            self.memory_by_next = d1 * rows[0, memories] + v1 * rows[1, memories]
            self.keep = keep  # (B, T-1, Z, 1)
            self.by_first_memory, self.by_memory = by_memory[:, 0, :, None], by_memory[:, 1:].unsqueeze(3)
            after = after.clone()
            after[:, :, memories] += self.by_memory * self.memory_by_next
        inverse = torch.linalg.inv(torch.eye(L, dtype=torch.float64) - after @ g1.unsqueeze(1))  # (B, T-1, L, L)
        self.inverse, self.force_gain = inverse, inverse @ after  # (B, T-1, L, N)
        if memories:
            self.memory_gain = inverse[:, :, :, memories] * self.by_memory.mT  # (B, T-1, L, Z)
        self.step, self.g0, self.g1 = torch.cat([steps.discrete.Ad, g0], dim=2), g0, g1

    def take(self, at: Tensor) -> TangentModel:
        """Some of the windows."""
        found = copy(self)
        for name, value in vars(self).items():
            if isinstance(value, Tensor):
                setattr(found, name, value[at])
            elif isinstance(value, tuple):
                setattr(found, name, tuple(part[at] for part in value))
        return found

    def spread(self, rows: Tensor, count: int) -> TangentModel:
        """Extended to `count` windows, of which this one holds `rows`; the values of the others mean nothing."""
        if len(rows) == count:
            return self
        at = torch.zeros(count, dtype=torch.int64)
        at[rows] = torch.arange(len(rows))
        return self.take(at)

    def along(self, deflection: Tensor, rate: Tensor) -> tuple[Tensor, Tensor | None]:
        """Variations of the forces (B, T, L, X) and memories (B, T-1, Z, X) for variations of the laws'
        deflections and rates, each (B, T, L, X), that are not due to the state."""
        by_deflection, by_rate = self.slopes
        force = by_deflection.unsqueeze(3) * deflection + by_rate.unsqueeze(3) * rate
        if not self.memories:
            return force, None
        d, v = deflection[:, :, self.memories], rate[:, :, self.memories]
        ends = (d[:, :-1], d[:, 1:], v[:, :-1], v[:, 1:])
        memory_source = sum(
            gain.unsqueeze(3) * end for gain, end in zip(self.memory_gains_of_motion, ends, strict=True)
        )
        assert isinstance(memory_source, Tensor)
        return force, memory_source

    def run(
        self,
        excitation: Tensor,
        given: Tensor,
        first: Tensor,
        memory_source: Tensor | None = None,
        memory: Tensor | None = None,
    ) -> Tensor:
        """Variations of the states, then of the laws' forces, (B, T, N + L, X).

        excitation: of the last X' columns, (B, T-1, N, X'); given: forces (B, T, L, X) that do not follow from the
        motion; first: initial states (B, N, X); memory_source: variations of the memories, (B, T-1, Z, X), that do not
        follow from the motion; memory: variations of the memories at the first sample, (B, Z, X).
        """
        (B, T, L, X), N = given.shape, self.N
        excited = slice(X - excitation.shape[3], X)
        path = given.new_empty(B, T, N + L, X)
        z = given.new_zeros(B, len(self.memories), X) if memory is None else memory
        path[:, 0, :N] = first
        path[:, 0, N:] = self.at_first @ first + given[:, 0]
        if self.memories:
            path[:, 0, N:][:, self.memories] += self.by_first_memory * z
        known = self.inverse @ given[:, 1:]
        for k in range(T - 1):
            now = path[:, k]
            u = self.step @ now
            u[:, :, excited] += excitation[:, k]
            force = torch.baddbmm(known[:, k], self.force_gain[:, k], u)
            if self.memories:
                z = torch.baddbmm(self.keep[:, k] * z, self.memory_by_state[:, k], now[:, :N])
                z = z if memory_source is None else z + memory_source[:, k]
                force = torch.baddbmm(force, self.memory_gain[:, k], z)
            state = torch.baddbmm(u, self.g1, force)
            if self.memories:
                z = torch.baddbmm(z, self.memory_by_next[:, k], state)
            path[:, k + 1, :N], path[:, k + 1, N:] = state, force
        return path

    def adjoint(self, by_state: Tensor, by_force: Tensor) -> tuple[Tensor, Tensor]:
        """Adjoint of `run`: gradients by given forces (B, T, L, X) and by memory sources (B, T-1, Z, X), from gradients
        by states (B, T, N, X) and by the laws' forces (B, T, L, X)."""
        (B, T, _, X), N, Z = by_force.shape, self.N, len(self.memories)
        added, memory_source = torch.empty_like(by_force), by_force.new_zeros(B, T - 1, Z, X)
        state, force, z = by_state[:, -1], by_force[:, -1], by_force.new_zeros(B, Z, X)
        for k in reversed(range(T - 1)):
            if Z:
                state = torch.baddbmm(state, self.memory_by_next[:, k].mT, z)
            force = torch.baddbmm(force, self.g1.mT, state)
            added[:, k + 1] = self.inverse[:, k].mT @ force
            u = torch.baddbmm(state, self.force_gain[:, k].mT, force)
            before = self.step.mT @ u
            if Z:
                z = torch.baddbmm(z, self.memory_gain[:, k].mT, force)
                memory_source[:, k] = z
                before[:, :N] += self.memory_by_state[:, k].mT @ z
                z = self.keep[:, k] * z
            state, force = before[:, :N] + by_state[:, k], before[:, N:] + by_force[:, k]
        added[:, 0] = force
        return added, memory_source

    def along_adjoint(self, by_force: Tensor, memory_source: Tensor) -> tuple[Tensor, Tensor]:
        """Adjoint of `along`: gradients by the laws' deflections and rates, each (B, T, L, X)."""
        deflection, rate = (slope.unsqueeze(3) * by_force for slope in self.slopes)
        if self.memories:
            d0, d1, v0, v1 = (gain.unsqueeze(3) * memory_source for gain in self.memory_gains_of_motion)
            for of, early, late in ((deflection, d0, d1), (rate, v0, v1)):
                of[:, :-1, self.memories] += early
                of[:, 1:, self.memories] += late
        return deflection, rate

    def closed_loop(self, given: Tensor) -> Tensor:
        """Newton step of the forces (B, T, L) for their error `given`, with the response of the motion."""
        if self._closed is None:
            self._closed = self._closed_loop_matrix()
        B, T, L = given.shape
        known = given.clone()
        known[:, 1:] = (self.inverse @ given[:, 1:].unsqueeze(3)).squeeze(3)
        found: Tensor = torch.linalg.solve_triangular(
            self._closed, known.reshape(B, T * L, 1), upper=False, unitriangular=True
        )
        return found.view(B, T, L)

    def _closed_loop_matrix(self) -> Tensor:
        """Matrix of the triangular system of a whole window's forces, (B, TL, TL)."""
        B, T, L = self.slopes[0].shape
        motion = self._motion_by_force()
        d, v = motion[:, 0], motion[:, 1]  # (B, L, L, T, T)
        by_d, by_v = (slope.mT[:, :, None, :, None] for slope in self.slopes)
        force = by_d * d + by_v * v
        if self.memories:
            gains = [gain.mT[:, :, None, :, None] for gain in self.memory_gains_of_motion]  # (B, Z, 1, T-1, 1)
            d, v = d[:, self.memories], v[:, self.memories]
            ends = (d[..., :-1, :], d[..., 1:, :], v[..., :-1, :], v[..., 1:, :])
            z = gains[0] * ends[0]
            for gain, end in zip(gains[1:], ends[1:], strict=True):
                z.addcmul_(gain, end)
            for k in range(1, T - 1):
                z[..., k, :].addcmul_(self.keep[:, k, :, None], z[..., k - 1, :])
            force[:, self.memories, :, 1:] += self.by_memory.permute(0, 2, 3, 1).unsqueeze(4) * z
        whole = force.permute(0, 3, 1, 4, 2).flip(3).reshape(B, T, L, T * L)
        whole[:, 1:] = self.inverse @ whole[:, 1:]
        return -whole.flatten(1, 2)

    def _motion_by_force(self) -> Tensor:
        """Deflections and rates of the sites at one sample by forces at another one, from rest, latest force first:
        (B, 2, L, L, T, T).  A convolution, except for the first force, before which there is no interval."""
        Ad, (B, T, L) = self.step[:, :, : self.N], self.slopes[0].shape
        rows = Ad.new_empty(B, T, 2 * L, self.N)  # motions of the sites, samples after a state
        rows[:, 0], power, done = self.rows, Ad, 1
        while done < T:
            more = min(done, T - done)
            rows[:, done : done + more] = (rows[:, :more].flatten(1, 2) @ power).view(B, more, 2 * L, self.N)
            done, power = done + more, power @ power
        held = torch.cat([self.g0 + Ad @ self.g1, self.g0], dim=2)  # by forces on the way, and by the first, (B, N, 2L)
        after = (rows[:, : T - 1].flatten(1, 2) @ held).view(B, T - 1, 2, L, 2, L).permute(4, 0, 2, 3, 5, 1)
        lags = Ad.new_zeros(B, 2, L, L, 2 * T - 1)
        lags[..., T - 1] = (self.rows @ self.g1).view(B, 2, L, L)
        lags[..., T:] = after[0]
        found = lags.unfold(4, T, 1).clone()
        found[..., 0, T - 1], found[..., 1:, T - 1] = 0.0, after[1]
        return found

"""Forward sensitivities: what changes of forces and first states do along a motion, laws and memories included."""

from __future__ import annotations

from copy import copy

import numpy as np
import torch
from torch import Tensor

from sprung.model.identification.law_forces import Slopes
from sprung.model.identification.law_point import Steps


class Flow:
    """The linear system with the laws' slopes and memories around it, from sample to sample along a motion.

    With the total change of the forces f_k = K_k [x_k; z_k] + given_k and of the memories
    z_{k+1} = ahead_k [x_k; z_k] + beyond_k x_{k+1}, forces straight between samples:

        x_{k+1} = Ad x_k + g0 f_k + g1 f_{k+1} + push_k.
    """

    def __init__(self, slopes: list[Slopes], memories: list[int], pull: Tensor, steps: Steps, dt: float) -> None:
        """memories: which laws have one; pull: deflections by the coordinates, (L, n); dt: s."""

        def stacked(name: str) -> Tensor:
            return torch.as_tensor(np.stack([getattr(s, name) for s in slopes], axis=2))

        N, (L, n) = steps.discrete.Ad.shape[1], pull.shape
        self.memories, self.N = memories, N
        self._closed: Tensor | None = None  # for `answer`, which needs it at first
        rows = torch.zeros(2, L, N, dtype=torch.float64)  # deflections and rates by the state
        rows[0, :, :n], rows[1, :, n:] = pull, pull
        self.rows = rows.flatten(0, 1).expand(len(steps.discrete.Ad), -1, -1)
        self.slopes = stacked("by_deflection"), stacked("by_rate")  # (B, T, L)
        P0, S0, P1, S1 = steps.push
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
            self.carried = tuple(x.squeeze(3) for x in (d0, d1, v0, v1))  # (B, T-1, Z)
            self.ahead = d0 * rows[0, memories] + v0 * rows[1, memories]  # (B, T-1, Z, N)
            self.beyond = d1 * rows[0, memories] + v1 * rows[1, memories]
            self.keep = keep  # (B, T-1, Z, 1)
            self.by_first_memory, self.by_memory = by_memory[:, 0, :, None], by_memory[:, 1:].unsqueeze(3)
            after = after.clone()
            after[:, :, memories] += self.by_memory * self.beyond
        small = torch.linalg.inv(torch.eye(L, dtype=torch.float64) - after @ g1.unsqueeze(1))  # (B, T-1, L, L)
        self.small, self.answers = small, small @ after  # (B, T-1, L, N)
        if memories:
            self.answers_memory = small[:, :, :, memories] * self.by_memory.mT  # (B, T-1, L, Z)
        self.step, self.g0, self.g1 = torch.cat([steps.discrete.Ad, g0], dim=2), g0, g1

    def take(self, at: Tensor) -> Flow:
        """Some of the windows."""
        found = copy(self)
        for name, value in vars(self).items():
            if isinstance(value, Tensor):
                setattr(found, name, value[at])
            elif isinstance(value, tuple):
                setattr(found, name, tuple(part[at] for part in value))
        return found

    def spread(self, rows: Tensor, count: int) -> Flow:
        """The flow of `count` windows, of which those of this one are `rows`; the others, which are lost, have any."""
        if len(rows) == count:
            return self
        at = torch.zeros(count, dtype=torch.int64)
        at[rows] = torch.arange(len(rows))
        return self.take(at)

    def along(self, deflection: Tensor, rate: Tensor) -> tuple[Tensor, Tensor | None]:
        """Forces (B, T, L, X), and memories (B, T-1, Z, X), that changes of the laws' deflections and rates bring about
        which are not the bodies'; each (B, T, L, X)."""
        by_deflection, by_rate = self.slopes
        force = by_deflection.unsqueeze(3) * deflection + by_rate.unsqueeze(3) * rate
        if not self.memories:
            return force, None
        d, v = deflection[:, :, self.memories], rate[:, :, self.memories]
        ends = (d[:, :-1], d[:, 1:], v[:, :-1], v[:, 1:])
        remembered = sum(gain.unsqueeze(3) * end for gain, end in zip(self.carried, ends, strict=True))
        assert isinstance(remembered, Tensor)
        return force, remembered

    def run(
        self,
        push: Tensor,
        given: Tensor,
        first: Tensor,
        remembered: Tensor | None = None,
        memory: Tensor | None = None,
    ) -> Tensor:
        """Changes of states, then of the laws' forces, (B, T, N + L, X).

        push: of the last X' columns, (B, T-1, N, X'); given: forces (B, T, L, X) apart from what the motion changes;
        first (B, N, X); remembered: changes of the memories, (B, T-1, Z, X), apart from what the motion changes;
        memory: of the memories at the first sample, (B, Z, X).
        """
        (B, T, L, X), N = given.shape, self.N
        pushed = slice(X - push.shape[3], X)
        path = given.new_empty(B, T, N + L, X)
        z = given.new_zeros(B, len(self.memories), X) if memory is None else memory
        path[:, 0, :N] = first
        path[:, 0, N:] = self.at_first @ first + given[:, 0]
        if self.memories:
            path[:, 0, N:][:, self.memories] += self.by_first_memory * z
        known = self.small @ given[:, 1:]
        for k in range(T - 1):
            now = path[:, k]
            u = self.step @ now
            u[:, :, pushed] += push[:, k]
            force = torch.baddbmm(known[:, k], self.answers[:, k], u)
            if self.memories:
                z = torch.baddbmm(self.keep[:, k] * z, self.ahead[:, k], now[:, :N])
                z = z if remembered is None else z + remembered[:, k]
                force = torch.baddbmm(force, self.answers_memory[:, k], z)
            state = torch.baddbmm(u, self.g1, force)
            if self.memories:
                z = torch.baddbmm(z, self.beyond[:, k], state)
            path[:, k + 1, :N], path[:, k + 1, N:] = state, force
        return path

    def back(self, by_state: Tensor, by_force: Tensor) -> tuple[Tensor, Tensor]:
        """What depends on states and on the laws' forces, (B, T, N, X) and (B, T, L, X), by forces that are added to
        the laws' (B, T, L, X), and by changes of the memories on the way (B, T-1, Z, X): the adjoint of `run`."""
        (B, T, _, X), N, Z = by_force.shape, self.N, len(self.memories)
        added, remembered = torch.empty_like(by_force), by_force.new_zeros(B, T - 1, Z, X)
        state, force, z = by_state[:, -1], by_force[:, -1], by_force.new_zeros(B, Z, X)
        for k in reversed(range(T - 1)):
            if Z:
                state = torch.baddbmm(state, self.beyond[:, k].mT, z)
            force = torch.baddbmm(force, self.g1.mT, state)
            added[:, k + 1] = self.small[:, k].mT @ force
            u = torch.baddbmm(state, self.answers[:, k].mT, force)
            before = self.step.mT @ u
            if Z:
                z = torch.baddbmm(z, self.answers_memory[:, k].mT, force)
                remembered[:, k] = z
                before[:, :N] += self.ahead[:, k].mT @ z
                z = self.keep[:, k] * z
            state, force = before[:, :N] + by_state[:, k], before[:, N:] + by_force[:, k]
        added[:, 0] = force
        return added, remembered

    def along_back(self, by_force: Tensor, remembered: Tensor) -> tuple[Tensor, Tensor]:
        """The same by deflections and rates along which the laws act, each (B, T, L, X): the adjoint of `along`."""
        deflection, rate = (slope.unsqueeze(3) * by_force for slope in self.slopes)
        if self.memories:
            d0, d1, v0, v1 = (gain.unsqueeze(3) * remembered for gain in self.carried)
            for of, early, late in ((deflection, d0, d1), (rate, v0, v1)):
                of[:, :-1, self.memories] += early
                of[:, 1:, self.memories] += late
        return deflection, rate

    def answer(self, given: Tensor) -> Tensor:
        """Change of the forces (B, T, L) where they are off by `given`, the motion's answer included."""
        if self._closed is None:
            self._closed = self._answers_by_force()
        B, T, L = given.shape
        known = given.clone()
        known[:, 1:] = (self.small @ given[:, 1:].unsqueeze(3)).squeeze(3)
        found: Tensor = torch.linalg.solve_triangular(
            self._closed, known.reshape(B, T * L, 1), upper=False, unitriangular=True
        )
        return found.view(B, T, L)

    def _answers_by_force(self) -> Tensor:
        """The whole window's forces as one triangular system: what they are, off by given ones, of all, (B, TL, TL)."""
        B, T, L = self.slopes[0].shape
        moved = self._moved_by_force()
        d, v = moved[:, 0], moved[:, 1]  # (B, L, L, T, T)
        by_d, by_v = (slope.mT[:, :, None, :, None] for slope in self.slopes)
        force = by_d * d + by_v * v
        if self.memories:
            gains = [gain.mT[:, :, None, :, None] for gain in self.carried]  # (B, Z, 1, T-1, 1)
            d, v = d[:, self.memories], v[:, self.memories]
            ends = (d[..., :-1, :], d[..., 1:, :], v[..., :-1, :], v[..., 1:, :])
            z = gains[0] * ends[0]
            for gain, end in zip(gains[1:], ends[1:], strict=True):
                z.addcmul_(gain, end)
            for k in range(1, T - 1):
                z[..., k, :].addcmul_(self.keep[:, k, :, None], z[..., k - 1, :])
            force[:, self.memories, :, 1:] += self.by_memory.permute(0, 2, 3, 1).unsqueeze(4) * z
        whole = force.permute(0, 3, 1, 4, 2).flip(3).reshape(B, T, L, T * L)
        whole[:, 1:] = self.small @ whole[:, 1:]
        return -whole.flatten(1, 2)

    def _moved_by_force(self) -> Tensor:
        """Deflections and rates of the sites at a sample by forces at another one, from rest, the last one first:
        (B, 2, L, L, T, T), a convolution but for the first force, which nothing leads to."""
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

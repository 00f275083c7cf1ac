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
        rows = torch.zeros(2, L, N, dtype=torch.float64)  # deflections and rates by the state
        rows[0, :, :n], rows[1, :, n:] = pull, pull
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
        self.step, self.g1 = torch.cat([steps.discrete.Ad, g0], dim=2), g1

    def take(self, at: Tensor) -> Flow:
        """Some of the windows."""
        found = copy(self)
        for name, value in vars(self).items():
            if isinstance(value, Tensor):
                setattr(found, name, value[at])
            elif isinstance(value, tuple):
                setattr(found, name, tuple(part[at] for part in value))
        return found

    def along(self, deflection: Tensor, rate: Tensor) -> tuple[Tensor, Tensor | None]:
        """Forces (B, L, T, X), and memories (B, Z, T-1, X), that changes of the laws' deflections and rates bring about
        which are not the bodies'; each (B, T, L, X)."""
        by_deflection, by_rate = self.slopes
        force = (by_deflection.unsqueeze(3) * deflection + by_rate.unsqueeze(3) * rate).transpose(1, 2)
        if not self.memories:
            return force, None
        d, v = deflection[:, :, self.memories], rate[:, :, self.memories]
        ends = (d[:, :-1], d[:, 1:], v[:, :-1], v[:, 1:])
        remembered = sum(gain.unsqueeze(3) * end for gain, end in zip(self.carried, ends, strict=True))
        assert isinstance(remembered, Tensor)
        return force, remembered.transpose(1, 2)

    def run(
        self,
        push: Tensor | None,
        given: Tensor,
        first: Tensor,
        remembered: Tensor | None = None,
        memory: Tensor | None = None,
    ) -> Tensor:
        """Changes of states, then of the laws' forces, (B, N + L, T, X).

        push: of the last X' columns, (B, N, T-1, X'), or none; given: forces (B, L, T, X) apart from what the
        motion changes; first (B, N, X); remembered: changes of the memories, (B, Z, T-1, X), apart from what the motion
        changes; memory: of the memories at the first sample, (B, Z, X).
        """
        B, L, T, X = given.shape
        pushed = slice(X - push.shape[3], X) if push is not None else slice(0)
        path = given.new_empty(B, self.N + L, T, X)
        z = given.new_zeros(B, len(self.memories), X) if memory is None else memory
        force = self.at_first @ first + given[:, :, 0]
        if self.memories:
            force[:, self.memories] += self.by_first_memory * z
        now = torch.cat([first, force], dim=1)
        path[:, :, 0] = now
        for k in range(T - 1):
            u = self.step @ now
            if push is not None:
                u[:, :, pushed] += push[:, :, k]
            known = given[:, :, k + 1]
            if self.memories:
                z = torch.baddbmm(self.keep[:, k] * z, self.ahead[:, k], now[:, : self.N])
                z = z if remembered is None else z + remembered[:, :, k]
                known = known.clone()
                known[:, self.memories] += self.by_memory[:, k] * z
            force = torch.baddbmm(self.small[:, k] @ known, self.answers[:, k], u)
            state = torch.baddbmm(u, self.g1, force)
            if self.memories:
                z = torch.baddbmm(z, self.beyond[:, k], state)
            now = torch.cat([state, force], dim=1)
            path[:, :, k + 1] = now
        return path

    def answer(self, given: Tensor) -> Tensor:
        """Change of the forces (B, T, L) where they are off by `given`, the motion's answer included."""
        first = given.new_zeros(len(given), self.N, 1)
        return self.run(None, given.mT.unsqueeze(3), first)[:, self.N :, :, 0].mT

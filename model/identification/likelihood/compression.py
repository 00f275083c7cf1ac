"""Sensors compressed to independent signals of unit noise, and what integrated supports leave open in them.

Sensors that measure the same motion redundantly are compressed first (what is lost carries no information on the
parameters), which also takes absent sensors out.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from sprung.model.mechanics import ACCELERATION, DISPLACEMENT, VELOCITY
from sprung.model.signals import BoolArray, IntArray
from sprung.model.simulate.drives import drives_of
from sprung.model.system import System


class Compression:
    """Of the sensors of a system, over windows of a fixed length."""

    def __init__(self, system: System, samples: int) -> None:
        self.system, self.samples = system, samples
        self.integrated = max((drive.integrated for drive in drives_of(system)), default=0)
        self._matrices: dict[bytes, Tensor] = {}
        self._trends: dict[bytes, Tensor] = {}

    def matrix(self, present: BoolArray) -> Tensor:
        """Matrix (R, S') from the sensors present to independent signals of unit noise."""
        key = present.tobytes()
        if key not in self._matrices:
            mechanics = self.system.mechanics
            kind, S = mechanics.sensor_kind[present], mechanics.S[present]
            noise = self.system.sensor_noise[present]
            blocks = []
            for motion in (ACCELERATION, VELOCITY, DISPLACEMENT):
                at = np.flatnonzero(kind == motion)
                if len(at):
                    q, r = np.linalg.qr(S[at] / noise[at, None])
                    rank = int(np.linalg.matrix_rank(r))
                    basis = q[:, :rank] if rank == r.shape[1] else np.linalg.svd(S[at] / noise[at, None])[0][:, :rank]
                    block = np.zeros((rank, len(kind)))
                    block[:, at] = basis.T / noise[at]
                    blocks.append(block)
            of_elements = np.flatnonzero(kind > DISPLACEMENT)
            blocks.append(np.diag(1 / noise)[of_elements])
            self._matrices[key] = torch.as_tensor(np.concatenate(blocks))
        return self._matrices[key]

    def rows(self, present: BoolArray, kind: torch.dtype) -> Tensor:
        """The matrix over all sensors, (R, S); zero columns for absent ones."""
        select = torch.eye(len(present), dtype=kind)[present]
        return self.matrix(present).to(kind) @ select

    def open_degrees(self, kind: IntArray) -> IntArray:
        """Highest power of time that the motion of an integrated support leaves open in sensors of a kind.

        The integral of an acceleration is known up to a line, and with its offset up to a parabola, whose second
        derivative an acceleration shows as a constant: the mean, which is left out anyway.
        """
        shown = np.where(kind == ACCELERATION, 2, np.where(kind == VELOCITY, 1, 0))
        found: IntArray = np.maximum(self.integrated - shown, 0)
        return found

    def trends(self, present: BoolArray) -> Tensor:
        """Columns by which the free motion of integrated inputs enters the compressed signals, (T, R, X)."""
        key = present.tobytes()
        if key not in self._trends:
            Q = self.matrix(present).numpy()
            degrees = self.open_degrees(self.system.mechanics.sensor_kind[present])
            row_degree = np.array([degrees[np.argmax(np.abs(row))] for row in Q], dtype=np.int64)
            time = np.linspace(-1, 1, self.samples)
            columns = [(r, power) for r, degree in enumerate(row_degree) for power in range(1, degree + 1)]
            out = np.zeros((self.samples, len(Q), len(columns)))
            for i, (r, power) in enumerate(columns):
                out[:, r, i] = time**power
            self._trends[key] = torch.as_tensor(out)
        return self._trends[key]

    def without_trends(self, error: Tensor, present: BoolArray) -> Tensor:
        """Errors (B, T, S') without what is open of their sensors."""
        degrees = self.open_degrees(self.system.mechanics.sensor_kind[present])
        if not degrees.any():
            return error
        out = error.clone()
        for degree in np.unique(degrees[degrees > 0]):
            at = torch.as_tensor(np.flatnonzero(degrees == degree))
            q, _ = np.linalg.qr(np.vander(np.linspace(-1, 1, self.samples), degree + 1))
            line = torch.as_tensor(q)
            out[:, :, at] = error[:, :, at] - line @ (line.T @ error[:, :, at])
        return out

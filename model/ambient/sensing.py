"""Sensors of one window as independent signals of unit noise.

Four accelerometers on a rigid body see three motions: an orthogonal transform of the sensors, each divided by its
noise, leaves three signals and a fourth that holds nothing but noise, whatever the parameters are.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sprung.model.mechanics import DISPLACEMENT, Mechanics
from sprung.model.signals import FloatArray, IntArray


@dataclass(frozen=True, slots=True)
class Sensing:
    """R signals of S sensors; n degrees of freedom, E elements."""

    rows: FloatArray  # signals per sensor, orthonormal but for the sensors' noise, shape (R, S)
    spare: FloatArray  # combinations in which no motion shows, of unit noise, shape (S - R, S)
    noise: FloatArray  # of the sensors, shape (S,)
    kind: IntArray  # ACCELERATION .. FORCE, shape (R,)
    motion: FloatArray  # signals per degree of freedom, shape (R, n)
    elements: FloatArray  # signals per element sensor's quantity, shape (R, E)

    def seen(self, matrix: np.ndarray) -> np.ndarray:
        """Spectral matrices of the signals from those of the sensors, (F, R, R)."""
        return np.asarray(self.rows @ matrix @ self.rows.T)

    def contradiction(self, matrix: np.ndarray) -> FloatArray:
        """Power of the spare combinations, 1 on average where the sensors agree; shape (F, S - R)."""
        return np.asarray(np.einsum("fii->fi", self.spare @ matrix @ self.spare.T).real)


def sensing(mechanics: Mechanics, sensors: IntArray, noise: FloatArray) -> Sensing:
    """For the sensors at indices `sensors` (S,) with standard deviations `noise` (S,) of one sample, in their units."""
    kind, S, L = mechanics.sensor_kind[sensors], mechanics.S[sensors], mechanics.L[sensors]
    rows, spare, kinds = [], [], []
    for of_kind in np.unique(kind):
        at = np.flatnonzero(kind == of_kind)
        unit = np.eye(len(kind))[at]
        if of_kind > DISPLACEMENT:
            basis, rank = np.eye(len(at)), len(at)
        else:
            basis, size, _ = np.linalg.svd(S[at] / noise[at, None])
            rank = int(np.sum(size > 1e-9 * size[0]))
        rows.append(basis[:, :rank].T @ unit)
        spare.append(basis[:, rank:].T @ unit)
        kinds += [of_kind] * rank
    together = np.concatenate(rows) / noise
    return Sensing(together, np.concatenate(spare) / noise, noise, np.array(kinds), together @ S, together @ L)

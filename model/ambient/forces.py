"""Structures under unmeasured forces: wind, traffic, people, machines.

Every degree of freedom carries a force of its own, independent of the others, with a free level L_i at a reference
frequency w_0 and a common slope a over log-frequency: X_ij = d_ij L_i (w / w_0)^a.
"""

from __future__ import annotations

import numpy as np

from sprung.model.ambient.excitation import Prior, Sources
from sprung.model.ambient.periodogram import Spectra
from sprung.model.signals import FloatArray

LEVEL_STD = 3.0  # of the logarithm of a level, about the one estimated from the sensors' power
SLOPE_STD = 1.0  # of the spectrum's slope about 0


class ForceExcitation:
    """Forces on n degrees of freedom; free numbers [log-levels, slope]."""

    def __init__(self, inertia: FloatArray, groups: Spectra) -> None:
        """inertia: mass or inertia of each degree of freedom: the first guess is one acceleration for all, (n,)."""
        self.inertia = inertia
        frequency = groups.frequency
        rise = np.log(frequency / np.sqrt(frequency.min() * frequency.max()))
        self.rise = np.concatenate([rise, rise])
        self.size = len(inertia) + 1
        self.each = np.eye(len(inertia))
        self.spread = np.broadcast_to(np.eye(self.size), (len(frequency), self.size, self.size))

    def sources(self, z: FloatArray) -> Sources:
        power = np.exp(z[:-1] + self.rise[:, None] * z[-1])  # (F, n)
        matrix = power[:, :, None] * self.each + 0j
        by_level = np.einsum("fi,il,im->flim", power, self.each, self.each)
        slopes = np.concatenate([by_level + 0j, (self.rise[:, None, None] * matrix)[:, None]], axis=1)
        return Sources(matrix, slopes)

    def start(self, power: FloatArray) -> FloatArray:
        level = np.mean(np.log(power)) + 2 * np.log(self.inertia)
        return np.append(level, 0.0)

    def prior(self, z: FloatArray) -> Prior:
        std = np.full(self.size, LEVEL_STD)
        std[-1] = SLOPE_STD
        return Prior(np.append(z[:-1], 0.0), std)

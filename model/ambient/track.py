"""Wheels on two rails: the same profile under all wheels of a rail, later by their distance over the speed.

With L_l, L_r the levels of the rails, g the coherence between them, e the share of a wheel's motion that is its own
(its roundness, what its load does to the ballast, the rail between two sleepers) and x_i ahead of the origin,

    S_ij = sqrt(L_i L_j) ((1 - e) g_ij exp(j w u (x_i - x_j)) + e d_ij)

where g_ij is 1 on one rail and g between the rails, d_ij is 1 for i = j, and u = 1 / speed.  Free are
the levels at two nodes an octave, g at one an octave, e at one in two octaves, and u.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sprung.model.ambient.excitation import Prior, Sources, log_level, nodes
from sprung.model.ambient.periodogram import Spectra
from sprung.model.signals import BoolArray, FloatArray

# nodes of what is unknown of a track: its level varies most over frequency, a wheel's own share least
LEVELS_PER_OCTAVE = 2.0
COHERENCES_PER_OCTAVE = 1.0
SHARES_PER_OCTAVE = 0.5
USUAL_SHARE, SHARE_STD = 0.05, 1.5  # median of a wheel's own share; standard deviation of its logit
LEAST_SHARE = 2e-3  # no wheel follows a delayed profile closer than this
COHERENCE_STD = 1.0  # of the inverse hyperbolic tangent of the coherence
LEVEL_STD = 3.0  # of the logarithm of a level, about the one estimated from the sensors' power
USUAL_COHERENCE = 0.5  # between rails, before a ride: neither alike nor apart


@dataclass(frozen=True, slots=True)
class Running:
    """Speed of the vehicle; `std` is infinite if unknown.  Negative speed: towards -x."""

    speed: float  # m/s
    std: float  # m/s


class TrackExcitation:
    """The wheels' displacements under a window's spectra; free numbers [left, right levels, g, e, u]."""

    def __init__(self, position: FloatArray, left: BoolArray, groups: Spectra, running: Running) -> None:
        """position: of each wheel ahead of the origin, m, shape (X,); left: which of them run on the left rail."""
        self.position, self.running = position, running
        self.omega = groups.sides[:, None, None]
        self.levels = nodes(groups.frequency, LEVELS_PER_OCTAVE)
        self.coherences = nodes(groups.frequency, COHERENCES_PER_OCTAVE)
        self.shares = nodes(groups.frequency, SHARES_PER_OCTAVE)
        sizes = [self.levels.shape[1]] * 2 + [self.coherences.shape[1], self.shares.shape[1], 1]
        self.at = [slice(end - size, end) for size, end in zip(sizes, np.cumsum(sizes), strict=True)]
        self.size = int(sum(sizes))
        self.spread = np.zeros((len(groups.frequency), 5, self.size))
        for row, basis in enumerate((self.levels, self.levels, self.coherences, self.shares, np.ones((1, 1)))):
            self.spread[:, row, self.at[row]] = basis
        self.apart = position[:, None] - position[None, :]
        self.own = np.eye(len(position))
        self.across = left[:, None] != left[None, :]
        self.of_left = 0.5 * (left[:, None] * 1.0 + left[None, :])

    def sources(self, z: FloatArray) -> Sources:
        local = self.spread @ z  # (F, 5)
        local = np.concatenate([local, local])
        left, right, coherence, share = (local[:, i, None, None] for i in range(4))
        slowness = z[-1]
        g, e = np.tanh(coherence), LEAST_SHARE + (1 - LEAST_SHARE) / (1 + np.exp(-share))
        size = np.exp(self.of_left * left + (1 - self.of_left) * right)  # sqrt(L_i L_j)
        turn = 1j * self.omega * self.apart
        delayed = size * np.exp(turn * slowness)
        common = (1 - e) * delayed * np.where(self.across, g, 1.0)
        matrix = common + e * size * self.own
        by_share = (e - LEAST_SHARE) * (1 - e) / (1 - LEAST_SHARE) * (size * self.own - common / (1 - e))
        slopes = np.stack(
            [
                self.of_left * matrix,
                (1 - self.of_left) * matrix,
                (1 - e) * delayed * np.where(self.across, 1 - g**2, 0.0),
                by_share,
                turn * common,
            ],
            axis=1,
        )
        return Sources(matrix, slopes)

    def start(self, power: FloatArray) -> FloatArray:
        level = log_level(self.levels, power)
        z = np.zeros(self.size)
        z[self.at[0]] = z[self.at[1]] = level
        z[self.at[2]] = np.arctanh(USUAL_COHERENCE)
        z[self.at[3]] = np.log(USUAL_SHARE / (1 - USUAL_SHARE))
        z[-1] = 1 / self.running.speed
        return z

    def prior(self, z: FloatArray) -> Prior:
        std = np.empty(self.size)
        for at, width in zip(self.at, (LEVEL_STD, LEVEL_STD, COHERENCE_STD, SHARE_STD, np.inf), strict=True):
            std[at] = width
        mean = self.start(np.ones(len(self.levels)))
        mean[: self.at[1].stop] = z[: self.at[1].stop]
        std[-1] = self.running.std / self.running.speed**2
        return Prior(mean, std)

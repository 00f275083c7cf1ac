"""Models of unmeasured excitation: spectral matrices with a few free values.

Every excitation describes the X sources by local quantities of each group of bins (a rail's level, a coherence, ...),
each of which is a smooth function over log-frequency with free values at nodes, or one number for all frequencies.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.interpolate import CubicSpline

from sprung.model.signals import FloatArray


@dataclass(frozen=True, slots=True)
class Sources:
    """Spectral matrix of the sources at both sides of F groups, and its derivatives by L local quantities."""

    matrix: np.ndarray  # shape (2 F, X, X)
    slopes: np.ndarray  # by each local quantity, shape (2 F, L, X, X)


@dataclass(frozen=True, slots=True)
class Prior:
    """Gaussian knowledge of the free numbers before the window."""

    mean: FloatArray  # shape (Q,)
    std: FloatArray  # shape (Q,)


class Excitation(Protocol):
    """Free numbers in, spectral matrix of the sources out."""

    spread: FloatArray  # local quantities per free number, shape (F, L, Q)

    def sources(self, z: FloatArray) -> Sources:
        """For the groups that the excitation was made for."""

    def start(self, power: FloatArray) -> FloatArray:
        """Free numbers for sources of the spectral level `power` (F,), which all sources share."""

    def prior(self, z: FloatArray) -> Prior:
        """What is known beforehand, about the start `z`."""


def nodes(frequency: FloatArray, per_octave: float) -> FloatArray:
    """Spline basis over log-frequency, (F, nodes), with evenly spaced nodes from the lowest to the highest."""
    low, high = np.log(frequency.min()), np.log(frequency.max())
    count = max(2, 1 + round((high - low) / np.log(2) * per_octave))
    at = np.linspace(low, high, count)
    if count == 2:
        share = (np.log(frequency) - low) / (high - low)
        return np.stack([1 - share, share], axis=1)
    return np.asarray(CubicSpline(at, np.eye(count), bc_type="natural")(np.log(frequency)))


def log_level(basis: FloatArray, power: FloatArray) -> FloatArray:
    """Values (K,) at the nodes of a basis (F, K) for a power (F,) over frequency, least squares of the logarithms."""
    return np.asarray(np.linalg.lstsq(basis, np.log(power), rcond=None)[0])

"""Spectral matrices of one window: tapered, and averaged over narrow groups of bins.

With a taper h of sum h^2 = 1 the bins Y_k = sum_t h_t y_t e^{-j w_k t} of a stationary record are nearly independent
complex Gaussian vectors with covariance S(w_k) (Whittle).  A taper costs sum h^4 * T of them in effect; a group of m
bins within which S hardly changes counts as a complex Wishart matrix of m / (T sum h^4) degrees of freedom.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from sprung.model.signal_filters import tukey
from sprung.model.signals import FloatArray, IntArray

EDGE = 0.2  # share of the window in the taper's cosine edges: leakage falls with the third power, 6 % wider deviations


@dataclass(frozen=True, slots=True)
class Spectra:
    """Averaged periodograms of S signals at F groups of bins; white noise of variance r^2 gives r^2."""

    frequency: FloatArray  # centre of each group, Hz, shape (F,)
    reach: FloatArray  # standard deviation of the frequencies that a group averages over, Hz, shape (F,)
    matrix: np.ndarray  # complex, Hermitian, shape (F, S, S)
    weight: FloatArray  # effective degrees of freedom, shape (F,)

    @property
    def sides(self) -> FloatArray:
        """Two angular frequencies for each group whose mean and scatter are those of the group, shape (2 F,).

        The expected periodogram is S averaged over what group and taper reach; the mean of S at these two is that to
        second order, with the loss of coherence between sensors that a resonance or a delay brings.
        """
        return np.asarray(2 * np.pi * np.concatenate([self.frequency - self.reach, self.frequency + self.reach]))

    def part(self, chosen: IntArray) -> Spectra:
        """Some of the groups."""
        return Spectra(self.frequency[chosen], self.reach[chosen], self.matrix[chosen], self.weight[chosen])


def spectra(values: FloatArray, sample_rate: float, band: tuple[float, float], sharpness: float) -> Spectra:
    """Spectral matrices of a window (T, S) within `band` (Hz).

    sharpness: width of a group over its frequency; a fifth of the least damping ratio keeps resonances whole.
    """
    samples = len(values)
    taper = tukey(samples, EDGE)
    taper = taper / np.sqrt(np.sum(taper**2))
    bins = np.fft.rfft((values - values.mean(axis=0)) * taper[:, None], axis=0)
    step = sample_rate / samples
    starts = _groups(samples, step, band, sharpness)
    matrix = np.stack([_mean_product(bins[a:b]) for a, b in pairwise(starts)])
    count = np.diff(starts)
    taper_reach = np.sqrt(np.sum(np.diff(taper) ** 2)) * sample_rate / (2 * np.pi)
    return Spectra(
        frequency=(starts[:-1] + starts[1:] - 1) / 2 * step,
        reach=np.hypot(step * np.sqrt((count**2 - 1) / 12), taper_reach),
        matrix=matrix,
        weight=count / (samples * np.sum(taper**4)),
    )


WIDEST = 0.15  # Hz, of a group of bins


def _groups(samples: int, step: float, band: tuple[float, float], sharpness: float) -> np.ndarray:
    """First bins of the groups, and the bin after the last."""
    first = max(2, int(np.ceil(band[0] / step)))
    last = min(int(band[1] / step), (samples - 1) // 2)
    if last <= first:
        raise ValueError(f"a window of {samples * 1.0:g} samples has no bins between {band[0]:g} and {band[1]:g} Hz")
    starts = [first]
    while starts[-1] <= last:
        wide = min(sharpness * starts[-1] * step, WIDEST)
        starts.append(starts[-1] + max(1, round(wide / step)))
    return np.array(starts)


def _mean_product(bins: np.ndarray) -> np.ndarray:
    return np.asarray(bins.T @ bins.conj() / len(bins))

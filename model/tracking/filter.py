"""Kalman filter over level and rate of every log-ratio, with full covariance.

State (2P,): levels first, then rates.  One window measures the identifiable levels with the correlated errors that
its covariance states.  Robust: influence of a component, and of the window as a whole, is bounded.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg.lapack import dpotrf, dpotrs

from sprung.model.signals import BoolArray, FloatArray
from sprung.model.tracking.settings import ProcessNoise


@dataclass(frozen=True, slots=True, eq=False)
class Belief:
    """N(mean, covariance) of levels and rates."""

    mean: FloatArray  # shape (2P,), log-ratio and 1/s
    covariance: FloatArray  # shape (2P, 2P)

    @property
    def size(self) -> int:
        return len(self.mean) // 2

    @property
    def level(self) -> FloatArray:
        return self.mean[: self.size]

    @property
    def level_variance(self) -> FloatArray:
        return np.diag(self.covariance)[: self.size]


@dataclass(frozen=True, slots=True, eq=False)
class Innovation:
    """What a window said beyond the prediction."""

    score: FloatArray  # in standard deviations of prediction and one window, shape (P,); NaN: not measured
    bounded: bool  # the window as a whole lies too far out, and its influence was bounded


def prior(size: int, std: float, process: ProcessNoise) -> Belief:
    """Belief before any window: nominal values, stationary rates."""
    variance = np.concatenate([np.full(size, std**2), np.full(size, process.drift_rate**2)])
    return Belief(np.zeros(2 * size), np.diag(variance))


def predict(belief: Belief, dt: float, process: ProcessNoise, std: float) -> Belief:
    """Belief `dt` seconds later; no level becomes less certain than its prior `std`.

    Integrated Ornstein-Uhlenbeck process, exact for any dt (e.g. Gillespie, Phys. Rev. E 54, 2084, 1996).
    """
    p, tau = belief.size, process.drift_time
    gain = -tau * float(np.expm1(-dt / tau))
    decay = 1.0 - gain / tau
    mean = np.concatenate([belief.level + gain * belief.mean[p:], decay * belief.mean[p:]])
    old = belief.covariance
    cross = old[:p, p:] + gain * old[p:, p:]
    covariance = np.empty_like(old)
    block = old[:p, :p] + gain * (old[:p, p:] + cross.T)
    covariance[:p, :p] = 0.5 * (block + block.T)
    covariance[:p, p:] = decay * cross
    covariance[p:, :p] = covariance[:p, p:].T
    covariance[p:, p:] = decay**2 * old[p:, p:]
    rate = process.drift_rate**2
    level = 2 * rate * tau * (dt - gain) - rate * gain**2 + process.wander**2 * dt
    blocks = covariance.reshape(2, p, 2, p)
    noise = ((max(level, 0.0), rate * gain**2 / tau), (rate * gain**2 / tau, rate * (1.0 - decay**2)))
    for i, j in ((0, 0), (0, 1), (1, 0), (1, 1)):
        np.einsum("kk->k", blocks[i, :, j, :])[:] += noise[i][j]
    return Belief(mean, _bounded(covariance, p, std))


def _bounded(covariance: FloatArray, p: int, std: float) -> FloatArray:
    """Shrinks rows and columns of levels whose variance passed the prior's; correlations are kept."""
    variance = np.diag(covariance)[:p]
    if np.all(variance <= std**2):
        return covariance
    scale = np.ones(len(covariance))
    scale[:p] = np.minimum(1.0, std / np.sqrt(variance))
    return covariance * np.outer(scale, scale)


def correct(
    belief: Belief,
    value: FloatArray,  # log-ratios, shape (P,)
    covariance: FloatArray,  # of one window, scatter included, shape (P, P)
    mask: BoolArray,  # components that the window measures, shape (P,)
    *,
    share: float,  # of the window that no earlier window saw, in (0, 1]
    bound: float,  # standard deviations beyond which influence no longer grows
) -> tuple[Belief, Innovation]:
    """Belief after one window.

    Components that the window does not measure are marginalised out (their rows and columns dropped), since their
    covariance holds the estimator's prior and not information.  Errors of overlapping windows are correlated; summed
    over many windows the covariance of one, divided by `share`, gives the right total information.
    """
    rows = np.flatnonzero(mask)
    score = np.full(belief.size, np.nan)
    if len(rows) == 0:
        return belief, Innovation(score, False)
    residual = value[rows] - belief.mean[rows]
    own = belief.covariance[np.ix_(rows, rows)]
    noise = covariance[np.ix_(rows, rows)]
    score[rows] = residual / np.sqrt(np.diag(own) + np.diag(noise))
    stretch = np.sqrt(np.maximum(1.0, np.abs(score[rows]) / bound))  # Huber: influence stays at the bound
    noise = noise * np.outer(stretch, stretch)
    distance = float(residual @ _solve(own + noise, residual)) / len(rows)
    limit = 1.0 + 2.0 * bound * np.sqrt(2.0 / len(rows))  # mean of chi-square / P, and 2 bound deviations of it
    noise = noise * (max(1.0, distance / limit) / share)
    across = belief.covariance[:, rows]
    gain = _solve(own + noise, across.T).T
    posterior = belief.covariance - gain @ across.T
    posterior = 0.5 * (posterior + posterior.T)
    return Belief(belief.mean + gain @ residual, posterior), Innovation(score, distance > limit)


def _solve(matrix: FloatArray, right: FloatArray) -> FloatArray:
    """Solution for a positive definite matrix; LAPACK without the wrappers, which would double an update's time."""
    factor, failed = dpotrf(matrix, lower=1)
    if failed:
        raise np.linalg.LinAlgError("the tracker's covariance is not positive definite")
    solution: FloatArray = dpotrs(factor, right, lower=1)[0]
    return solution


def reopen(belief: Belief, variance: FloatArray, process: ProcessNoise) -> Belief:
    """Forgets what was known of levels whose `variance` (P,) is positive: their value has jumped.

    The rate starts anew from its stationary law, uncorrelated with everything else.
    """
    p = belief.size
    rows = np.flatnonzero(variance > 0)
    mean, covariance = belief.mean.copy(), belief.covariance.copy()
    covariance[rows, rows] += variance[rows]
    rates = rows + p
    covariance[rates, :] = 0.0
    covariance[:, rates] = 0.0
    covariance[rates, rates] = process.drift_rate**2
    mean[rates] = 0.0
    return Belief(mean, covariance)

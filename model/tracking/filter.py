"""Kalman filter over level and rate of every log-ratio, with full covariance.

State (2P + H,): levels first, then rates, then deviations of measurements and loads (`model.tracking.deviations`; none
by default).  One window measures the identifiable levels with the correlated errors that its covariance states.
Robust: the influence of a component, and of the window as a whole, is bounded.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg.lapack import dpotrf, dpotrs

from sprung.model.signals import BoolArray, FloatArray
from sprung.model.tracking.settings import ProcessNoise


@dataclass(frozen=True, slots=True, eq=False)
class Belief:
    """N(mean, covariance) of levels, rates and deviations."""

    mean: FloatArray  # shape (2P + H,), log-ratio and 1/s
    covariance: FloatArray  # shape (2P + H, 2P + H)
    deviations: int = 0  # H

    @property
    def size(self) -> int:
        return (len(self.mean) - self.deviations) // 2

    @property
    def level(self) -> FloatArray:
        return self.mean[: self.size]

    @property
    def level_variance(self) -> FloatArray:
        return self.covariance.diagonal()[: self.size]


@dataclass(frozen=True, slots=True, eq=False)
class Innovation:
    """Difference between a window and its prediction."""

    score: FloatArray  # in standard deviations of prediction and one window, shape (P,); NaN: not measured
    bounded: bool  # the window as a whole lies too far out, and its influence was bounded


def prior(size: int, std: float, process: ProcessNoise, deviations: FloatArray | None = None) -> Belief:
    """Belief before any window: nominal values, stationary rates; `deviations`: their covariance (H, H)."""
    variance = np.concatenate([np.full(size, std**2), np.full(size, process.drift_rate**2)])
    H = 0 if deviations is None else len(deviations)
    covariance = np.zeros((2 * size + H, 2 * size + H))
    np.einsum("kk->k", covariance[: 2 * size, : 2 * size])[:] = variance
    if deviations is not None:
        covariance[2 * size :, 2 * size :] = deviations
    return Belief(np.zeros(2 * size + H), covariance, H)


def predict(
    belief: Belief,
    dt: float,
    process: ProcessNoise,
    std: float,
    walk: FloatArray | None = None,
    limit: FloatArray | None = None,
) -> Belief:
    """Belief `dt` seconds later; no level becomes less certain than its prior `std`, no deviation than `limit` (H,).

    walk: covariance per second of the deviations' random walk, (H, H).

    Integrated Ornstein-Uhlenbeck process, exact for any dt (e.g. Gillespie, Phys. Rev. E 54, 2084, 1996).
    """
    p, tau = belief.size, process.drift_time
    gain = -tau * float(np.expm1(-dt / tau))
    decay = 1.0 - gain / tau
    rates = slice(p, 2 * p)
    mean = np.concatenate([belief.level + gain * belief.mean[rates], decay * belief.mean[rates], belief.mean[2 * p :]])
    whole = belief.covariance
    old = whole[: 2 * p, : 2 * p]
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
    bounds = np.full(p, std)
    if belief.deviations:
        covariance = _with_deviations(whole, covariance, gain, decay, p)
        if walk is not None and limit is not None:
            covariance[2 * p :, 2 * p :] += walk * dt
            bounds = np.concatenate([bounds, np.full(p, np.inf), limit])
    return Belief(mean, _bounded(covariance, bounds), belief.deviations)


def _with_deviations(whole: FloatArray, moved: FloatArray, gain: float, decay: float, p: int) -> FloatArray:
    """The whole covariance after levels and rates have moved to `moved` (2p, 2p)."""
    covariance = whole.copy()
    covariance[: 2 * p, : 2 * p] = moved
    covariance[:p, 2 * p :] = whole[:p, 2 * p :] + gain * whole[p : 2 * p, 2 * p :]
    covariance[p : 2 * p, 2 * p :] = decay * whole[p : 2 * p, 2 * p :]
    covariance[2 * p :, : 2 * p] = covariance[: 2 * p, 2 * p :].T
    return covariance


def _bounded(covariance: FloatArray, std: FloatArray) -> FloatArray:
    """Shrinks the first rows and columns whose variance passed that of `std`; correlations are kept."""
    variance = covariance.diagonal()[: len(std)]
    if np.all(variance <= std**2):
        return covariance
    scale = np.ones(len(covariance))
    scale[: len(std)] = np.minimum(1.0, std / np.sqrt(np.maximum(variance, 1e-300)))
    return covariance * np.outer(scale, scale)


def correct(
    belief: Belief,
    value: FloatArray,  # log-ratios, shape (P,)
    covariance: FloatArray,  # of one window, scatter included, shape (P, P)
    mask: BoolArray,  # components that the window measures, shape (P,)
    *,
    share: float,  # of the window that no earlier window contains, in (0, 1]
    bound: float,  # standard deviations beyond which influence no longer grows
    cross: FloatArray | None = None,  # sensitivity of `value` to the deviations, shape (P, H)
    considered: BoolArray | None = None,  # deviations (H,) that the window depends on but does not estimate
) -> tuple[Belief, Innovation]:
    """Belief after one window.

    Components that the window does not measure are marginalised out (their rows and columns dropped), since their
    covariance holds the estimator's prior and not information.  Errors of overlapping windows are correlated; summed
    over many windows the covariance of one, divided by `share`, gives the right total information.
    """
    whole = bool(mask.all())
    rows = slice(0, belief.size) if whole else np.flatnonzero(mask)
    score = np.full(belief.size, np.nan)
    if not mask.any():
        return belief, Innovation(score, False)
    residual = value[rows] - belief.mean[rows]
    across = belief.covariance[:, rows]
    if cross is not None:
        across = across - belief.covariance[:, 2 * belief.size :] @ cross[rows].T
    own = across[rows]
    if cross is not None:
        own = own - cross[rows] @ across[2 * belief.size :]
    noise = covariance if whole else covariance[rows][:, rows]
    score[rows] = residual / np.sqrt(own.diagonal() + noise.diagonal())
    stretch = np.sqrt(np.maximum(1.0, np.abs(score[rows]) / bound))  # Huber: influence stays at the bound
    noise = noise * np.outer(stretch, stretch)
    distance = float(residual @ _solve(own + noise, residual)) / len(residual)
    limit = 1.0 + 2.0 * bound * np.sqrt(2.0 / len(residual))  # mean of chi-square / P, and 2 bound deviations of it
    noise = noise * (max(1.0, distance / limit) / share)
    gain = _solve(own + noise, across.T).T
    posterior = belief.covariance - gain @ across.T
    if considered is not None:  # Schmidt-Kalman filter: their mean and covariance stay, cross-covariances are updated
        kept = 2 * belief.size + np.flatnonzero(considered)
        posterior[np.ix_(kept, kept)] = belief.covariance[np.ix_(kept, kept)]
        gain[kept] = 0.0
    posterior = 0.5 * (posterior + posterior.T)
    return Belief(belief.mean + gain @ residual, posterior, belief.deviations), Innovation(score, distance > limit)


def _solve(matrix: FloatArray, right: FloatArray) -> FloatArray:
    """Solution for a positive definite matrix; LAPACK without the wrappers, which would double an update's time."""
    factor, failed = dpotrf(matrix, lower=1)
    if failed:
        raise np.linalg.LinAlgError("the tracker's covariance is not positive definite")
    solution: FloatArray = dpotrs(factor, right, lower=1)[0]
    return solution


def reopen(belief: Belief, variance: FloatArray, process: ProcessNoise) -> Belief:
    """Adds `variance` (P,) to levels that have jumped, where it is positive (covariance reset).

    The rate restarts from its stationary distribution, uncorrelated with everything else.
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
    return Belief(mean, covariance, belief.deviations)

"""One usable window as the filter takes it: values corrected to the believed deviations, covariance, weight."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg.lapack import dpotrf

from sprung.model.signals import BoolArray, FloatArray
from sprung.model.tracking import filter as kalman

MAX_STD = 0.2  # standard deviation of a log-ratio beyond which a window is dropped for a parameter that is known: the
# estimator itself drops those beyond 0.3, and so more low values than high ones
LINEAR_STD = 0.03  # standard deviation of a log-ratio below which its skewness is negligible: an error of 0.1 %
LINEAR_RANGE = 1.0  # log-ratio from the belief up to which a window is taken as linear in the values themselves
COMMON = 0.35  # error common to all windows, in their deviations, where the information is input noise for the most
NOISY = 0.08  # part; simulated, 8 to 13 m/s: 0.3 at a share of noise of 0.17, at most 0.5 at 0.3; none below 0.02
MANY = 500.0  # such windows, of a ride of some minutes, whose mean is as uncertain as their common error


@dataclass(frozen=True)
class TrackedWindow:
    """A usable window, corrected to the believed deviations."""

    mask: BoolArray  # parameters that it identifies, (P,)
    time_ns: int
    centre: int  # ns
    share: float  # of the window that no earlier window contains
    weight: float  # relative to a window without noise in its inputs
    value: FloatArray  # log-ratios (P,)
    covariance: FloatArray  # (P, P)
    cross: FloatArray  # sensitivities to deviations (P, H)
    own_cross: bool  # whether these were computed for this window, or are the mean of earlier ones


def in_linear_scale(window: TrackedWindow, belief: kalman.Belief) -> TrackedWindow:
    """The window with values and covariance linear in the stiffnesses and dampings themselves, about the belief.

    Errors of logarithms are skewed: a damping that noise makes too large has the smaller stated error, so that a mean
    weighted by stated errors is too large by 1.5 times the variance of one window.
    """
    known = belief.level_variance
    own = np.where(window.mask, window.covariance.diagonal(), 1.0)
    away = own / (own + known) * (window.value - belief.level)  # from where the belief will be
    away = np.where(window.mask & (own > LINEAR_STD**2), np.clip(away, -LINEAR_RANGE, LINEAR_RANGE), 0.0)
    if not away.any():
        return window
    scale = np.exp(away)
    imprecise = (np.sqrt(own) * scale > MAX_STD) & (known < MAX_STD**2 / 4)
    return replace(
        window,
        mask=window.mask & ~imprecise,
        value=window.value + np.expm1(away) - away,
        covariance=window.covariance * np.outer(scale, scale),
        cross=window.cross * scale[:, None],
    )


def noise_weight(noise: float) -> float:
    """Weight of a window in whose information on the parameters `noise` is the share of input noise.

    Input noise that looks like motion biases springs, dampers and loads of all such windows in the same direction,
    which averaging does not reduce.
    """
    common = COMMON * noise**2 / (noise**2 + NOISY**2)
    return 1 / (1 + MANY * common**2)


def is_covariance(matrix: FloatArray) -> bool:
    """Whether a matrix (n, n) is finite and positive definite."""
    return bool(np.all(np.isfinite(matrix))) and dpotrf(matrix, lower=1)[1] == 0

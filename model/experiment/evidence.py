"""Expected evidence of a run between two models: the expected logarithm of their likelihood ratio.

If A is true, B is fitted to what A would show.  Where B's best values leave a misfit of D (half the whitened squares,
windows and what is known of the values before together), the log-likelihood ratio of the run is normal with mean D and
variance 2 D: the noise shifts it by its projection on the difference of the two signals.  Windows are fitted one by one
as online; their values are then brought together, by the curvature of each window, into one value for the run:

    2 D = sum_w [ c_w + (theta - theta_w)' P_w (theta - theta_w) ] + theta' K theta,   least over theta,

c_w the window's misfit, P_w its information, K what is known before.  What the model of the truth itself leaves over in
the same arithmetic is taken off; windows of which it leaves more than noise would (the run is too violent there for
their sampling) contain no information.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from sprung.model.experiment.drives import loaded, run_inputs
from sprung.model.experiment.menu import MenuRun
from sprung.model.identification.likelihood.linearise import PRIOR_STD
from sprung.model.identification.nonlinear.with_laws import LawRefiner, acting_laws
from sprung.model.identification.refinement.refine import Refined, Refiner
from sprung.model.signals import BoolArray, FloatArray
from sprung.model.simulate.ride import simulate_ride
from sprung.model.system import System

STRONG = 10.0  # log-likelihood ratio beyond which one model is taken: odds of 20 000 to 1
_SOUND = 1.0  # chi-square per degree of freedom that is left without noise: as much as noise would
KNOWN = 0.05  # by which springs and dampers are known from the recording before, of their logarithm


@dataclass(frozen=True, slots=True)
class FittedRun:
    """A model on a run's samples."""

    misfit: float  # half the whitened squares, with what was known before
    unwhitened: float  # half the squares in the sensors' noise alone
    log_ratio: FloatArray  # values of the run together, (P,)
    chi_square: FloatArray  # of every window, per degree of freedom, (B,)


@dataclass(frozen=True, slots=True)
class Promise:
    """What a run promises where one of two models is true."""

    evidence: float  # expected log-likelihood ratio
    difference: float  # half the squared difference of the best signals in the sensors' noise

    @property
    def chance(self) -> float:
        """Probability that the evidence will be strong."""
        spread = math.sqrt(2 * max(self.evidence, 1e-12))
        return 0.5 * math.erfc((STRONG - self.evidence) / (spread * math.sqrt(2)))


def simulated(system: System, run: MenuRun, seed: int = 0, noise: np.random.Generator | None = None) -> FloatArray:
    """What would be recorded of a run, (T, C); with the noise of sensors and inputs where a generator is given."""
    driven = run_inputs(system, run, seed)
    sensors = simulate_ride(loaded(system, run), driven, noise=noise).sensors
    if noise is not None:
        driven = driven + noise.normal(0.0, [channel.noise for channel in system.inputs], driven.shape)
    return np.concatenate([driven, sensors], axis=1)


def promise(truth: System, other: System, run: MenuRun, known: float = KNOWN, seed: int = 0) -> Promise:
    """Expected evidence of a run against `other` if `truth` is true."""
    values = simulated(truth, run, seed)
    if not np.isfinite(values).all():  # too violent for the simulation itself
        return Promise(0.0, 0.0)
    right = fitted(loaded(truth, run), values, known)
    sound = right.chi_square < _SOUND
    if not sound.any():
        return Promise(0.0, 0.0)
    right = right if sound.all() else fitted(loaded(truth, run), values, known, sound)
    wrong = fitted(loaded(other, run), values, known, sound)
    return Promise(max(0.0, wrong.misfit - right.misfit), max(0.0, wrong.unwhitened - right.unwhitened))


def fitted(system: System, values: FloatArray, known: float = KNOWN, which: BoolArray | None = None) -> FittedRun:
    """A model fitted to samples (T, C); known: standard deviation of log-ratios of springs, dampers and masses.

    which: of the windows, (B,); all if left out.
    """
    length = system.window
    starts = range(length, len(values) - length + 1, length)  # the first window swings in
    windows = np.stack([values[i : i + length] for i in starts])
    windows = windows if which is None else windows[which]
    refined = _refined(system, windows)
    scale = np.maximum(refined.chi_square, 1.0)[:, None, None]  # deviations were stretched by what did not fit
    information = np.linalg.inv(refined.covariance / scale)  # (B, P, P)
    before = np.diag(1 / _known(system, known) ** 2)
    total = information.sum(axis=0) + before
    theta = np.linalg.solve(total, np.einsum("bij,bj->i", information, refined.log_ratio))
    apart = theta - refined.log_ratio
    spread = np.einsum("bi,bij,bj->", apart, information, apart)
    cost = float((refined.chi_square * refined.freedom).sum() + spread + theta @ before @ theta)
    noise = np.array([channel.noise for channel in system.channels[len(system.inputs) :]])
    white = float(np.nansum((refined.error / noise) ** 2) * length + spread + theta @ before @ theta)
    return FittedRun(0.5 * cost, 0.5 * white, theta, refined.chi_square)


def _refined(system: System, windows: FloatArray) -> Refined:
    refiner = LawRefiner if acting_laws(system) else Refiner
    return refiner(system, windows.shape[1]).refine(windows)


def _known(system: System, known: float) -> FloatArray:
    """Standard deviations of log-ratios before the run, (P,): laws' values are as free as a window leaves them."""
    free = len(system.tracked) - len(system.parameters)
    return np.concatenate([np.full(len(system.parameters), known), np.full(free, PRIOR_STD)])

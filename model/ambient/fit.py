"""Most probable unknowns of one window by Fisher scoring, damped when a step would make things worse."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import scipy.linalg

from sprung.model.ambient.excitation import Prior
from sprung.model.ambient.whittle import Evaluation
from sprung.model.signals import BoolArray, FloatArray

STEP_LIMIT = 1.0  # largest change of a logarithm in one step
CONVERGED = 0.03  # a step this small, in standard deviations, ends the iteration
SLOPE_STEP = 8  # damping is raised or lowered by this factor
HARDEST = 1e6  # damping beyond which no further step is tried


class Likelihood(Protocol):
    """What can be fitted."""

    def evaluate(self, x: FloatArray) -> Evaluation:
        """At a point; `LinAlgError` where there is none."""


@dataclass(frozen=True, slots=True)
class PosteriorFit:
    """The maximum a posteriori point and its covariance."""

    x: FloatArray  # shape (P + Q,)
    covariance: FloatArray  # shape (P + Q, P + Q), prior included
    at: Evaluation
    cost: float  # negative log-posterior
    converged: bool
    iterations: int


def fit(
    likelihood: Likelihood, x: FloatArray, prior: Prior, free: BoolArray | None = None, limit: int = 40
) -> PosteriorFit:
    """Scoring from `x` (X,) with a Gaussian prior; values that are not `free` (X,) are fixed and count as known."""
    chosen = np.flatnonzero(np.ones(len(x), dtype=bool) if free is None else free)
    precision = prior.std[chosen] ** -2.0
    damping, converged, iterations = 1e-3, False, 0
    at = likelihood.evaluate(x)
    cost = at.cost + _penalty(x, prior)
    while not converged and iterations < limit and damping < HARDEST:
        iterations += 1
        slope = at.gradient[chosen] + (x - prior.mean)[chosen] * precision
        information = at.information[np.ix_(chosen, chosen)] + np.diag(precision)
        scale = np.sqrt(np.diag(information))
        scaled = information / np.outer(scale, scale)
        step = -scipy.linalg.solve(scaled + damping * np.eye(len(scale)), slope / scale, assume_a="pos") / scale
        step *= STEP_LIMIT / max(STEP_LIMIT, float(np.abs(step).max()))
        moved = x.copy()
        moved[chosen] += step
        try:
            tried = likelihood.evaluate(moved)
            tried_cost = tried.cost + _penalty(moved, prior)
        except np.linalg.LinAlgError:
            tried_cost = np.inf
        if tried_cost <= cost + 1e-9 * abs(cost):
            # Newton decrement: how far the minimum may still be, in standard deviations.
            converged = bool(np.sqrt(abs(slope @ step)) < CONVERGED and damping < 1.0)
            x, at, cost, damping = moved, tried, tried_cost, damping / SLOPE_STEP
        else:
            damping *= SLOPE_STEP
    information = at.information[np.ix_(chosen, chosen)] + np.diag(precision)
    covariance = np.zeros((len(x), len(x)))
    covariance[np.ix_(chosen, chosen)] = _inverse(information)
    return PosteriorFit(x, covariance, at, float(cost), converged, iterations)


def _penalty(x: FloatArray, prior: Prior) -> float:
    return float(0.5 * np.sum(((x - prior.mean) / prior.std) ** 2))


def _inverse(information: FloatArray) -> FloatArray:
    scale = np.sqrt(np.diag(information))
    return np.asarray(np.linalg.inv(information / np.outer(scale, scale)) / np.outer(scale, scale))

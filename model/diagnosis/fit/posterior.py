"""Objective of a fit, twice the negative log-posterior up to a constant, and its damped normal equations."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sprung.model.diagnosis.fit.jacobian import Linearised
from sprung.model.diagnosis.fit.problem import Problem
from sprung.model.diagnosis.fit.smoothing import scale_of
from sprung.model.diagnosis.response.point import Point, at_active_bounds
from sprung.model.signals import FloatArray

LEAST_DAMPING = 1e-6  # of the scaled normal equations


def objective(problem: Problem, residual: FloatArray, log_det: float, point: Point) -> float:
    """Twice the negative log-posterior, up to a constant; residual: whitened, (R,)."""
    return float(residual @ residual + log_det + np.sum(prior_residual(problem, point)[0] ** 2))


def prior_residual(problem: Problem, point: Point) -> tuple[FloatArray, FloatArray]:
    """Prior residuals of theta and the terms' parameters, in standard deviations, and their weights, each (P + p,)."""
    prior = problem.rules.fit.prior
    away, sharp = [point.theta / prior], [np.full(len(point.theta), 1 / prior)]
    for term in point.terms:
        away.append(term.prior_deviations)
        sharp.append(1 / np.array(term.known) if term.known else np.zeros(len(term.parameters)))
    return np.concatenate(away), np.concatenate(sharp)


def with_priors(problem: Problem, point: Point, gram: FloatArray) -> FloatArray:
    """Information matrix (X, X) of data, J^T J, with that of the priors added."""
    sharp = prior_residual(problem, point)[1]
    normal = gram.copy()
    normal[np.arange(len(sharp)), np.arange(len(sharp))] += sharp**2
    return normal


def normal_equations(problem: Problem, lin: Linearised, point: Point) -> tuple[FloatArray, FloatArray]:
    """Scaled matrix of the normal equations, priors included, and the scales."""
    normal = with_priors(problem, point, lin.gram)
    scale = scale_of(normal, len(point.state))
    return normal * scale * scale[:, None], scale


class DampedStep(NamedTuple):
    """A Gauss-Newton step with Levenberg-Marquardt damping."""

    step: FloatArray  # (X,)
    sigma: FloatArray  # standard deviations of theta and term parameters, (P + p,)
    promised: float  # predicted decrease of the objective by the step with least damping
    promised_damped: float  # and by this one


def gauss_newton_step(problem: Problem, lin: Linearised, point: Point, damping: float) -> DampedStep:
    """The step of the normal equations, priors included; values at a bound that it would pass are held."""
    scaled, scale = normal_equations(problem, lin, point)
    gradient = lin.jacobian.T @ lin.residual
    gradient[: len(lin.log_det_slope)] -= lin.log_det_slope / 2
    away, sharp = prior_residual(problem, point)
    gradient[: len(sharp)] -= away * sharp
    free = len(scaled) - len(point.state)
    found = _solved(scaled, scale, gradient, damping, free)
    held = at_active_bounds(point, found.step)
    if held.any():  # the step of the others at constant held values
        scaled[held], scaled[:, held], gradient[held] = 0.0, 0.0, 0.0
        found = _solved(scaled, scale, gradient, damping, free)
    return found


def _solved(scaled: FloatArray, scale: FloatArray, gradient: FloatArray, damping: float, free: int) -> DampedStep:
    """Solution of the damped normal equations, with the deviations of the first `free` values."""
    values, vectors = np.linalg.eigh(scaled)
    values = np.maximum(values, 0.0)
    turned = vectors.T @ (gradient * scale)
    damped = values + damping + 1e-13
    variance = scale**2 * (vectors**2 @ (1 / damped))
    return DampedStep(
        scale * (vectors @ (turned / damped)),
        np.sqrt(np.maximum(variance, 1e-300))[:free],
        float(np.sum(turned**2 / (values + LEAST_DAMPING))),
        float(np.sum((turned / damped) ** 2 * (2 * damped - values))),
    )

"""Fisher scoring against closed forms: a Gaussian likelihood, and one that leaves where there is none."""

from __future__ import annotations

import numpy as np
import pytest

from sprung.model.ambient.excitation import Prior
from sprung.model.ambient.fit import STEP_LIMIT, fit
from sprung.model.ambient.whittle import Evaluation
from sprung.model.signals import FloatArray, IntArray

RNG = np.random.default_rng(8)
FACTOR = RNG.normal(size=(30, 4)) * [1.0, 10.0, 1.0, 0.1]  # of very different scales
TARGET = RNG.normal(size=30)
PRIOR = Prior(np.array([0.1, 0.0, -0.1, 0.3]), np.array([0.5, 1.0, 0.3, 2.0]))


def evaluation(cost: float, gradient: FloatArray, information: FloatArray) -> Evaluation:
    nothing = np.zeros((1, 1, 1))
    return Evaluation(cost, gradient, information, nothing, nothing, nothing)


class Gaussian:
    """|F x - y|^2 / 2."""

    def evaluate(self, x: FloatArray) -> Evaluation:
        left = FACTOR @ x - TARGET
        return evaluation(0.5 * float(left @ left), FACTOR.T @ left, FACTOR.T @ FACTOR)


class Rate:
    """n times an exponential distribution of mean 1, with x the logarithm of its rate; nothing beyond `wall`."""

    def __init__(self, n: int, wall: float = np.inf) -> None:
        self.n, self.wall, self.points = n, wall, [0.0]

    def evaluate(self, x: FloatArray) -> Evaluation:
        u = float(x[0])
        if u > self.wall:
            raise np.linalg.LinAlgError
        self.points.append(u)
        cost, slope = self.n * (np.exp(u) - u), self.n * (np.exp(u) - 1)
        return evaluation(float(cost), np.array([slope]), np.array([[float(self.n)]]))


def posterior(free: IntArray) -> tuple[FloatArray, FloatArray]:
    """Mean and covariance of the free values, the others known to be 0."""
    F, std = FACTOR[:, free], PRIOR.std[free]
    covariance = np.asarray(np.linalg.inv(F.T @ F + np.diag(std**-2)), dtype=np.float64)
    return covariance @ (F.T @ TARGET + PRIOR.mean[free] / std**2), covariance


def test_a_gaussian_likelihood_gives_the_posterior_of_its_normal_equations() -> None:
    found = fit(Gaussian(), np.zeros(4), PRIOR)
    mean, covariance = posterior(np.arange(4))
    assert found.converged
    np.testing.assert_allclose(found.covariance, covariance, rtol=1e-9)
    assert np.abs((found.x - mean) / np.sqrt(np.diag(covariance))).max() < 0.03


def test_values_that_are_not_free_stay_and_count_as_known() -> None:
    free = np.array([True, False, True, True])
    found = fit(Gaussian(), np.zeros(4), PRIOR, free=free)
    mean, covariance = posterior(np.flatnonzero(free))
    assert found.x[1] == 0.0 and not found.covariance[1].any() and not found.covariance[:, 1].any()
    np.testing.assert_allclose(found.covariance[np.ix_(free, free)], covariance, rtol=1e-9)
    assert np.abs((found.x[free] - mean) / np.sqrt(np.diag(covariance))).max() < 0.03


@pytest.mark.parametrize("start", [-6.0, 5.0])
def test_a_far_start_is_left_in_bounded_steps(start: float) -> None:
    likelihood = Rate(100)
    found = fit(likelihood, np.array([start]), Prior(np.zeros(1), np.full(1, 1e3)))
    assert found.converged and found.x[0] == pytest.approx(0.0, abs=0.03 / np.sqrt(100))
    assert np.abs(np.diff(likelihood.points[1:])).max() <= STEP_LIMIT * (1 + 1e-9)


def test_a_step_to_where_there_is_no_likelihood_is_shortened() -> None:
    found = fit(Rate(100, wall=0.01), np.array([-2.0]), Prior(np.zeros(1), np.full(1, 1e3)))
    assert found.x[0] == pytest.approx(0.0, abs=0.02)


def test_a_start_at_the_most_probable_point_ends_there() -> None:
    found = fit(Rate(100), np.zeros(1), Prior(np.zeros(1), np.full(1, 1e3)))
    assert found.converged and found.x[0] == 0.0


def test_what_has_not_converged_within_its_iterations_says_so() -> None:
    assert not fit(Rate(100), np.array([-6.0]), Prior(np.zeros(1), np.ones(1)), limit=2).converged

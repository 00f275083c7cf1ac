"""Maximum likelihood: recovery, uncertainty, sensitivities against finite differences."""

import numpy as np

from sprung.model.diagnosis.fit.jacobian import linearise
from sprung.model.diagnosis.fit.optimise import optimise
from sprung.model.diagnosis.fit.smoothing import Working
from sprung.model.diagnosis.response.point import Point
from sprung.model.diagnosis.response.terms import Term
from sprung.model.laws import find_law
from tests.diagnosis_cases import problem_of, simulate, true_log_ratios


def test_parameters_come_back_within_their_uncertainty() -> None:
    problem = problem_of(simulate(seed=1))
    fit = optimise(problem, Point(np.zeros(4), (), np.zeros(4)))
    z = (fit.point.theta - true_log_ratios(problem.system)) / np.sqrt(np.diag(fit.covariance))
    assert fit.converged
    assert np.abs(z).max() < 4
    assert 0.9 < fit.reduced < 1.1


def test_sensitivities_agree_with_finite_differences() -> None:
    problem = problem_of(simulate(lambda d, v: 4e9 * d**3, seed=2, seconds=12))
    law = find_law("cubic_stiffness")
    term = Term(law, "secondary", (4e9,), scales=(4e9,))
    start = Point(true_log_ratios(problem.system), (term,), np.zeros(4))
    fit = optimise(problem, start, iterations=4)
    point = fit.point
    working = Working(fit.whitener)
    here = linearise(problem, point, working)
    free, _ = np.linalg.qr(here.jacobian[:, -4:])
    for i in range(4):
        move = np.zeros(4)
        move[i] = 1e-4
        up = linearise(problem, Point(point.theta + move, point.terms, point.state), working).residual
        down = linearise(problem, Point(point.theta - move, point.terms, point.state), working).residual
        expected = -(up - down) / 2e-4
        error = here.jacobian[:, i] - expected
        error -= free @ (free.T @ error)  # the ends of the part move as a free motion, which is fitted anyway
        assert np.linalg.norm(error) < 0.03 * np.linalg.norm(expected)


def test_law_with_true_values_explains_a_recording_that_the_linear_model_cannot() -> None:
    problem = problem_of(simulate(lambda d, v: 4e9 * d**3, seed=3))
    plain = optimise(problem, Point(np.zeros(4), (), np.zeros(4)))
    term = Term(find_law("cubic_stiffness"), "secondary", (3e9,), scales=(3e9,))
    fit = optimise(problem, Point(plain.point.theta, (term,), plain.point.state), whitener=plain.whitener)
    value, sigma = fit.point.terms[0].parameters[0], np.sqrt(fit.covariance[-1, -1])
    assert plain.reduced > 2
    assert fit.reduced < 1.1
    assert abs(value - 4e9) < 4 * sigma

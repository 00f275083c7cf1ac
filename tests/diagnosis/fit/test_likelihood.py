"""Maximum likelihood: recovery, uncertainty, sensitivities against finite differences."""

from dataclasses import replace

import numpy as np
import pytest

from sprung.model.diagnosis.fit.jacobian import linearise
from sprung.model.diagnosis.fit.optimise import optimise
from sprung.model.diagnosis.fit.problem import Problem
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
    term = Term(find_law("cubic_stiffness"), "secondary", (4e9,), scales=(4e9,))
    assert max(_errors(problem, term)) < 0.03


def test_a_valve_changes_with_the_damper_that_it_belongs_to() -> None:
    problem = problem_of(simulate(seed=2, seconds=12))
    term = Term(find_law("damper_blowoff"), "secondary", (0.02, 0.2), scales=(0.02, 0.2))
    assert max(_errors(problem, term)) < 0.1
    assert max(_errors(problem, term, fine=True)) < 0.01


@pytest.mark.slow
def test_the_reaction_of_a_stop_takes_the_oversampled_axis() -> None:
    problem = problem_of(simulate(seed=2, seconds=12))
    term = Term(find_law("bump_stop"), "secondary", (1e-3, 1e7), scales=(1e-3, 1e7))
    coarse, fine = max(_errors(problem, term)), max(_errors(problem, term, fine=True))
    assert coarse > 0.3
    assert fine < 0.03


def _errors(problem: Problem, term: Term, *, fine: bool = False) -> list[float]:
    """Relative errors of the columns of theta against central finite differences, beside a law."""
    start = Point(true_log_ratios(problem.system), (term,), np.zeros(4))
    fit = optimise(problem, start, iterations=5)
    same = replace(fit.point.terms[0], parameters=term.parameters)  # beside the equivalent that was fitted
    point, working, step = replace(fit.point, terms=(same,)), Working(fit.whitener), 1e-4
    here = linearise(problem, point, working, fine=fine)
    free, _ = np.linalg.qr(here.jacobian[:, -4:])
    errors = []
    for i in range(4):
        move = step * np.eye(4)[i]
        moved = (replace(point, theta=point.theta + sign * move, warm_start=()) for sign in (1, -1))
        up, down = (linearise(problem, other, working).residual for other in moved)
        expected = -(up - down) / (2 * step)
        error = here.jacobian[:, i] - expected
        error -= free @ (free.T @ error)  # the ends of the part move as a free motion, which is fitted anyway
        errors.append(float(np.linalg.norm(error) / np.linalg.norm(expected)))
    return errors


def test_law_with_true_values_explains_a_recording_that_the_linear_model_cannot() -> None:
    problem = problem_of(simulate(lambda d, v: 4e9 * d**3, seed=3))
    plain = optimise(problem, Point(np.zeros(4), (), np.zeros(4)))
    term = Term(find_law("cubic_stiffness"), "secondary", (3e9,), scales=(3e9,))
    fit = optimise(problem, Point(plain.point.theta, (term,), plain.point.state), whitener=plain.whitener)
    value, sigma = fit.point.terms[0].parameters[0], np.sqrt(fit.covariance[-1, -1])
    assert plain.reduced > 2
    assert fit.reduced < 1.1
    assert abs(value - 4e9) < 4 * sigma

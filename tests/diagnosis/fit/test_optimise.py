"""The optimiser: never uphill, and breakage told from divergence."""

from dataclasses import replace
from typing import Any, NoReturn

import numpy as np
import pytest

from sprung.model.diagnosis.fit import optimise as optimiser
from sprung.model.diagnosis.fit import steps
from sprung.model.diagnosis.fit.baseline import baseline
from sprung.model.diagnosis.fit.optimise import Fit, optimise, try_optimise
from sprung.model.diagnosis.fit.problem import Problem
from sprung.model.diagnosis.fit.smoothing import Working, smoothed
from sprung.model.diagnosis.record.channels import DiagnosisError, prepare
from sprung.model.diagnosis.record.signals import declared_noise
from sprung.model.diagnosis.response.point import Point
from sprung.model.diagnosis.response.terms import Term
from sprung.model.laws import find_law
from tests.diagnosis_cases import Force, quarter_car, simulate


@pytest.fixture(scope="module")
def clean() -> tuple[Problem, Fit]:
    system = quarter_car()
    signals = prepare(system, simulate(seconds=12, seed=2).values, 100.0).signals
    return baseline(system, signals, declared_noise(system, signals), 700)


@pytest.fixture
def seen(monkeypatch: pytest.MonkeyPatch) -> list[steps.SearchState]:
    """All points that fits evaluate."""
    states, whole = [], steps.state_at

    def recorded(*args: Any, **kwargs: Any) -> steps.SearchState:
        states.append(whole(*args, **kwargs))
        return states[-1]

    for module in (steps, optimiser):
        monkeypatch.setattr(module, "state_at", recorded)
    return states


@pytest.mark.parametrize("factor", [1.05, 1.5, 4.0])
def test_a_fit_is_never_worse_than_any_point_that_it_saw(
    clean: tuple[Problem, Fit], factor: float, seen: list[steps.SearchState]
) -> None:
    problem, fit = clean
    again = optimise(problem, replace(fit.point, theta=fit.point.theta + np.log(factor)), whitener=fit.whitener)
    objective = again.deviance + float(np.sum(again.point.theta**2))
    # all points but the first, which was weighed before inputs were smoothed
    assert objective <= min(state.value for state in seen[1:]) + 0.5
    assert again.converged
    assert again.chi_square == pytest.approx(fit.chi_square, abs=0.5)


def bump_stop(d: float, v: float) -> float:
    return 6e5 * (max(d - 4e-3, 0.0) + min(d + 4e-3, 0.0))


def friction(d: float, v: float) -> float:
    return 400.0 * float(np.tanh(v / 5e-3))


@pytest.mark.parametrize(
    ("force", "law", "start"), [(bump_stop, "bump_stop", (5e-3, 3e5)), (friction, "coulomb_friction", (250.0, 8e-3))]
)
def test_a_fit_of_a_law_converges_and_is_no_worse_than_any_point_that_it_saw_under_its_inputs(
    force: Force, law: str, start: tuple[float, float], seen: list[steps.SearchState]
) -> None:
    system = quarter_car()
    signals = prepare(system, simulate(force, seconds=12, seed=3).values, 100.0).signals
    problem, base = baseline(system, signals, declared_noise(system, signals), 1000)
    term = Term(find_law(law), "secondary", start, scales=start)
    fit = optimise(problem, Point(base.point.theta, (term,), base.point.state))
    assert fit.converged and fit.iterations <= 10
    _, working = smoothed(problem, fit.point, Working(fit.whitener), fit.whitener.whitened(fit.spectrum, problem.part))
    last = steps.state_at(problem, fit.point, working).value
    points = [one.point for one in seen if len(one.point.terms) == 1]
    assert len(points) > fit.iterations
    assert last <= min(steps.state_at(problem, point, working).value for point in points) + 0.5


@pytest.mark.parametrize("overshoot", [1.8, 0.6])
def test_steps_that_miss_by_a_constant_ratio_are_relaxed_to_the_root(overshoot: float) -> None:
    error, relaxation = np.array([1.0, -2.0, 0.5]), steps.StepRelaxation()
    for _ in range(3):
        step = -overshoot * error
        relaxation = relaxation.after(step)
        error = error + relaxation.factor * step
    assert relaxation.factor == pytest.approx(1 / overshoot)
    assert np.abs(error).max() < 1e-12


def test_steps_in_other_directions_are_taken_whole() -> None:
    relaxation = steps.StepRelaxation().after(np.array([1.0, 0.0])).after(np.array([0.5, 0.6]))
    assert relaxation.factor == 1.0


def test_a_fit_from_its_own_solution_stays_there(clean: tuple[Problem, Fit]) -> None:
    problem, fit = clean
    again = optimise(problem, fit.point, whitener=fit.whitener)
    assert again.converged
    assert np.abs((again.point.theta - fit.point.theta) / np.sqrt(np.diag(fit.covariance))).max() < 0.1


def test_errors_of_the_program_are_no_divergence(clean: tuple[Problem, Fit]) -> None:
    problem, fit = clean
    broken = Term(find_law("cubic_stiffness"), "secondary", (1e9, 2.0), scales=(1e9, 1.0))  # one parameter too many
    with pytest.raises(ValueError):
        try_optimise(problem, Point(fit.point.theta, (broken,), fit.point.state), 3)


def test_divergence_from_the_start_is_reported_in_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    def singular(*args: object, **kwargs: object) -> NoReturn:
        raise np.linalg.LinAlgError("Matrix is not positive definite")

    monkeypatch.setattr("sprung.model.diagnosis.fit.baseline.optimise", singular)
    system = quarter_car()
    signals = prepare(system, simulate(seconds=12).values, 100.0).signals
    with pytest.raises(DiagnosisError, match="estimates diverge; check units"):
        baseline(system, signals, declared_noise(system, signals), 700)


def test_a_long_step_of_a_law_keeps_its_direction() -> None:
    """A loop's exponent and the logarithm of its beta move along a valley: one of them cut short leaves it."""
    loop = Term(find_law("bouc_wen"), "secondary", (5e5, 3e4, 2.0), scales=(1e5, 1e4, 1.0))
    short, long = (loop.advanced(np.array([1e3, -2.6, -0.46]) * share) for share in (0.1, 1.0))
    changes = [
        (moved.parameters[0] - 5e5, np.log(moved.parameters[1] / 3e4), moved.parameters[2] - 2.0)
        for moved in (short, long)
    ]
    assert changes[1][1] == pytest.approx(-1.0)
    np.testing.assert_allclose(np.array(changes[1]) / changes[1][1], np.array(changes[0]) / changes[0][1])


def test_a_fit_that_goes_on_from_an_optimum_ends_at_once_as_converged() -> None:
    """Steps promise what smoothing the inputs anew takes back; from raw inputs the first one falls by that much."""
    system = quarter_car()
    signals = prepare(system, simulate(friction, seconds=12, seed=3).values, 100.0).signals
    problem, base = baseline(system, signals, declared_noise(system, signals), 1000)
    term = Term(find_law("coulomb_friction"), "secondary", (400.0, 5e-3), scales=(400.0, 5e-3))
    fit = optimise(problem, Point(base.point.theta, (term,), base.point.state))
    again = optimise(problem, fit.point)
    assert again.converged and again.iterations <= 3
    assert again.chi_square == pytest.approx(fit.chi_square, abs=1.0)

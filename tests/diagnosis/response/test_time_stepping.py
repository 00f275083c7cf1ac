"""Forces marched in time against those of the whole trajectory."""

from dataclasses import replace

import numpy as np
import pytest

from sprung.model.diagnosis.response.point import Point
from sprung.model.diagnosis.response.terms import Term
from sprung.model.diagnosis.response.time_stepping import march_from_rest
from sprung.model.laws import find_law
from tests.diagnosis_cases import problem_of, quarter_car, simulate, true_log_ratios


@pytest.mark.parametrize(
    ("law", "values", "settles"), [("coulomb_friction", (300.0, 0.01), True), ("bump_stop", (5e-3, 3e6), False)]
)
def test_forces_marched_in_time_are_those_of_the_whole_trajectory(
    law: str, values: tuple[float, ...], settles: bool
) -> None:
    """Steps in time lead to the forces of the iteration, also where that does not settle from its own start."""
    problem = problem_of(simulate(seed=6))
    point = Point(true_log_ratios(quarter_car()), (Term(find_law(law), "secondary", values),), np.zeros(4))
    forward = problem.forward(point)
    alone = replace(forward, newton_allowed=False).law_forces(point.state)
    assert alone is not None and alone.converged is settles
    marched, rest = march_from_rest(forward, point.state)
    led = replace(forward, warm_start=tuple(marched.T)).law_forces(point.state - rest)
    assert led is not None and led.converged
    difference = marched - led.force
    assert np.std(difference) < 0.02 * np.std(led.force)


def test_filters_of_sensors_leave_the_forces_as_they_are() -> None:
    """They have states of their own, in which nothing that moves takes part."""
    problem = problem_of(simulate(seed=6))
    law = Term(find_law("bump_stop"), "secondary", (5e-3, 3e6))
    behind = Term(find_law("high_pass"), "car_a|bogie_a", (0.1,))
    bare, filtered = (
        problem.forward(Point(true_log_ratios(quarter_car()), terms, np.zeros(states)))
        for terms, states in (((law,), 4), ((law, behind), 6))
    )
    force, rest = march_from_rest(bare, np.zeros(4))
    other, beside = march_from_rest(filtered, np.zeros(6))
    np.testing.assert_allclose(other, force, atol=1e-6 * float(np.std(force)))
    np.testing.assert_allclose(beside, [*rest, 0.0, 0.0], atol=1e-9)
    known, found = bare.law_forces(np.zeros(4)), filtered.law_forces(np.zeros(6))
    assert known is not None and found is not None
    np.testing.assert_allclose(found.force, known.force, atol=1e-3 * float(np.std(known.force)))

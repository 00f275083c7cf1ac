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

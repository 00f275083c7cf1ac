"""Laws and the motion that they shape: a fixed point, and in the limit of a weak law its first order."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sprung.model.diagnosis.response.harmonic_balance import LawForces, warm_start_of
from sprung.model.diagnosis.response.point import Point
from sprung.model.diagnosis.response.terms import Term
from sprung.model.laws import find_law
from tests.diagnosis_cases import problem_of, simulate

PROBLEM = problem_of(simulate(seconds=8.0))


def solved(k3: float, warm: bool = False) -> LawForces:
    term = Term(find_law("cubic_stiffness"), "secondary", (k3,), scales=(1e9,))
    point = Point(np.zeros(len(PROBLEM.system.parameters)), (term,), np.zeros(0))
    point = replace(point, state=np.zeros(PROBLEM.forward(point).plant.structure.states))
    if warm:
        forces = PROBLEM.forward(point).law_forces(point.state)
        point = replace(point, warm_start=warm_start_of(forces))
    forces = PROBLEM.forward(point).law_forces(point.state)
    assert forces is not None
    return forces


@pytest.mark.parametrize("k3", [1e8, 4e9])
def test_forces_are_the_laws_along_the_motion_that_they_shape(k3: float) -> None:
    forces = solved(k3)
    assert forces.converged
    expected = k3 * forces.deflection[:, 0] ** 3
    np.testing.assert_allclose(forces.force[:, 0], expected, atol=2e-5 * np.max(np.abs(expected)))


def test_a_stop_that_is_hit_all_the_time_is_solved_by_newtons_steps() -> None:
    stop = Term(find_law("bump_stop"), "secondary", (2e-3, 1.45e6), scales=(1e-3, 5e5))
    point = Point(np.zeros(len(PROBLEM.system.parameters)), (stop,), np.zeros(4))
    forward = PROBLEM.forward(point)
    balance = forward.harmonic_balance(point.state)
    hasty = replace(forward, newton_allowed=False).law_forces(point.state)
    assert hasty is not None and not hasty.converged
    forces = forward.law_forces(point.state)
    assert balance is not None and forces is not None and forces.converged
    expected = balance.law_forces(forces.deflection, forces.rate)
    np.testing.assert_allclose(forces.force, expected, atol=1e-4 * np.max(np.abs(expected)))


def test_the_answer_to_a_weak_law_grows_with_it() -> None:
    weak, double = solved(1e6), solved(2e6)
    np.testing.assert_allclose(double.sensors, 2 * weak.sensors, atol=1e-3 * np.max(np.abs(weak.sensors)))


def test_a_warm_start_leads_to_the_same_solution() -> None:
    cold, warm = solved(4e9), solved(4e9, warm=True)
    np.testing.assert_allclose(warm.force, cold.force, atol=1e-4 * np.max(np.abs(cold.force)))

"""Laws along a motion whose inputs are smoothed, and what finding it counts as."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sprung.model.diagnosis.fit.jacobian import linearise
from sprung.model.diagnosis.fit.problem import Problem, law_forces
from sprung.model.diagnosis.fit.smoothing import along_measured_motion
from sprung.model.diagnosis.fit.tangent import tangent
from sprung.model.diagnosis.record.channels import prepare
from sprung.model.diagnosis.record.signals import declared_noise, transform
from sprung.model.diagnosis.response.point import Point
from sprung.model.diagnosis.response.terms import Term
from sprung.model.laws import find_law
from sprung.model.signals import FloatArray
from sprung.model.system import parse_system
from sprung.model.work import WorkBudget

HELD = """
name: two masses
sample_rate: 200
window: 200
bodies: {low: {mass: 20.0}, high: {mass: 5.0}}
inputs:
  table: {kind: displacement, displacement: {csv: z, noise: 1.0e-4}}
  shaker: {kind: force, body: high, csv: f, noise: 2.0}
elements:
  foot: {upper: low, lower: table, stiffness: 5.0e4, damping: 60.0}
  link: {upper: high, lower: low, stiffness: 2.0e4, damping: 20.0}
sensors:
  a_low: {kind: acceleration, body: low, csv: a0, noise: 0.02}
  a_high: {kind: acceleration, body: high, csv: a1, noise: 0.02}
"""
FREE = """
name: two masses that nothing holds
sample_rate: 200
window: 200
bodies: {low: {mass: 20.0}, high: {mass: 5.0}}
inputs:
  shaker: {kind: force, body: high, csv: f, noise: 2.0}
elements:
  link: {upper: high, lower: low, stiffness: 2.0e4, damping: 20.0}
sensors:
  x_low: {kind: displacement, body: low, csv: x0, noise: 1.0e-5}
  a_high: {kind: acceleration, body: high, csv: a1, noise: 0.02}
"""


def problem_of(text: str, work: WorkBudget | None = None) -> tuple[Problem, Point]:
    """A stop along random signals that no model made: forces, state and inputs are far from those as measured."""
    system, rng = parse_system(text), np.random.default_rng(3)
    sizes = {"table.displacement": 1e-3, "shaker": 20.0, "a_low": 1.0, "a_high": 3.0, "x_low": 1e-3}
    values: FloatArray = np.column_stack([sizes[c.name] * rng.standard_normal(400) for c in system.channels])
    signals = prepare(system, values, 200.0).signals
    noise = declared_noise(system, signals)
    problem = Problem(system, transform(signals, noise), signals.sensor_index, noise, work=work)
    term = Term(find_law("bump_stop"), "link", (1e-3, 2e3), scales=(1e-3, 2e3))
    theta = np.full(len(system.parameters), 0.1)
    states = len(problem.forward(Point(theta, (term,), np.zeros(0))).plant.structure.state_matrix())
    return problem, Point(theta, (term,), np.zeros(states))


@pytest.mark.parametrize("text", [HELD, FREE])
def test_forces_of_laws_are_those_along_the_motion_under_the_smoothed_inputs(text: str) -> None:
    problem, start = problem_of(text)
    point, working = along_measured_motion(problem, start)
    assert working.inputs is not None and working.inputs.force is not None
    balance = problem.forward(point, working.inputs).harmonic_balance(point.state)
    assert balance is not None
    force = working.inputs.force
    expected = balance.law_forces(*balance.motion(force))
    assert np.abs(force).max() > 0.1
    assert np.linalg.norm(force - expected) < 1e-3 * np.linalg.norm(force)
    assert working.inputs.settled


def test_forces_that_do_not_agree_with_the_motion_are_said_not_to() -> None:
    """A stop a hundred times as stiff as the link is in contact here and there: the iteration ends without a motion."""
    problem, start = problem_of(HELD)
    hard = replace(start, terms=(start.terms[0].at(np.array([2e-4, 2e6])),))
    point, working = along_measured_motion(problem, hard)
    assert working.inputs is not None and not working.inputs.settled
    forces = law_forces(problem.forward(point, working.inputs), point, working.inputs)
    assert forces is not None and not forces.converged


def test_smoothing_and_sensitivities_count_as_work() -> None:
    """Else a search whose models need many rounds would take many times as long as its budget says."""
    work = WorkBudget()
    problem, start = problem_of(HELD, work)
    point, working = along_measured_motion(problem, start)
    smoothed = work.done
    lin = linearise(problem, point, working)
    linearised = work.done
    assert lin.jacobian.size > 0
    assert 0 < smoothed < linearised < work.done


def test_the_reaction_of_laws_to_a_motion_beyond_the_range_of_numbers_is_none() -> None:
    """Starts of candidates may be that far off: they are dropped, and the diagnosis goes on."""
    problem, start = problem_of(HELD)
    point, working = along_measured_motion(problem, start)
    lin = linearise(problem, replace(point, state=1e60 * np.ones_like(point.state)), working)
    assert lin.forces is not None
    motions = np.full((2, 400, 1, 3), 1e60)
    with np.errstate(all="ignore"):
        found, _ = tangent(lin.forward, lin.forces, motions, None)
    assert not np.isfinite(found).any()

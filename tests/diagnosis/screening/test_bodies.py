"""Candidates at bodies: another mass, a periodic force, an elastic mode, found with the values that were put in."""

from __future__ import annotations

import numpy as np
import pytest

from sprung.benchmarks.sensitivity_cases import QUARTER_CAR
from sprung.model.diagnosis.fit.optimise import Fit, optimise
from sprung.model.diagnosis.fit.problem import Problem
from sprung.model.diagnosis.response.point import Point
from sprung.model.diagnosis.screening.bodies import body_candidates
from sprung.model.diagnosis.screening.families import LINE, MASS
from sprung.model.diagnosis.screening.score import Candidate, Projector
from sprung.model.laws import CATALOGUE, CLOCK_LEAD, BodyLaw
from sprung.model.system import parse_system
from tests.diagnosis_cases import problem_of, simulate

LAWS = tuple(law for law in CATALOGUE if isinstance(law, BodyLaw))


def fitted(problem: Problem) -> Fit:
    return optimise(problem, Point(np.zeros(4), (), np.zeros(4)))


def line(projector: Projector) -> Candidate:
    """The periodic force with the highest score."""
    return max((one for one, _ in body_candidates(projector, LAWS) if one.family is LINE), key=lambda one: one.score)


def masses(problem: Problem) -> dict[str, Candidate]:
    found = (one for one, _ in body_candidates(Projector(problem, fitted(problem)), LAWS))
    return {one.location: one for one in found if one.family is MASS}


@pytest.mark.parametrize(("car", "bogie"), [(7500, 1300), (7000, 1300), (8000, 1200)])
def test_a_mass_that_the_file_has_wrong_is_read_up_to_a_common_factor(car: float, bogie: float) -> None:
    """No force is measured, so that a heavier car and a lighter bogie are the same recording; to first order."""
    text = QUARTER_CAR.replace("mass: 8000", f"mass: {car}").replace("mass: 1300", f"mass: {bogie}")
    found = masses(problem_of(simulate(seed=5), parse_system(text)))
    ratio = (8000 / car) / (1300 / bogie)
    assert found["car"].score == pytest.approx(found["bogie"].score) and found["car"].score > 1000.0
    assert found["car"].term.parameters[0] == pytest.approx(ratio, abs=(ratio - 1) ** 2)
    assert found["bogie"].term.parameters[0] == pytest.approx(1 / ratio, abs=(ratio - 1) ** 2)


def test_no_mass_is_suspicious_where_all_are_as_stated() -> None:
    assert all(one.score < 20.0 for one in masses(problem_of(simulate(seed=6))).values())


@pytest.mark.parametrize("frequency", [6.35, 11.0])
def test_a_periodic_force_is_found_with_frequency_size_and_phase(frequency: float) -> None:
    """Added to the residual by the response to it: 40 N on the car."""
    problem = problem_of(simulate(seed=7))
    projector = Projector(problem, fitted(problem))
    grid = projector.grid
    time = grid.start + grid.time + CLOCK_LEAD
    force = grid.forward(40.0 * np.sin(2 * np.pi * frequency * time + 0.6)[:, None])[grid.band, 0]
    at = problem.system.mechanics.dofs.index("car.z")
    column = projector.pack(projector.of_load[:, :, at] * force[:, None])
    projector.residual = projector.residual + column - projector.q @ (projector.q.T @ column)
    found = line(projector)
    amplitude, hertz, phase = found.term.parameters
    assert (found.location, found.term.variant) == ("car", "z")
    assert hertz == pytest.approx(frequency, abs=0.02 / grid.length * 5)
    assert amplitude == pytest.approx(40.0, rel=0.05) and phase == pytest.approx(0.6, abs=0.3)

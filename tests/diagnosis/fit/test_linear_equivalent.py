"""The equivalent stiffness and damping of laws along a sine are their describing functions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sprung.model.diagnosis.fit.linear_equivalent import _equivalent, with_equivalents
from sprung.model.diagnosis.response.harmonic_balance import LawForces
from sprung.model.diagnosis.response.point import Point
from sprung.model.diagnosis.response.terms import Term
from sprung.model.laws import find_law
from tests.diagnosis_cases import problem_of, simulate

PROBLEM = problem_of(simulate(seconds=8.0))
SIZE, OMEGA = 4e-3, 2 * np.pi * 1.25  # m, rad/s: ten periods in 8 s


def along_a_sine(term: Term) -> tuple[float, float]:
    point = Point(np.zeros(len(PROBLEM.system.parameters)), (term,), np.zeros(0))
    point = replace(point, state=np.zeros(PROBLEM.forward(point).plant.structure.states))
    forward = PROBLEM.forward(point)
    time = forward.part.grid.fine_time
    d, v = SIZE * np.sin(OMEGA * time)[:, None], SIZE * OMEGA * np.cos(OMEGA * time)[:, None]
    none = np.zeros((1, 1), dtype=complex)
    port = term.port(PROBLEM.system)[None]
    forces = LawForces([term], port, d, v, np.zeros_like(d), True, none, none, none, np.zeros((1, 1)), np.zeros((1, 1)))
    return _equivalent(forward, forces, term)


def test_a_cubic_spring_has_three_quarters_of_its_largest_slope() -> None:
    k, c = along_a_sine(Term(find_law("cubic_stiffness"), "secondary", (2e9,), scales=(1e9,)))
    assert k == pytest.approx(0.75 * 2e9 * SIZE**2, rel=0.01)
    assert abs(c) * OMEGA < 0.01 * k  # the record does not hold a whole number of periods


def test_dry_friction_damps_as_its_describing_function_says() -> None:
    force = 300.0
    k, c = along_a_sine(Term(find_law("coulomb_friction"), "secondary", (force, 1e-5), scales=(300.0, 1e-5)))
    assert c == pytest.approx(4 * force / (np.pi * SIZE * OMEGA), rel=0.02)
    assert abs(k) * SIZE < 0.02 * force


def test_a_model_without_such_laws_stays_as_it_is() -> None:
    point = Point(np.zeros(len(PROBLEM.system.parameters)), (), np.zeros(4))
    assert with_equivalents(PROBLEM, point, None) is point

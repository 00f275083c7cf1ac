"""The whole motion of a solution: its rates are the derivatives of its deflections, its start is where it starts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sprung.model.diagnosis.fit.problem import Problem
from sprung.model.diagnosis.response.forward import Forward
from sprung.model.diagnosis.response.motion import motions_of, particular_start
from sprung.model.diagnosis.response.point import Point
from sprung.model.diagnosis.response.terms import Term
from sprung.model.laws import find_law
from tests.diagnosis_cases import problem_of, simulate

CUBIC = Term(find_law("cubic_stiffness"), "secondary", (2e9,), scales=(1e9,))


def solution(*terms: Term) -> tuple[Problem, Point, Forward]:
    problem = problem_of(simulate(seconds=8.0))
    point = Point(np.zeros(len(problem.system.parameters)), terms, np.zeros(0))
    states = problem.forward(point).plant.structure.states
    state = 1e-3 * np.random.default_rng(3).standard_normal(states)
    point = replace(point, state=state)
    return problem, point, problem.forward(point)


def test_rates_are_the_derivatives_of_deflections() -> None:
    for terms in ((), (CUBIC,)):
        _, point, forward = solution(*terms)
        forces = forward.law_forces(point.state)
        motions, grid = motions_of(forward, forces, point.state), forward.part.grid
        d, v = grid.inverse(motions.deflection), grid.inverse(motions.rate)
        centred = (d[2:] - d[:-2]) / (2 * grid.step)
        inner = slice(20, -20)
        error = np.std(centred[inner] - v[1:-1][inner], axis=0) / np.std(v, axis=0)
        assert np.all(error < 0.2), error  # central differences of up to 18 Hz at 100 Hz
        smooth = np.convolve(centred[:, 1], np.ones(9) / 9, "valid"), np.convolve(v[1:-1, 1], np.ones(9) / 9, "valid")
        assert np.std(smooth[0] - smooth[1]) < 0.02 * np.std(smooth[1])


def test_the_start_of_the_whole_motion_is_the_particular_one_and_the_free_state() -> None:
    _, point, forward = solution()
    motions, grid = motions_of(forward, None, point.state), forward.part.grid
    start = particular_start(forward, None) + point.state
    H = forward.plant.structure.H
    support = forward.part.support_polynomial[0] + grid.inverse(forward.part.support)[0]
    expected = H @ start[: H.shape[1]] + forward.plant.structure.G @ support
    np.testing.assert_allclose(grid.inverse(motions.deflection)[0], expected, rtol=1e-6, atol=1e-9)

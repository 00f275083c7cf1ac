"""Fits that are remembered are the ones that would be made, and another start or noise is another fit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sprung.model.diagnosis.fit.memory import FitMemory, key_of
from sprung.model.diagnosis.fit.optimise import optimise
from sprung.model.diagnosis.fit.problem import Problem
from sprung.model.diagnosis.response.point import Point
from sprung.model.diagnosis.screening.screen import screen
from sprung.model.diagnosis.selection.starts import joint_start
from sprung.model.laws import CATALOGUE
from tests.diagnosis_cases import problem_of, simulate


def start_of(problem: Problem) -> Point:
    point = Point(np.zeros(len(problem.system.parameters)), (), np.zeros(0))
    return replace(point, state=np.zeros(problem.forward(point).plant.structure.states))


def test_a_fit_is_made_once() -> None:
    problem = problem_of(simulate(seconds=8.0))
    memory: FitMemory = FitMemory()
    known = replace(problem, memory=memory)
    first = optimise(known, start_of(problem), iterations=2)
    assert optimise(known, start_of(problem), iterations=2) is first
    plain = optimise(problem, start_of(problem), iterations=2)
    np.testing.assert_array_equal(first.point.theta, plain.point.theta)
    assert optimise(known, start_of(problem), iterations=1) is not first


def test_what_goes_into_a_fit_is_in_its_key() -> None:
    problem = problem_of(simulate(seconds=8.0))
    start = start_of(problem)
    moved = replace(start, theta=start.theta + 1e-9)
    louder = replace(problem.noise, sensors=1.001 * problem.noise.sensors)
    keys = {
        key_of(problem.system, problem.part, problem.noise, start, 3),
        key_of(problem.system, problem.part, problem.noise, start, 4),
        key_of(problem.system, problem.part, problem.noise, moved, 3),
        key_of(problem.system, problem.part, louder, start, 3),
        key_of(problem.system, problem.part, problem.noise, start, 3, np.ones(2)),
    }
    assert len(keys) == 5


def test_starts_of_sensors_faults_are_remembered_too() -> None:
    record = simulate(seconds=8.0)
    record.values[:, 4] *= 0.9
    problem = replace(problem_of(record), memory=FitMemory())
    base = optimise(problem, start_of(problem), iterations=3)
    found = screen(problem, base, CATALOGUE)
    assert screen(problem, base, CATALOGUE) is found
    gain = next(hit for hit in found.candidates if hit.effect == "sensor_gain")
    first = joint_start(problem, base, gain)
    assert joint_start(problem, base, gain) is first

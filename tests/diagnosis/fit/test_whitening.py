"""Weights of residuals: white for the noise they are made for."""

import numpy as np
import pytest

from sprung.model.diagnosis.fit.problem import Problem
from sprung.model.diagnosis.fit.whitening import Whitener
from sprung.model.diagnosis.response.forward import Forward
from sprung.model.diagnosis.response.point import Point
from tests.diagnosis_cases import problem_of, simulate


@pytest.fixture(scope="module")
def weighed() -> tuple[Problem, Forward, Whitener]:
    problem = problem_of(simulate(seconds=12, seed=3))
    forward = problem.forward(Point(np.zeros(4), (), np.zeros(4)))
    return problem, forward, Whitener.of(forward, problem.noise)


def test_noise_of_sensors_and_inputs_comes_out_white(weighed: tuple[Problem, Forward, Whitener]) -> None:
    problem, forward, whitener = weighed
    rng, grid = np.random.default_rng(0), problem.part.grid
    variance = problem.noise.support_variance(grid.omega)
    shape = (len(grid.omega), 1)
    numbers = []
    for _ in range(40):
        inputs = np.sqrt(variance / 2) * (rng.standard_normal(shape) + 1j * rng.standard_normal(shape))
        own = rng.standard_normal((*shape[:1], 4)) + 1j * rng.standard_normal((*shape[:1], 4))
        residual = np.einsum("fsi,fi->fs", forward.of_inputs, inputs) + problem.noise.sensors * own / np.sqrt(2)
        numbers.append(whitener(residual, problem.part).reshape(2, -1, 4)[:, 1:])
    covariance = np.cov(np.concatenate(numbers, axis=1).reshape(-1, 4).T)
    np.testing.assert_allclose(covariance, np.eye(4), atol=0.03)


def test_slope_of_the_determinant_agrees_with_a_finite_difference(weighed: tuple[Problem, Forward, Whitener]) -> None:
    problem, forward, whitener = weighed
    step = 1e-6
    moved = problem.forward(Point(np.array([0.0, 0.0, step, 0.0]), (), np.zeros(4)))
    change = ((moved.of_inputs - forward.of_inputs) / step)[problem.part.grid.band]
    expected = (Whitener.of(moved, problem.noise).log_det - whitener.log_det) / step
    assert whitener.log_det_slope(change) == pytest.approx(expected, rel=1e-4)


def test_a_plant_nearby_is_taken_where_the_structure_is_the_same(weighed: tuple[Problem, Forward, Whitener]) -> None:
    problem, forward, _ = weighed
    same, other = (Point(np.array([0.0, 0.0, step, 0.0]), (), np.zeros(4)) for step in (0.0, 1e-9))
    assert problem.forward(same, known=forward.plant).plant is forward.plant
    assert problem.forward(other, known=forward.plant).plant is not forward.plant


def test_transforms_of_the_free_motion_are_those_of_its_samples(weighed: tuple[Problem, Forward, Whitener]) -> None:
    problem, forward, _ = weighed
    sampled = problem.part.grid.forward(forward.free_rows())
    np.testing.assert_allclose(problem.free_columns(forward), sampled, atol=1e-9 * np.abs(sampled).max())

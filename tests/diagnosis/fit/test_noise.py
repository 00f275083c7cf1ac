"""Noise levels of inputs that are measured twice."""

import numpy as np
import pytest

from sprung.model.diagnosis.fit.noise import input_noise
from tests.diagnosis_cases import problem_of, simulate


def test_input_noise_is_estimated_from_the_second_measurement() -> None:
    record = simulate(seed=4)
    rng = np.random.default_rng(5)
    record.values[:, 1] += 1e-3 * rng.standard_normal(len(record.values))
    problem = problem_of(record)
    noise = input_noise(problem.part, problem.noise)
    assert noise.displacement[0] == pytest.approx(1e-5, rel=0.1)
    assert noise.velocity[0] == pytest.approx(np.hypot(5e-4, 1e-3), rel=0.1)

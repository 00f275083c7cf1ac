"""Faults of input channels, told by what measures the same support a second time."""

import numpy as np
import pytest

from sprung.model.diagnosis.api import diagnose
from sprung.model.diagnosis.record.signals import Noise, Part
from tests.diagnosis_cases import problem_of, quarter_car, simulate

VELOCITY = 1  # column of the wheel's


def _part(seed: int) -> tuple[Part, Noise]:
    problem = problem_of(simulate(seed=seed, seconds=6))
    return problem.part, problem.noise


def test_the_mean_of_a_velocity_is_that_of_its_displacement_within_the_stated_deviation() -> None:
    away = []
    for seed in range(8):
        part, noise = _part(seed)
        away.append(float(part.rate_offset[0] / np.sqrt(noise.rate_offset_variance(part)[0])))
    assert np.std(away) < 2
    assert np.max(np.abs(away)) < 4


def test_a_constant_offset_of_a_velocity_is_named_though_no_sensor_sees_it() -> None:
    record = simulate(seed=5, seconds=20)
    record.values[:, VELOCITY] += 4e-3
    report = diagnose(quarter_car(), record)
    assert report.verdict == "sensor_fault"
    (found,) = report.findings
    assert (found.location, found.effect) == ("wheel.velocity", "sensor_bias")
    assert found.parameters[0].unit == "m/s"
    assert found.parameters[0].value == pytest.approx(4e-3, abs=5 * found.parameters[0].std)

"""Measured forces in the diagnosis: noise of unknown size between force and body, a position that nothing holds."""

import numpy as np
import pytest
from scipy.signal import resample

from sprung.model.diagnosis.fit.baseline import baseline, refreshed
from sprung.model.diagnosis.fit.optimise import Fit, optimise
from sprung.model.diagnosis.fit.problem import Problem
from sprung.model.diagnosis.record.channels import prepare
from sprung.model.diagnosis.record.signals import declared_noise, drifting, rate_of
from sprung.model.diagnosis.record.spectra import Grid
from sprung.model.diagnosis.response.point import Point
from sprung.model.diagnosis.response.terms import Term
from sprung.model.laws import find_law
from sprung.model.system import System, load_system, parse_system
from tests.diagnosis_cases import MadeRecord

SLIDE = """
name: slide
sample_rate: 200
window: 200
bodies:
  slide: {mass: 45.0}
inputs:
  motor: {kind: force, body: slide, csv: force}
elements:
  guide: {upper: slide, lower: ground, stiffness: {value: 0.0, fixed: true}, damping: 150.0}
sensors:
  encoder: {kind: displacement, body: slide, csv: position, noise: 1.0e-6}
estimate: [damping, mass]
"""
MASS, DAMPING, FRICTION, OFFSET = 50.0, 120.0, 15.0, -4.0
FORCE_NOISE = 3.0  # N, of one sample


def positioning_axis(seconds: float = 20.0, seed: int = 0) -> MadeRecord:
    """Columns force and position of a slide that follows a course in closed loop, with friction and disturbances.

    The loop feeds the disturbance back into the force, as a drive's controller does.
    """
    rng = np.random.default_rng(seed)
    fine, rate = 20, 200
    step = 1 / (rate * fine)
    x = v = 0.0
    rows = np.empty((int(seconds * rate), 2))
    disturbance = resample(FORCE_NOISE * rng.standard_normal(len(rows)), len(rows) * fine)
    for i, pushed in enumerate(disturbance):
        t = i * step
        target = 0.1 * np.sin(2 * np.pi * 0.4 * t) + 0.03 * np.sin(2 * np.pi * 1.3 * t)
        force = 4e4 * (target - x) - 2e3 * v
        if i % fine == 0:
            rows[i // fine] = force + OFFSET, x
        v += step * (force - pushed - DAMPING * v - FRICTION * np.tanh(v / 1e-3)) / MASS
        x += step * v
    rows[:, 1] += 1e-6 * rng.standard_normal(len(rows))
    return MadeRecord(rows, 200.0)


@pytest.fixture(scope="module")
def fitted() -> tuple[System, Problem, Fit]:
    """The axis with friction and offset in place, noise estimated."""
    system = parse_system(SLIDE)
    signals = prepare(system, positioning_axis().values, 200.0).signals
    problem, base = baseline(system, signals, declared_noise(system, signals), 2800)
    friction = Term(find_law("coulomb_friction"), "guide", (10.0, 0.005), scales=(10.0, 0.005))
    offset = Term(find_law("sensor_bias"), "motor", (0.0,), scales=(1.0,))
    fit = optimise(problem, Point(base.point.theta, (friction, offset), base.point.state))
    return system, *refreshed(problem, fit)


def test_friction_and_offset_come_back_within_their_uncertainty_in_closed_loop(
    fitted: tuple[System, Problem, Fit],
) -> None:
    system, _, fit = fitted
    truth = [DAMPING, MASS, FRICTION, OFFSET]
    values = [
        *system.nominal * np.exp(fit.point.theta),
        fit.point.terms[0].parameters[0],
        fit.point.terms[1].parameters[0],
    ]
    std = np.sqrt(np.diag(fit.covariance))
    deviations = [*std[:2] * values[:2], std[2], std[4]]
    np.testing.assert_allclose(values, truth, rtol=0.05)
    assert np.abs((np.array(values) - truth) / deviations).max() < 4


def test_noise_of_a_force_is_estimated_from_the_residual(fitted: tuple[System, Problem, Fit]) -> None:
    _, problem, fit = fitted
    assert FORCE_NOISE / 2 < problem.noise.force[0] < 2 * FORCE_NOISE
    assert fit.reduced == pytest.approx(1.0, abs=0.4)


def test_position_that_no_stiffness_holds_is_compared_by_its_rate() -> None:
    slide, vehicle = parse_system(SLIDE), load_system()
    assert drifting(slide, np.array([0])).tolist() == [True]
    assert not drifting(vehicle, np.arange(len(vehicle.sensors))).any()


def test_rate_of_a_course_whose_ends_do_not_meet() -> None:
    grid = Grid(2000, 0.01)
    position = np.stack([0.3 * grid.time + np.sin(3 * grid.time), grid.time**2], axis=1)
    expected = np.stack([0.3 + 3 * np.cos(3 * grid.time), 2 * grid.time], axis=1)
    np.testing.assert_allclose(rate_of(position, grid), expected, atol=1e-2)

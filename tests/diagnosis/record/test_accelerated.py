"""Recordings whose supports are measured by their acceleration."""

import numpy as np
import pytest

from sprung.model.diagnosis.fit.baseline import baseline
from sprung.model.diagnosis.record.channels import TooLittleError, prepare
from sprung.model.diagnosis.record.signals import declared_noise
from sprung.model.identification.excitation import Runs, simulate_runs
from sprung.model.system import System, parse_system
from tests.test_system import QUARTER_CAR

D, V, A = (
    "displacement: {csv: z, noise: 1e-5}",
    "velocity: {csv: vz, noise: 1e-3}",
    "acceleration: {csv: az, noise: 0.1}",
)


ABSOLUTE = (
    "body: {kind: acceleration, body: sprung, csv: a1, noise: 0.01}",
    "body: {kind: displacement, body: sprung, csv: a1, noise: 1e-5}",
)
TRUTH = np.array([0.1, -0.08, 0.15, -0.1])


def ride(motions: str, samples: int = 2000, change: tuple[str, str] = ("", "")) -> tuple[System, Runs]:
    system = parse_system(QUARTER_CAR.replace(f"{D}, {V}", motions).replace(*change))
    return system, simulate_runs(system, TRUTH[None], samples, np.random.default_rng(0))


def test_an_acceleration_alone_is_enough_where_one_support_carries_everything() -> None:
    system, runs = ride(A)
    values = runs.values[0].copy()
    values[:, 0] += 0.3  # the offsets of two accelerometers
    values[:, 1] -= 0.2
    signals = prepare(system, values, 200.0).signals
    plain = prepare(system, runs.values[0], 200.0).signals
    assert signals.accelerated.all() and signals.integrated.all()
    np.testing.assert_allclose(signals.displacement, plain.displacement, atol=1e-9)
    np.testing.assert_allclose(signals.sensors, plain.sensors, atol=1e-9)
    curvature = np.diff(signals.displacement[:, 0], 2) * 200.0**2
    assert np.std(curvature - (values[1:-1, 0] - values[:, 0].mean())) < 0.05 * np.std(values[:, 0])


def test_accelerations_alone_identify_a_whole_recording_in_which_not_everything_drifts_alike() -> None:
    system, runs = ride(A, 12_000, ABSOLUTE)
    signals = prepare(system, runs.values[0], 200.0).signals
    assert np.std(signals.displacement) < 2 * np.std(runs.clean[0, :, 0])  # the integral does not wander
    _, fit = baseline(system, signals, declared_noise(system, signals), 8000)
    std = np.sqrt(np.diag(fit.covariance))
    assert np.abs((fit.point.theta - TRUTH) / std).max() < 4
    assert std.max() < 0.05


def test_what_the_filter_takes_of_accelerations_alone_is_said_and_a_recording_that_leaves_nothing_is_refused() -> None:
    system, runs = ride(A, 12_000, ABSOLUTE)
    assert any("measured by accelerations alone" in note for note in prepare(system, runs.values[0], 200.0).notes)
    with pytest.raises(TooLittleError, match=r"too short .* accelerations that must be integrated$"):
        prepare(system, runs.values[0][:1200], 200.0)


@pytest.mark.parametrize("beside", [D, V, f"{D}, {V}"])
def test_an_acceleration_beside_other_motions_is_fused_with_them(beside: str) -> None:
    system, runs = ride(f"{beside}, {A}")
    plain, _ = ride(beside)
    signals = prepare(system, runs.values[0], 200.0).signals
    assert signals.accelerated.all()
    less = prepare(plain, np.delete(runs.values[0], beside.count("noise"), axis=1), 200.0).signals
    omega = 2 * np.pi * np.array([1.0, 10.0, 40.0])
    both, one = declared_noise(system, signals), declared_noise(plain, less)
    assert (both.support_variance(omega) < one.support_variance(omega)).all()


SHAKEN = """
name: shaken mass
sample_rate: 100
window: 100
bodies: {mass: {mass: 40.0}}
inputs: {shaker: {kind: force, body: mass, csv: f, noise: 0.1}}
elements: {spring: {upper: mass, lower: ground, stiffness: STIFFNESS, damping: 30.0}}
sensors: {a: {kind: acceleration, body: mass, csv: a, noise: 0.01}}
"""


@pytest.mark.parametrize(("stiffness", "kept"), [("2.0e+4", False), ("1.0e-3", True)])
def test_an_offset_of_an_accelerometer_is_no_motion_of_what_springs_hold(stiffness: str, kept: bool) -> None:
    system = parse_system(SHAKEN.replace("STIFFNESS", stiffness))
    values = np.random.default_rng(2).standard_normal((4000, 2))
    offset = prepare(system, values + np.array([0.0, 0.7]), 100.0).signals.sensors
    plain = prepare(system, values, 100.0).signals.sensors
    np.testing.assert_allclose(offset, plain + 0.7 * kept, atol=1e-9)

"""Recordings whose supports are measured by their acceleration."""

import numpy as np
import pytest

from sprung.model.diagnosis.record.channels import DiagnosisError, prepare
from sprung.model.diagnosis.record.signals import declared_noise
from sprung.model.identification.excitation import simulate_runs
from sprung.model.system import parse_system
from tests.test_system import QUARTER_CAR

D, V, A = (
    "displacement: {csv: z, noise: 1e-5}",
    "velocity: {csv: vz, noise: 1e-3}",
    "acceleration: {csv: az, noise: 0.1}",
)


def ride(motions):
    system = parse_system(QUARTER_CAR.replace(f"{D}, {V}", motions))
    return system, simulate_runs(system, np.zeros((1, 4)), 2000, np.random.default_rng(0))


def test_an_acceleration_alone_is_enough_where_one_support_carries_everything():
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


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (("lower: unsprung", "lower: ground"), "strut"),
        (("kind: acceleration, body: sprung", "kind: displacement, body: sprung"), "body"),
    ],
)
def test_what_does_not_wander_with_an_integrated_support_needs_more_than_its_acceleration(change, said):
    text = QUARTER_CAR.replace(f"{D}, {V}", A)
    assert change[0] in text
    system = parse_system(text.replace(*change))
    values = np.random.default_rng(0).standard_normal((2000, len(system.channels)))
    with pytest.raises(
        DiagnosisError, match=rf"^input road is measured by its acceleration alone, .*({said}).* as well$"
    ):
        prepare(system, values, 200.0)


@pytest.mark.parametrize("beside", [D, V, f"{D}, {V}"])
def test_an_acceleration_beside_other_motions_is_fused_with_them(beside):
    system, runs = ride(f"{beside}, {A}")
    plain, _ = ride(beside)
    signals = prepare(system, runs.values[0], 200.0).signals
    assert signals.accelerated.all()
    less = prepare(plain, np.delete(runs.values[0], beside.count("noise"), axis=1), 200.0).signals
    omega = 2 * np.pi * np.array([1.0, 10.0, 40.0])
    both, one = declared_noise(system, signals), declared_noise(plain, less)
    assert (both.support_variance(omega) < one.support_variance(omega)).all()

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


def test_accelerations_alone_are_refused_in_one_line():
    system, runs = ride(A)
    with pytest.raises(DiagnosisError, match=r"^input road is measured by its acceleration alone: .* as well$"):
        prepare(system, runs.values[0], 200.0)


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

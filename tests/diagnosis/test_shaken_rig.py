"""A lightly damped rig on a shaker: its measured force is not fitted as if unknown, its instruments are no physics."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import bilinear, butter, lfilter, lsim, sosfiltfilt

from sprung.model.diagnosis.api import diagnose
from sprung.model.diagnosis.fit.baseline import baseline
from sprung.model.diagnosis.record.channels import prepare
from sprung.model.diagnosis.record.signals import declared_noise
from sprung.model.system import parse_system
from tests.diagnosis_cases import MadeRecord

RATE, FINER, SECONDS = 200.0, 20, 30.0
MASSES, STIFFNESSES, DAMPINGS = (10.0, 5.0), (3e4, 2e4), (25.0, 12.0)
RIG = """
name: two masses on a shaker
sample_rate: 200
window: 400
bodies: {m1: {mass: 10.3}, m2: {mass: 5.1}}
inputs: {shaker: {kind: force, body: m1, csv: f, noise: 0.05}}
elements:
  k1: {upper: m1, lower: ground, stiffness: 2.7e4, damping: 40}
  k2: {upper: m2, lower: m1, stiffness: 2.3e4, damping: 12}
sensors:
  a1: {kind: acceleration, body: m1, csv: a1, noise: 0.005}
  a2: {kind: acceleration, body: m2, csv: a2, noise: 0.005}
"""


def shaken(*, resonance: float = 0.0, gain: float = 1.0, seed: int = 4) -> MadeRecord:
    """Force and accelerations; resonance: of the mountings of both sensors, Hz; gain: of the force's."""
    random, count = np.random.default_rng(seed), int(SECONDS * RATE) * FINER
    band = butter(2, [1.0, 30.0], "bandpass", fs=RATE * FINER, output="sos")
    force = sosfiltfilt(band, random.standard_normal(count))
    force *= 60.0 / np.std(force)
    (m1, m2), (k1, k2), (c1, c2) = MASSES, STIFFNESSES, DAMPINGS
    inverse = np.diag([1 / m1, 1 / m2])
    K, C = np.array([[k1 + k2, -k2], [-k2, k2]]), np.array([[c1 + c2, -c2], [-c2, c2]])
    A = np.block([[np.zeros((2, 2)), np.eye(2)], [-inverse @ K, -inverse @ C]])
    B = np.array([[0.0], [0.0], [1 / m1], [0.0]])
    rows, shaker = A[2:], B[2:]
    _, shown, _ = lsim((A, B, rows, shaker), force, np.arange(count) / (RATE * FINER))
    if resonance:
        w = 2 * np.pi * resonance
        shown = lfilter(*bilinear([w * w], [1, w / 15, w * w], RATE * FINER), shown, axis=0)
    low = butter(8, 80.0, fs=RATE * FINER, output="sos")
    seen = sosfiltfilt(low, np.column_stack([gain * force, shown]), axis=0)[::FINER]
    return MadeRecord(seen + np.array([0.05, 0.005, 0.005]) * random.standard_normal(seen.shape), RATE)


def test_a_measured_force_stays_one_where_the_file_is_far_off() -> None:
    system = parse_system(RIG)
    signals = prepare(system, shaken(gain=1.01).values, RATE).signals
    noise = declared_noise(system, signals)
    _, fit = baseline(system, signals, noise, int(0.7 * signals.samples))
    found = {p.name: p.nominal * np.exp(v) for p, v in zip(system.parameters, fit.point.theta, strict=True)}
    for name, true in zip(("k1", "k2"), STIFFNESSES, strict=True):
        assert found[f"{name}.stiffness"] == pytest.approx(true, rel=0.05)
    for name, true in zip(("k1", "k2"), DAMPINGS, strict=True):
        assert found[f"{name}.damping"] == pytest.approx(true, rel=0.3)


@pytest.mark.slow
def test_what_mountings_make_of_the_motion_is_no_physics_of_the_rig() -> None:
    report = diagnose(parse_system(RIG), shaken(resonance=900.0))
    assert report.verdict == "consistent", report.summary
    values = {one.name: one.value for one in report.augmented}
    for name, true in zip(
        ("k1.stiffness", "k2.stiffness", "k1.damping", "k2.damping"), (*STIFFNESSES, *DAMPINGS), strict=True
    ):
        assert values[name] == pytest.approx(true, rel=0.05)

"""Diagnosis of structures whose excitation nobody measured, against truth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
import scipy.linalg

from sprung.model.diagnosis.ambient.decay import decay_stretch
from sprung.model.diagnosis.api import Report, TooLittleError, diagnose
from sprung.model.diagnosis.record.channels import prepare
from sprung.model.signals import FloatArray
from sprung.model.system import System, parse_system

RATE = 50.0
MASS, STIFFNESS, DAMPING = np.array([1000.0, 800.0]), np.array([4.6e5, 2.7e5]), np.array([800.0, 500.0])
TOWER = """
name: tower
sample_rate: 50
window: 1500
bodies: {one: {mass: 1000}, two: {mass: 800}}
elements:
  lower: {upper: one, lower: ground, stiffness: 4.0e+5, damping: 600}
  upper: {upper: two, lower: one, stiffness: 3.0e+5, damping: 400}
sensors:
  a1: {kind: acceleration, body: one, noise: 0.001}
  a2: {kind: acceleration, body: two, noise: 0.001}
"""


@dataclass
class ShakenRecording:
    values: FloatArray
    sample_rate: float = RATE
    lost: int = 0


def tower(seed: int, seconds: float, force: float = 50.0, k: FloatArray = STIFFNESS, fine: int = 4) -> FloatArray:
    """Accelerations under white forces, marched at `fine` steps a sample by an exact discrete model."""
    rng = np.random.default_rng(seed)
    H = np.array([[1.0, 0.0], [-1.0, 1.0]])
    K, C = (H.T * k) @ H, (H.T * DAMPING) @ H
    A = np.block([[np.zeros((2, 2)), np.eye(2)], [-K / MASS[:, None], -C / MASS[:, None]]])
    advance = scipy.linalg.expm(A / (RATE * fine))
    push = np.linalg.solve(A, (advance - np.eye(4)) @ np.vstack([np.zeros((2, 2)), np.diag(1 / MASS)]))
    forces = force * np.sqrt(fine) * rng.normal(size=(round(seconds * RATE) * fine, 2))
    states, x = np.empty((len(forces), 4)), np.zeros(4)
    for i, f in enumerate(forces):
        states[i] = x
        x = advance @ x + push @ f
    acceleration = (states @ A[2:].T + forces / MASS).reshape(-1, fine, 2).mean(axis=1)
    return acceleration + 0.001 * rng.normal(size=acceleration.shape)


def diagnosed(system: System, values: FloatArray) -> Report:
    return diagnose(system, ShakenRecording(values))


@pytest.mark.parametrize("noise", [0.0001, 0.01])
def test_a_shaken_tower_is_consistent_whatever_noise_is_declared(noise: float) -> None:
    report = diagnosed(parse_system(TOWER.replace("0.001", str(noise))), tower(1, 120.0))
    assert report.verdict == "consistent", report.summary
    assert report.unexplained.share == 0
    for name, truth in (("lower.stiffness", 4.6e5), ("upper.stiffness", 2.7e5)):
        value = next(p for p in report.baseline if p.name == name)
        assert abs(value.value - truth) < 4 * value.std < 0.04 * truth
    assert len(report.track) == 7


def test_a_structure_with_a_body_too_few_is_not_consistent() -> None:
    one = """
name: one body
sample_rate: 50
window: 1500
bodies: {two: {mass: 1800}}
elements: {lower: {upper: two, lower: ground, stiffness: 4.0e+5, damping: 600}}
sensors: {a2: {kind: acceleration, body: two, noise: 0.001}}
"""
    report = diagnosed(parse_system(one), tower(2, 120.0)[:, 1:])
    assert report.verdict == "unknown_physics"
    assert report.unexplained.share > 0.02
    assert "other frequencies" in report.summary


def test_a_stiffness_that_changes_is_followed() -> None:
    stiff = [tower(seed, 30.0, k=STIFFNESS * factor) for seed, factor in ((3, 1.0), (4, 1.5), (5, 0.7))]
    report = diagnosed(parse_system(TOWER.replace("1500", "500")), np.concatenate(stiff))
    assert report.verdict == "missing_physics"
    assert {(f.location, f.effect) for f in report.findings} >= {
        ("lower", "time_varying_stiffness"),
        ("upper", "time_varying_stiffness"),
    }
    slowest = [point.frequency[0] for point in report.track if point.begin >= 30 and point.end <= 60]
    assert np.median(slowest) == pytest.approx(np.sqrt(1.5) * frequency(STIFFNESS), rel=0.015)


def frequency(k: FloatArray) -> float:
    H = np.array([[1.0, 0.0], [-1.0, 1.0]])
    return float(np.sqrt(scipy.linalg.eigh((H.T * k) @ H, np.diag(MASS), eigvals_only=True)[0]) / (2 * np.pi))


def test_a_free_decay_is_known_from_vibration_that_goes_on() -> None:
    system = parse_system(TOWER)
    shaken = tower(7, 20.0)
    t = np.arange(1000) / RATE
    decay = (np.exp(-0.4 * t) * np.cos(14 * t))[:, None] * [0.5, 1.0] + 0.001 * np.random.default_rng(8).normal(
        size=(1000, 2)
    )
    noise = system.sensor_noise
    found = decay_stretch(prepare(system, decay, RATE).signals, noise)
    assert found is not None and found.start == 0
    assert decay_stretch(prepare(system, shaken, RATE).signals, noise) is None
    later = np.concatenate([0.001 * np.random.default_rng(9).normal(size=(200, 2)), decay])
    found = decay_stretch(prepare(system, later, RATE).signals, noise)
    assert found is not None and abs(found.start - 200) < 5


def test_uninformative_windows_are_refused() -> None:
    system = parse_system(TOWER.replace("1500", "32"))
    with pytest.raises(TooLittleError, match="no input is measured and no window"):
        diagnosed(system, tower(10, 20.0))

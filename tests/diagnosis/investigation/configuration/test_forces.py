"""Wrong set-ups of a structure under a measured force, its springs a tenth off nominal, against an exact simulation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
import scipy.linalg

from sprung.model.diagnosis.api import Options, diagnose
from sprung.model.diagnosis.rules import RULES
from sprung.model.signals import FloatArray
from sprung.model.system import parse_system

RATE, MASS = 50.0, 4000.0
STIFFNESS = np.array([2.4e6, 2.2e6, 1.8e6])
TOWER = """
name: tower
sample_rate: 50
window: 200
bodies: {f1: {mass: {value: 4000.0, fixed: true}}, f2: {mass: {value: 4000.0, fixed: true}},
  f3: {mass: {value: 4000.0, fixed: true}}}
inputs: {shaker: {kind: force, body: f3, csv: F, noise: 5}}
elements:
  s1: {upper: f1, lower: ground, stiffness: 2.0e+6, damping: 8.0e+3}
  s2: {upper: f2, lower: f1, stiffness: 2.0e+6, damping: 8.0e+3}
  s3: {upper: f3, lower: f2, stiffness: 2.0e+6, damping: 8.0e+3}
sensors:
  a1: {kind: acceleration, body: f1, csv: a1, noise: 0.003}
  a2: {kind: acceleration, body: f2, csv: a2, noise: 0.003}
  a3: {kind: acceleration, body: f3, csv: a3, noise: 0.003}
"""


@dataclass
class ShakerTest:
    values: FloatArray
    sample_rate: float = RATE
    lost: int = 0


def tower(samples: int = 2000, fine: int = 8) -> FloatArray:
    """Force on the top floor, band-limited between samples, and accelerations of all; exact between fine steps."""
    random = np.random.default_rng(21)
    spectrum = np.fft.rfft(random.standard_normal(samples))
    frequency = np.fft.rfftfreq(samples, 1 / RATE)
    spectrum *= (frequency > 0.3) * np.exp(-((frequency / 12) ** 8))
    force = fine * np.fft.irfft(spectrum, samples * fine)
    force *= 800 / np.std(force)
    H = np.array([[1.0, 0, 0], [-1, 1, 0], [0, -1, 1]])
    K = (H.T * STIFFNESS) @ H
    A = np.block([[np.zeros((3, 3)), np.eye(3)], [-K / MASS, -0.004 * K / MASS]])
    B = np.array([0, 0, 0, 0, 0, 1 / MASS])
    advance = scipy.linalg.expm(A / (RATE * fine))
    push = np.linalg.solve(A, (advance - np.eye(6)) @ B)
    x, states = np.zeros(6), np.empty((len(force), 6))
    between = 0.5 * (force + np.append(force[1:], force[-1]))
    for i, f in enumerate(between):
        states[i] = x
        x = advance @ x + push * f
    shown = (states @ A[3:].T + np.outer(force, B[3:]))[::fine]
    measured = np.column_stack([force[::fine], shown])
    return measured + random.standard_normal(measured.shape) * [5, 0.003, 0.003, 0.003]


def wrong(values: FloatArray, kind: str) -> FloatArray:
    """Columns F, a1, a2, a3 as a wrong rig records them."""
    out = values.copy()
    if kind in ("late node", "late force"):
        at = [1, 2, 3] if kind == "late node" else [0]
        out = values[4:].copy()
        out[:, at] = values[:-4, at]
    elif kind == "reversed sensor":
        out[:, 2] *= -1
    elif kind == "exchanged":
        out[:, [1, 3]] = values[:, [3, 1]]
    elif kind == "kN":
        out[:, 0] /= 1000
    elif kind == "g":
        out[:, 1:] /= 9.80665
    return out


@pytest.mark.parametrize(
    ("kind", "effect", "place", "value"),
    [
        ("late node", "node_delay", "a1|a2|a3", 0.08),
        pytest.param("late force", "node_delay", "shaker", 0.08, marks=pytest.mark.slow),
        pytest.param("reversed sensor", "sign_reversed", "a2", None, marks=pytest.mark.slow),
        pytest.param("exchanged", "channels_swapped", "a1|a3", None, marks=pytest.mark.slow),
        ("kN", "wrong_scale", "shaker", 1e-3),
        pytest.param("g", "wrong_scale", "a1|a2|a3", 1 / 9.80665, marks=pytest.mark.slow),
    ],
)
def test_a_wrong_set_up_under_a_measured_force_is_named(
    kind: str, effect: str, place: str, value: float | None
) -> None:
    report = diagnose(parse_system(TOWER), ShakerTest(wrong(tower(), kind)))
    assert report.verdict == "sensor_fault", report.summary
    (first,) = report.findings
    assert (first.effect, first.location) == (effect, place)
    if value is not None:
        assert first.parameters[0].value == pytest.approx(value, rel=0.01)


@pytest.mark.parametrize("kind", ["kN", pytest.param("g", marks=pytest.mark.slow)])
def test_where_the_inverse_fault_gives_the_same_recording_it_is_named_too(kind: str) -> None:
    """A linear structure answers a thousand times the force with a thousand times the motion."""
    (first,) = diagnose(parse_system(TOWER), ShakerTest(wrong(tower(), kind))).findings
    other = {"kN": "a1|a2|a3", "g": "shaker"}[kind]
    assert first.elsewhere == (other,)
    assert f"{other.replace('|', ' and ')} off by the inverse instead gives the same recording" in first.sentence


@pytest.mark.slow
def test_of_many_hypotheses_those_are_fitted_that_explain_a_stretch() -> None:
    short = Options(rules=RULES.varied("setup", "stretch", 700))
    report = diagnose(parse_system(TOWER), ShakerTest(wrong(tower(), "exchanged")), short)
    (first,) = report.findings
    assert (report.verdict, first.effect, first.location) == ("sensor_fault", "channels_swapped", "a1|a3")


def test_a_right_set_up_under_a_measured_force_is_consistent() -> None:
    assert diagnose(parse_system(TOWER), ShakerTest(tower())).verdict == "consistent"

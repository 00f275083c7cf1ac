"""Beside a sensor that sits elsewhere than the file says, physics is found by the other sensors on its body."""

from __future__ import annotations

import numpy as np
import pytest

import sprung
from sprung.model.diagnosis.api import diagnose
from sprung.model.system import parse_system
from tests.diagnosis_cases import MadeRecord

BEAM = """
name: beam
sample_rate: 200
window: 400
bodies:
  beam: {mass: 800, pitch_inertia: 900}
inputs:
  front:
    kind: displacement
    displacement: {csv: fd, noise: 1.0e-5}
    velocity: {csv: fv, noise: 5.0e-4}
  rear:
    kind: displacement
    displacement: {csv: rd, noise: 1.0e-5}
    velocity: {csv: rv, noise: 5.0e-4}
elements:
  front_strut: {upper: beam, lower: front, position: [1.2, 0.0], stiffness: 4.0e+4, damping: 2.0e+3}
  rear_strut: {upper: beam, lower: rear, position: [-1.2, 0.0], stiffness: 4.0e+4, damping: 2.0e+3}
sensors:
  nose: {kind: acceleration, body: beam, position: [1.4, 0.0], csv: a1, noise: 0.01}
  middle: {kind: acceleration, body: beam, position: [0.2, 0.0], csv: a2, noise: 0.01}
  tail: {kind: acceleration, body: beam, position: [-1.3, 0.0], csv: a3, noise: 0.01}
"""
FRICTION = "damping: 2.0e+3, laws: [{coulomb_friction: {force: 25, smoothing: 0.002}}]}\n  rear"


def _recorded(offset: float, friction: bool) -> MadeRecord:
    """The beam on a road of random phases, its middle sensor elsewhere by an offset, m."""
    text = BEAM.replace("position: [0.2, 0.0], csv", f"position: [{0.2 + offset}, 0.0], csv")
    text = text.replace("damping: 2.0e+3}\n  rear", FRICTION) if friction else text
    random, time, columns = np.random.default_rng(5), np.arange(4000) / 200, []
    for _ in range(2):
        frequency = np.linspace(0.5, 18, 150)
        angle = 2 * np.pi * np.outer(time, frequency) + random.uniform(0, 2 * np.pi, 150)
        size = 4e-4 / frequency
        columns += [np.sin(angle) @ size, np.cos(angle) @ (2 * np.pi * frequency * size)]
    inputs = np.column_stack(columns)
    values = np.column_stack([inputs, sprung.simulate(parse_system(text), inputs, {"rear_strut.damping": 2.3e3})])
    noise = np.array([1e-5, 5e-4, 1e-5, 5e-4, 0.01, 0.01, 0.01])
    return MadeRecord((values + noise * random.standard_normal(values.shape))[200:], 200.0)


@pytest.mark.parametrize("offset", [0.8, -0.6])
def test_friction_is_found_beside_it(offset: float) -> None:
    report = diagnose(parse_system(BEAM), _recorded(offset, friction=True))
    assert report.verdict == "missing_physics", report.summary
    position, friction = report.findings
    assert (position.location, position.effect) == ("middle", "wrong_position")
    assert abs(position.parameters[0].value - offset) < 0.02
    assert (friction.location, friction.effect) == ("front_strut", "coulomb_friction")
    assert abs(friction.parameters[0].value - 25) < 3 * friction.parameters[0].std < 1.5


def test_alone_it_is_no_physics() -> None:
    report = diagnose(parse_system(BEAM), _recorded(0.8, friction=False))
    assert (report.verdict, [f.effect for f in report.findings]) == ("sensor_fault", ["wrong_position"])

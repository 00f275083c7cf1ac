"""A building whose lowest storey yields in an earthquake: its linear model is far from its motion."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from sprung.model.diagnosis.api import Options
from sprung.model.diagnosis.investigation.along_motion import law_along_motion
from sprung.model.diagnosis.investigation.diagnose import begun
from sprung.model.signals import FloatArray
from sprung.model.system import parse_system

RATE, FINE, SECONDS = 50.0, 16, 16.0
MASSES, STIFFNESS, DAMPING = (3e5, 2.5e5), (2.0e8, 1.6e8), (7e5, 5e5)
POST_YIELD, YIELD = 0.2, 0.008  # share of the stiffness, m
BUILDING = f"""
name: building
sample_rate: {RATE}
window: 100
bodies: {{low: {{mass: 3e5}}, high: {{mass: 2.5e5}}}}
inputs: {{foundation: {{kind: support, acceleration: {{csv: ground, noise: 0.005}}}}}}
elements:
  first: {{upper: low, lower: foundation, stiffness: 2e8, damping: 6e5}}
  second: {{upper: high, lower: low, stiffness: 1.5e8, damping: 6e5}}
sensors:
  a1: {{kind: acceleration, body: low, csv: a1, noise: 0.005}}
  a2: {{kind: acceleration, body: high, csv: a2, noise: 0.005}}
"""


@dataclass
class ShakenBuilding:
    values: FloatArray
    sample_rate: float = RATE
    lost: int = 0


def earthquake() -> ShakenBuilding:
    """Accelerations of ground and floors, by steps of 1.25 ms; the storey's hysteresis is Bouc's with exponent 2."""
    random, samples = np.random.default_rng(7), int(SECONDS * RATE)
    time, frequency = np.arange(samples) / RATE, np.fft.rfftfreq(samples, 1 / RATE)
    spectrum = np.fft.rfft(random.standard_normal(samples)) * ((frequency > 0.3) & (frequency < 8))
    quake = np.fft.irfft(spectrum, samples) * np.minimum(time / 2, 1) * np.exp(-np.maximum(time - 11, 0) / 3)
    quake *= 4.0 / np.max(np.abs(quake))
    ground = FINE * np.fft.irfft(np.fft.rfft(quake), samples * FINE)
    x, v, z, step = np.zeros(2), np.zeros(2), 0.0, 1 / (RATE * FINE)
    shown = np.empty((samples, 2))
    for i, pushed in enumerate(ground):
        d1, d2, v1, v2 = x[0], x[1] - x[0], v[0], v[1] - v[0]
        first = STIFFNESS[0] * (POST_YIELD * d1 + (1 - POST_YIELD) * z) + DAMPING[0] * v1
        second = STIFFNESS[1] * d2 + DAMPING[1] * v2
        a = np.array([(second - first) / MASSES[0], -second / MASSES[1]])  # of the floors, not relative to the ground
        if i % FINE == 0:
            shown[i // FINE] = a
        z += step * (v1 - 0.5 * (abs(v1) * z * abs(z) + v1 * z * z) / YIELD**2)
        v = v + step * (a - pushed)
        x = x + step * v
    values = np.column_stack([quake, shown])
    return ShakenBuilding(values + 0.005 * random.standard_normal(values.shape))


def test_its_hysteresis_is_read_from_its_force_along_the_measured_motion() -> None:
    state = begun(parse_system(BUILDING), earthquake(), Options(), lambda share, text: None)
    candidate = law_along_motion(state)
    assert candidate is not None and candidate.start is not None
    assert (candidate.location, candidate.effect) == ("first", "bouc_wen")
    values = dict(zip(candidate.term.law.names, candidate.term.parameters, strict=True))
    assert values["alpha"] == pytest.approx((1 - POST_YIELD) * STIFFNESS[0], rel=0.1)
    assert 2e8 * np.exp(candidate.start.theta[0]) == pytest.approx(POST_YIELD * STIFFNESS[0], rel=0.2)

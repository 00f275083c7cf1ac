"""A building whose lowest storey yields in an earthquake: its linear model is far from its motion."""

from __future__ import annotations

import numpy as np
import pytest

from sprung.benchmarks.shaken import ShakenRig, earthquake, integrated
from sprung.model.diagnosis.api import Options
from sprung.model.diagnosis.investigation.diagnose import begun
from sprung.model.diagnosis.investigation.search.along_motion import law_along_motion
from sprung.model.signals import FloatArray
from sprung.model.system import parse_system

RATE, SECONDS = 50.0, 16.0
MASSES, STIFFNESS, DAMPING = np.array([3e5, 2.5e5]), np.array([2.0e8, 1.6e8]), np.array([7e5, 5e5])
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


def storeys() -> ShakenRig:
    """Accelerations of ground and floors; the lower storey's hysteresis is Bouc's with exponent 2."""
    random = np.random.default_rng(7)
    ground = 1.3 * earthquake(int(SECONDS * RATE), RATE, random)

    def rates(x: FloatArray, pushed: FloatArray) -> FloatArray:
        drift, speed, z = np.diff(x[:2], prepend=0.0), np.diff(x[2:4], prepend=0.0), x[4]
        first, second = STIFFNESS * drift + DAMPING * speed
        first -= (1 - POST_YIELD) * STIFFNESS[0] * (drift[0] - z)
        slip = 0.5 * (abs(speed[0]) * z * abs(z) + speed[0] * z * z) / YIELD**2
        return np.array([*x[2:4], *np.array([second - first, -second]) / MASSES - pushed, speed[0] - slip])

    floors = integrated(rates, lambda x, pushed: rates(x, pushed)[2:4] + pushed, np.zeros(5), ground[:, None], RATE)
    values = np.column_stack([ground, floors])
    return ShakenRig(parse_system(BUILDING), values + 0.005 * random.standard_normal(values.shape), RATE)


def test_its_hysteresis_is_read_from_its_force_along_the_measured_motion() -> None:
    rig = storeys()
    state = begun(rig.system, rig, Options(), lambda share, text: None)
    candidate = law_along_motion(state)
    assert candidate is not None and candidate.start is not None
    assert (candidate.location, candidate.effect) == ("first", "bouc_wen")
    values = dict(zip(candidate.term.law.names, candidate.term.parameters, strict=True))
    assert values["alpha"] == pytest.approx((1 - POST_YIELD) * STIFFNESS[0], rel=0.1)
    assert 2e8 * np.exp(candidate.start.theta[0]) == pytest.approx(POST_YIELD * STIFFNESS[0], rel=0.2)

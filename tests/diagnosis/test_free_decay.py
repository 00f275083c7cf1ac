"""A mass on a spring that is let go, its position measured: far from nominal, and with friction that holds."""

from __future__ import annotations

import numpy as np
import pytest

from sprung.model.diagnosis.api import Report, diagnose
from sprung.model.system import parse_system
from tests.diagnosis_cases import MadeRecord

RATE, FINE, NOISE, MASS = 200, 50, 2e-5, 10.0


def let_go(
    stiffness: float, damping: float, friction: float, start: float, seconds: float, cubic: float = 0.0
) -> np.ndarray:
    """Positions (T,), m; dry friction stops the mass where the spring does not overcome it."""
    x, v, step, found = start, 0.0, 1 / (RATE * FINE), []
    for i in range(int(seconds * RATE * FINE)):
        if i % FINE == 0:
            found.append(x)
        free = v - step * (stiffness * x + cubic * x**3 + damping * v) / MASS
        v = float(np.sign(free)) * max(abs(free) - step * friction / MASS, 0.0)
        x += step * v
    return np.array(found)


def diagnosed(position: np.ndarray, stiffness: float, damping: float) -> Report:
    system = parse_system(f"""
name: let go
sample_rate: {RATE}
window: 200
bodies: {{m: {{mass: {{value: {MASS}, fixed: true}}}}}}
elements: {{s: {{upper: m, lower: ground, stiffness: {stiffness}, damping: {damping}}}}}
sensors: {{x: {{kind: displacement, body: m, csv: x, noise: {NOISE}}}}}
""")
    shown = position + NOISE * np.random.default_rng(3).standard_normal(len(position))
    return diagnose(system, MadeRecord(values=shown[:, None], sample_rate=float(RATE)))


@pytest.mark.parametrize(("stiffer", "softer"), [(0.9, 1.5), (1.4, 0.5), (0.6, 3.0)])
def test_a_decay_whose_spring_is_far_from_nominal_is_consistent(stiffer: float, softer: float) -> None:
    report = diagnosed(let_go(8000.0, 2.0, 0.0, 0.02, 12.0), stiffer * 8000.0, softer * 2.0)
    assert report.verdict == "consistent", report.summary
    for value, truth in zip(report.baseline, (8000.0, 2.0), strict=True):
        assert abs(value.value - truth) < max(4 * value.std, 1e-3 * truth)


@pytest.mark.slow
def test_friction_that_brings_the_mass_to_rest_is_named_with_its_force() -> None:
    report = diagnosed(let_go(5000.0, 4.0, 6.0, 0.05, 10.0), 4500.0, 6.0)
    assert report.verdict == "missing_physics", report.summary
    (finding,) = report.findings
    assert finding.effect == "coulomb_friction"
    force = finding.parameters[0]
    assert force.value == pytest.approx(6.0, rel=0.02)


@pytest.mark.slow
def test_a_spring_that_stiffens_is_named_although_no_linear_decay_keeps_its_phase() -> None:
    report = diagnosed(let_go(2000.0, 2.0, 0.0, 0.05, 10.0, cubic=4e5), 1800.0, 3.0)
    assert report.verdict == "missing_physics", report.summary
    (finding,) = report.findings
    assert finding.effect == "cubic_stiffness"
    k3 = finding.parameters[0]
    assert abs(k3.value - 4e5) < 3 * k3.std and k3.std < 4e4

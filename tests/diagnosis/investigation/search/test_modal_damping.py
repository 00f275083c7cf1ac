"""A building whose modes are damped on their own; truth from the exact response at every frequency."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.linalg

from sprung.model.diagnosis.api import Options, diagnose
from sprung.model.system import parse_system
from sprung.service.diagnosis.improved import improved_text, left_out
from tests.diagnosis_cases import MadeRecord

BUILDING = """
name: building
sample_rate: 50
window: 250
bodies: {first: {mass: 900}, second: {mass: 1000}, roof: {mass: 700}}
inputs: {table: {kind: support, displacement: {csv: d, noise: 1e-5}, velocity: {csv: v, noise: 1e-4}}}
elements:
  s1: {upper: first, lower: table, stiffness: 2.0e6, damping: 2.0e+3}
  s2: {upper: second, lower: first, stiffness: 1.8e6, damping: 2.0e+3}
  s3: {upper: roof, lower: second, stiffness: 1.5e6, damping: 2.0e+3}
sensors:
  a1: {kind: acceleration, body: first, csv: a1, noise: 0.005}
  a2: {kind: acceleration, body: second, csv: a2, noise: 0.005}
  a3: {kind: acceleration, body: roof, csv: a3, noise: 0.005}
"""
MASS, STIFFNESS = np.array([900.0, 1000.0, 700.0]), (2.06e6, 1.75e6, 1.52e6)
RATIOS = np.array([0.03, 0.012, 0.006])  # falling, as no dampers between the storeys would have them


def shaken(seconds: float = 60.0, seed: int = 5) -> MadeRecord:
    """Steady vibration on a table of random phases, 0.5 to 16 Hz, its motion measured."""
    rng = np.random.default_rng(seed)
    f = np.arange(0.5, 16, 1 / seconds)
    s = 2j * np.pi * f
    table = 2e-4 / (1 + f) * np.exp(2j * np.pi * rng.random(len(f)))
    k1, k2, k3 = STIFFNESS
    K = np.array([[k1 + k2, -k2, 0], [-k2, k2 + k3, -k3], [0, -k3, k3]])
    squares, shapes = scipy.linalg.eigh(K, np.diag(MASS))
    C = np.diag(MASS) @ shapes @ np.diag(2 * RATIOS * np.sqrt(squares)) @ shapes.T @ np.diag(MASS)
    dynamic = s[:, None, None] ** 2 * np.diag(MASS) + s[:, None, None] * C + K
    relative = np.linalg.solve(dynamic, (-(s**2) * table)[:, None, None] * MASS[:, None])[:, :, 0]
    moved = relative + table[:, None]
    wave = np.exp(2j * np.pi * np.arange(int(seconds * 50))[:, None] / 50 * f)
    shown = np.real(wave @ np.column_stack([table, s * table, s[:, None] ** 2 * moved]))
    return MadeRecord(shown + rng.standard_normal(shown.shape) * [1e-5, 1e-4, 0.005, 0.005, 0.005], 50.0)


@pytest.mark.slow
def test_modes_that_are_damped_on_their_own_are_named_with_their_ratios() -> None:
    """Not connections to the ground and between storeys, which imitate them one by one."""
    system = parse_system(BUILDING)
    report = diagnose(system, shaken(), Options())
    assert report.verdict == "missing_physics"
    (finding,) = report.findings
    assert (finding.location, finding.effect) == ("first|second|roof", "modal_damping")
    assert [parameter.name for parameter in finding.parameters] == ["mode_1", "mode_2", "mode_3"]
    # what the dampers keep is part of every mode's damping, and is quoted with it
    quoted = {q.name: q for q in finding.quoted}
    ratios = [quoted[f"damping_ratio_of_mode_{n}"] for n in (1, 2, 3)]
    assert all(abs(q.value - true) < 3 * q.std + 1e-5 for q, true in zip(ratios, RATIOS, strict=True))
    assert all(q.std < 0.1 * q.value for q in ratios)
    written = parse_system(improved_text(BUILDING, system, report))
    assert left_out(report) == []
    modes = written.whole_system.mechanics.modes(written.bodies)
    np.testing.assert_allclose([mode.damping_ratio for mode in modes], RATIOS, rtol=0.05)
    again = diagnose(written, shaken(seed=6), Options())
    assert again.verdict == "consistent"

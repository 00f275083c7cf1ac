"""What an element has beside its spring and damper: inertia, and values that the file holds wrong."""

from __future__ import annotations

import numpy as np
import pytest
import yaml

from sprung.benchmarks.sensitivity_cases import QUARTER_CAR
from sprung.model.diagnosis.api import Options, diagnose
from sprung.model.laws.structure import INERTER, sites_of
from sprung.model.simulate.ride import simulate_ride
from sprung.model.system import parse_system
from tests.diagnosis_cases import MadeRecord, quarter_car, simulate

INERTANCE = 90.0  # kg, beside a body of 8000 kg


@pytest.mark.parametrize("element", [0, 1])
def test_an_inerter_couples_the_masses_at_its_ends(element: int) -> None:
    """M + b h h^T on the bodies, b h g of the support, up to what its fastening leaves: (f / 1 kHz)^2."""
    system = quarter_car()
    plain, s = system.mechanics, 2j * np.pi * 20.0
    name = system.elements[element]
    A, B, C, D = INERTER.modify(plain, sites_of(system.file, name), (INERTANCE,), "").matrices()
    displaced = B[:, :1] + s * B[:, 1:2]
    shown = C @ np.linalg.solve(s * np.eye(len(A)) - A, displaced) + D[:, :1] + s * D[:, 1:2]

    h, g = plain.H[element], plain.G[element, 0]
    dynamic = s**2 * (np.diag(plain.mass) + INERTANCE * np.outer(h, h))
    dynamic = dynamic + (plain.H.T * (plain.stiffness + s * plain.damping)) @ plain.H
    push = -(plain.H.T * (plain.stiffness + s * plain.damping)) @ plain.G[:, 0] - s**2 * INERTANCE * h * g
    expected = s**2 * plain.S @ np.linalg.solve(dynamic, push)
    assert shown[:, 0] == pytest.approx(expected, rel=1e-3)


def test_an_inerter_is_named_with_its_inertance() -> None:
    file = yaml.safe_load(QUARTER_CAR)
    file["elements"]["secondary"]["laws"] = [{"inerter": {"inertance": INERTANCE}}]
    rng = np.random.default_rng(3)
    time, f = np.arange(3000) / 100, np.linspace(0.5, 18, 160)
    angle = 2 * np.pi * f * time[:, None] + rng.uniform(0, 2 * np.pi, 160)
    road = np.column_stack([np.sin(angle) @ (6e-4 / f), np.cos(angle).sum(axis=1) * 6e-4 * 2 * np.pi])
    sensors = simulate_ride(parse_system(yaml.safe_dump(file, sort_keys=False)), road, noise=rng).sensors
    shown = road + np.array([1e-5, 5e-4]) * rng.standard_normal(road.shape)
    report = diagnose(quarter_car(), MadeRecord(np.column_stack([shown, sensors])), Options())
    assert [(one.location, one.effect) for one in report.findings] == [("secondary", "inerter")]
    (found,) = report.findings[0].parameters
    assert found.value == pytest.approx(INERTANCE, abs=4 * found.std) and found.std < 0.1 * INERTANCE


def test_a_damping_that_the_file_holds_wrong_is_named() -> None:
    held = QUARTER_CAR.replace("damping: 2.0e+4", "damping: {value: 2.0e+4, fixed: true}")
    report = diagnose(parse_system(held), simulate(lambda d, v: 9e3 * v, seed=8), Options())
    assert [(one.location, one.effect) for one in report.findings] == [("secondary", "damping_change")]
    (found,) = report.findings[0].parameters
    assert found.value == pytest.approx(7e3, abs=4 * found.std) and found.std < 500

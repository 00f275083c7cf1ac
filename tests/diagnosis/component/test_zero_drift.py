"""A load cell whose zero drifts: a nuisance beside which nothing else is lost, and for which nothing else is taken."""

from __future__ import annotations

import numpy as np
import pytest

from sprung.model.diagnosis.api import Report
from sprung.model.diagnosis.force.fit import ComponentModel, ComponentTask, fitted
from sprung.model.diagnosis.force.motion import element_motion
from sprung.model.diagnosis.force.zero_drift import ZeroDrift
from sprung.model.laws.paths import maxwell_path
from sprung.model.signals import FloatArray
from tests.diagnosis.component.test_component import RATE, C, K, laws, report

WARM = 0.23  # of the record, time constant of an amplifier that warms up


def random_motion(seed: int, seconds: float = 20.0) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Course of the record from 0 to 1, deflection and exact rate of eight sines from 0.2 to 3 Hz."""
    random, t = np.random.default_rng(seed), np.arange(int(seconds * RATE)) / RATE
    omega, phase = 2 * np.pi * random.uniform(0.2, 3.0, 8), random.uniform(0, 2 * np.pi, 8)
    size = 2 * np.pi * 0.003 * random.uniform(0.5, 1.0, 8) / omega
    angle = np.outer(t, omega) + phase
    return t / t[-1], np.sin(angle) @ size, np.cos(angle) @ (size * omega)


def drift_of(found: Report) -> dict[str, tuple[float, float]]:
    """Value and deviation of what is said of the drift."""
    (drift,) = [f for f in found.findings if f.effect == "zero_drift"]
    assert (drift.location, drift.kind.value) == ("cell", "nuisance")
    return {p.name: (p.value, p.std) for p in drift.parameters}


@pytest.mark.parametrize("drift", [8.0, -25.0])
def test_a_spring_and_damper_whose_cell_drifts_is_consistent_and_the_drift_told(drift: float) -> None:
    course, d, v = random_motion(1)
    found = report(K * d + C * v + 120.0 + drift * course, d)
    assert found.verdict == "consistent"
    told = drift_of(found)
    for name, truth in (("range", abs(drift)), ("change", drift)):
        assert abs(told[name][0] - truth) < 3 * told[name][1] < 0.1 * abs(drift)
    values = {p.name: p for p in found.augmented}
    for name, truth in (("stiffness", K), ("damping", C), ("preload", 120.0 + drift / 2)):
        one = values[f"damper.{name}"]
        assert abs(one.value - truth) < 3 * one.std


def test_an_amplifier_that_warms_up_is_no_relaxation() -> None:
    """A branch with a long memory decays as well, from what happened before the record."""
    course, d, v = random_motion(1000)
    found = report(K * d + C * v + 120.0 + 12.5 * (1 - np.exp(-course / WARM)), d)
    assert (found.verdict, laws(found)) == ("consistent", ["zero_drift"])


def test_friction_keeps_its_name_and_force_beside_a_drift() -> None:
    course, d, v = random_motion(2)
    found = report(K * d + C * v + 60 * np.tanh(v / 1e-3) + 20 * (1 - np.exp(-course / WARM)), d)
    assert (found.verdict, laws(found)) == ("missing_physics", ["coulomb_friction", "zero_drift"])
    force = found.findings[0].parameters[0]
    assert abs(force.value - 60.0) < 3 * force.std < 10.0
    assert found.unexplained.share == 0.0


def test_a_slow_relaxation_is_no_drift() -> None:
    """Its force follows from the motion."""
    _, d, v = random_motion(3, 40.0)
    force = K * d + C * v + 0.3 * K * maxwell_path(d, 6.0, 1 / RATE)
    found = report(force, d)
    assert laws(found)[0] in {"series_stiffness", "air_spring"}
    assert "zero_drift" not in laws(found)
    assert "zero" not in (found.findings[0].family or "")


def test_a_spring_that_changes_during_the_test_keeps_its_name() -> None:
    """What its static load changes by is told beside it."""
    course, d, v = random_motion(4)
    found = report(K * (1 - 0.06 * course) * d + C * v, d)
    assert (found.verdict, laws(found)[0]) == ("missing_physics", "time_varying_stiffness")


def test_the_zero_is_followed_where_laws_have_to_predict() -> None:
    """The polynomial that fits the beginning of a drift best is far off at its end."""
    course, d, v = random_motion(5)
    warm = 30 * (1 - np.exp(-course / WARM))
    task = ComponentTask(element_motion(d, v, RATE), K * d + C * v + warm, int(0.7 * len(d)))
    fit = fitted(task, ComponentModel((ZeroDrift(powers=5),), ((),)))
    assert np.sqrt(fit.held_out) < 0.1
    assert fit.preload == pytest.approx(np.mean(warm), abs=0.1)
    assert fit.element.stiffness == pytest.approx(K, rel=1e-4)

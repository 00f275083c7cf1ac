"""Laws of one strut that are found together, from its force along the measured motion."""

from __future__ import annotations

import numpy as np
import pytest

from sprung.benchmarks.shaken import ShakenRig, car
from sprung.model.diagnosis.api import Options, diagnose
from sprung.model.diagnosis.fit.baseline import baseline, refreshed
from sprung.model.diagnosis.record.channels import prepare
from sprung.model.diagnosis.record.signals import declared_noise
from sprung.model.diagnosis.selection.along_measured import MeasuredMotion

BODY = 420.0  # kg


@pytest.fixture(scope="module")
def rig() -> ShakenRig:
    return car(stop=True, valve=True, seed=12, seconds=30.0)


def test_the_force_of_a_strut_is_what_accelerates_its_body(rig: ShakenRig) -> None:
    signals = prepare(rig.system, rig.values, rig.sample_rate).signals
    problem, base = baseline(rig.system, signals, declared_noise(rig.system, signals), signals.samples)
    measured = MeasuredMotion.of(problem, base)
    assert measured is not None
    found = MeasuredMotion(*refreshed(measured.problem, measured.fit)).force_of("strut")
    accelerates = -BODY * signals.sensors[:, list(signals.sensor_names).index("body")]
    force = np.interp(np.arange(len(accelerates)) / rig.sample_rate, found.time, found.force)
    inner = slice(200, -200)
    left = np.std((force - accelerates)[inner]) / np.std(accelerates[inner])
    linear = base.forward.element_at("strut")
    alone = float(linear.stiffness) * found.deflection + float(linear.damping) * found.rate
    by_model = np.std(
        (np.interp(np.arange(len(accelerates)) / rig.sample_rate, found.time, alone) - accelerates)[inner]
    )
    assert left < 0.15
    assert left < 0.4 * by_model / np.std(accelerates[inner])


@pytest.mark.slow
def test_valves_that_differ_in_the_two_directions_and_stops_are_found_with_their_values(rig: ShakenRig) -> None:
    report = diagnose(rig.system, rig, Options(file="car"))
    assert report.verdict == "missing_physics"
    assert {(finding.location, finding.effect) for finding in report.findings} == {
        ("strut", "bump_stop"),
        ("strut", "damper_blowoff"),
        ("strut", "damper_asymmetry"),
    }
    values = {p.name: p for finding in report.findings for p in finding.parameters if finding.effect == "bump_stop"}
    for name, value in values.items():  # those of both sides, or of either
        true = 0.02 if "gap" in name else 2e5
        assert value.value == pytest.approx(true, rel=0.03)
        assert abs(value.value - true) < 5 * value.std
    knees = [
        p.value for f in report.findings if f.effect.startswith("damper") for p in f.parameters if "knee" in p.name
    ]
    assert knees == pytest.approx([0.15] * len(knees), rel=0.05)

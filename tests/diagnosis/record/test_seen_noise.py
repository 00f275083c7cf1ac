"""A displacement that is measured once shows its own noise where nothing moves that fast."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import yaml

from sprung.benchmarks.sensitivity_cases import QUARTER_CAR
from sprung.model.diagnosis.api import diagnose
from sprung.model.diagnosis.record.channels import prepare
from sprung.model.diagnosis.record.signals import declared_noise, seen_noise
from sprung.model.system import System, parse_system
from tests.diagnosis_cases import MadeRecord, quarter_car, simulate

TRUE = 5e-5  # m


def measured_once(times: float) -> tuple[System, MadeRecord]:
    """A quarter car whose road is measured as displacement alone, with so many times its true noise declared."""
    file = yaml.safe_load(QUARTER_CAR)
    (road,) = file["inputs"].values()
    del road["velocity"]
    road["displacement"]["noise"] = times * TRUE
    made = simulate(seed=5)
    rng = np.random.default_rng(8)
    values = np.delete(made.values, 1, axis=1)
    values[:, 0] += np.sqrt(TRUE**2 - 1e-5**2) * rng.standard_normal(len(values))
    return parse_system(yaml.safe_dump(file, sort_keys=False)), replace(made, values=values)


@pytest.mark.parametrize(("times", "level"), [(1 / 3, 1.0), (1.0, 1.0), (3.0, 3.0), (0.01, 0.1)])
def test_noise_is_raised_to_what_shows_and_never_lowered(times: float, level: float) -> None:
    system, record = measured_once(times)
    signals = prepare(system, record.values, record.sample_rate).signals
    (found,) = seen_noise(signals, declared_noise(system, signals)).displacement
    assert found == pytest.approx(level * TRUE, rel=0.1)


def test_what_is_measured_twice_keeps_what_was_declared() -> None:
    system, record = quarter_car(), simulate(seconds=6, seed=5)
    signals = prepare(system, record.values, record.sample_rate).signals
    declared = declared_noise(system, signals)
    assert seen_noise(signals, declared) is declared


def test_a_third_of_the_noise_declared_is_no_missing_physics() -> None:
    report = diagnose(*measured_once(1 / 3))
    assert report.verdict == "consistent"

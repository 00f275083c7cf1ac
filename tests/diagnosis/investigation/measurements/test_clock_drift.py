"""A node whose clock drifts against the others is told from physics that changes with time."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sprung.model.diagnosis.api import diagnose
from sprung.model.diagnosis.investigation.measurements.clock_drift import at_times
from sprung.model.diagnosis.report.report import Report
from tests.diagnosis_cases import quarter_car, simulate

BOGIE = [4, 5]  # columns of its accelerometers
NAMES = "|".join(quarter_car().channels[column].name for column in BOGIE)


def _with_clock(rate: float) -> Report:
    """A recording in which the bogie's sensors become later by a share of the time."""
    record = simulate(seed=74, seconds=40)
    values, time = record.values.copy(), np.arange(len(record.values)) / 100
    values[:, BOGIE] = at_times(values[:, BOGIE], 0.01, time - rate * (time - 14.0))
    return diagnose(quarter_car(), replace(record, values=values))


@pytest.mark.parametrize("rate", [1.6e-4, -1.3e-4])
def test_a_clock_that_drifts_more_than_clocks_do_is_a_fault_of_the_node(rate: float) -> None:
    report = _with_clock(rate)
    assert report.verdict == "sensor_fault", report.summary
    (finding,) = [one for one in report.findings if one.effect == "clock_drift"]
    (found,) = finding.parameters
    assert finding.location == NAMES and abs(found.value - rate) < 4 * found.std < 0.1 * abs(rate)
    assert not report.changes


def test_an_ordinary_drift_is_put_right_and_told() -> None:
    report = _with_clock(8e-5)
    assert report.verdict == "consistent", report.summary
    (note,) = [one for one in report.advice if "clock drifts" in one]
    assert note.startswith(NAMES.replace("|", " and "))


def test_a_right_clock_is_not_told() -> None:
    report = diagnose(quarter_car(), simulate(seed=74, seconds=40))
    assert report.verdict == "consistent" and not any("clock" in one for one in report.advice)


def test_a_damper_that_wears_within_minutes_is_no_clock() -> None:
    now = 0.0

    def fading(d: float, v: float) -> float:
        nonlocal now
        now += 0.001 / 4  # s: four evaluations in every step
        return float(-5e3 * (1 - np.exp(-now / 15)) * v)

    report = diagnose(quarter_car(), simulate(fading, seed=75, seconds=40))
    assert not any(one.effect == "clock_drift" for one in report.findings)
    assert not any("clock" in one for one in report.advice)


def test_columns_at_other_times_are_those_of_the_signal() -> None:
    time = np.arange(1000) * 0.01

    def truth(t: np.ndarray) -> np.ndarray:
        return np.column_stack([np.sin(2 * np.pi * 20 * t + 1) + 0.3 * t, np.cos(2 * np.pi * 3.3 * t)])

    later = time - 1e-3 - 2e-4 * time
    inner = slice(60, -60)
    np.testing.assert_allclose(at_times(truth(time), 0.01, later)[inner], truth(later)[inner], atol=0.02)

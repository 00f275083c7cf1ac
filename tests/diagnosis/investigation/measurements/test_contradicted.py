"""A sensor with an error of no listed form is told from physics by the others on its body, and left out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy import signal

from sprung.model.diagnosis.api import diagnose
from sprung.model.diagnosis.investigation.measurements.contradicted import parity_groups
from sprung.model.diagnosis.report.report import Report
from sprung.model.signals import FloatArray
from tests.diagnosis_cases import DAMPING, Force, MadeRecord, quarter_car, simulate

CAR, OTHER_CAR, BOGIE, OTHER_BOGIE = 2, 3, 4, 5  # columns of the accelerometers
TIME = np.arange(2000) / 100


def _friction(d: float, v: float) -> float:
    return float(300 * np.tanh(v / 1e-3))


@cache
def _recorded(law: Force | None = None) -> MadeRecord:
    return simulate(law, seed=71)


def _report(error: Callable[[FloatArray], FloatArray], column: int, law: Force | None = None) -> Report:
    """The diagnosis of a recording, one column of which shows something else."""
    record = _recorded(law)
    values = record.values.copy()
    values[:, column] = error(values[:, column])
    return diagnose(quarter_car(), replace(record, values=values))


def _hum(shown: FloatArray) -> FloatArray:
    return shown + 0.3 * np.sin(2 * np.pi * 16.7 * TIME[: len(shown)])


def _smoothed(shown: FloatArray) -> FloatArray:
    """By software, forwards and backwards: without any lag."""
    return np.asarray(signal.sosfiltfilt(signal.butter(3, 14, fs=100, output="sos"), shown))


def _loose(shown: FloatArray) -> FloatArray:
    """A contact that opens for tens of milliseconds, again and again."""
    starts = np.random.default_rng(3).integers(0, len(shown) - 10, 8)
    shown = shown.copy()
    for start in starts:
        shown[start : start + 5] = 0.0
    return shown


@pytest.mark.parametrize(
    ("error", "form"),
    [
        (_hum, "a tone at 16.7 Hz of 0.3 m/s^2"),
        (lambda shown: np.clip(shown, -1.5, 1.5), "it is cut off at 1.5 m/s^2"),
        (lambda shown: shown + 0.04 * shown**2, "most of it at"),
        (_loose, "of the time"),
        (_smoothed, "most of it at"),
    ],
    ids=["tone", "cut off", "curved", "loose", "smoothed"],
)
def test_the_sensor_is_named_and_no_spring_or_damper(error: Callable[[FloatArray], FloatArray], form: str) -> None:
    report = _report(error, BOGIE)
    (finding,) = report.findings
    assert (report.verdict, finding.effect) == ("sensor_fault", "sensor_error"), report.summary
    assert finding.location == quarter_car().channels[BOGIE].name
    assert form in finding.sentence
    assert not report.changes


def test_damping_is_as_right_as_without_the_sensor() -> None:
    report = _report(_hum, BOGIE)
    (secondary,) = [p for p in report.augmented if p.name == "secondary.damping"]
    assert abs(secondary.value - DAMPING["secondary"]) < 4 * secondary.std


def test_cross_talk_is_told_with_its_source_and_factor() -> None:
    bogie = _recorded().values[:, BOGIE]
    (finding,) = _report(lambda shown: shown + 0.05 * bogie, CAR).findings
    name = quarter_car().channels[BOGIE].name
    assert finding.effect == "sensor_error" and f"0.05 times what {name}" in finding.sentence


def test_a_fault_with_a_name_keeps_it() -> None:
    (finding,) = _report(lambda shown: 0.9 * shown, BOGIE).findings
    assert finding.effect == "sensor_gain" and abs(finding.parameters[0].value - 0.9) < 0.01


def test_physics_beside_a_faulty_sensor_is_found_as_without_it() -> None:
    report = _report(_hum, BOGIE, _friction)
    assert report.verdict == "missing_physics"
    assert {(f.location, f.effect) for f in report.findings} == {
        (quarter_car().channels[BOGIE].name, "sensor_error"),
        ("secondary", "coulomb_friction"),
    }


def test_physics_alone_accuses_no_sensor() -> None:
    report = diagnose(quarter_car(), _recorded(_friction))
    assert [(f.location, f.effect) for f in report.findings] == [("secondary", "coulomb_friction")]


def test_two_faulty_sensors_of_two_bodies_are_both_named() -> None:
    record = _recorded()
    values = record.values.copy()
    values[:, BOGIE], values[:, OTHER_CAR] = _hum(values[:, BOGIE]), values[:, OTHER_CAR] + 0.2 * values[:, CAR] ** 2
    report = diagnose(quarter_car(), replace(record, values=values))
    names = [quarter_car().channels[column].name for column in (BOGIE, OTHER_CAR)]
    assert report.verdict == "sensor_fault"
    assert sorted(f.location for f in report.findings) == sorted(names)


def test_the_parity_space_is_what_no_motion_reaches() -> None:
    corners = np.array([[1.0, 1.0, 2.0], [1.0, 1.0, -2.0], [1.0, -1.0, 2.0], [1.0, -1.0, -2.0]])  # heave, pitch, roll
    rows = np.zeros((6, 4))
    rows[:4, :3], rows[4:6, 3] = corners, 1.0
    four, pair = sorted(parity_groups(rows), key=lambda group: -len(group[0]))
    assert four[0].tolist() == [0, 1, 2, 3] and pair[0].tolist() == [4, 5]
    for members, basis in (four, pair):
        assert np.allclose(basis.T @ rows[members], 0) and np.allclose(basis.T @ basis, np.eye(basis.shape[1]))
    assert np.allclose(np.abs(four[1]), 0.5)
    assert parity_groups(corners[:3]) == [] and parity_groups(np.zeros((0, 3))) == []

"""Gains and zeros that are as far off as data sheets leave them are told, and decide nothing."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from sprung.benchmarks.sensitivity_cases import QUARTER_CAR as SYSTEM
from sprung.model.diagnosis.api import Options, diagnose
from sprung.model.diagnosis.investigation.diagnose import begun
from sprung.model.diagnosis.investigation.measurements import calibration
from sprung.model.diagnosis.investigation.measurements.data_sheets import within_tolerance
from sprung.model.diagnosis.report.report import Report
from sprung.model.diagnosis.response.terms import Term
from sprung.model.laws import find_law
from sprung.model.laws.channel import SensorResponse, passed
from sprung.model.system import parse_system
from tests.diagnosis_cases import MadeRecord, quarter_car, simulate


def _of_ordinary_instruments(record: MadeRecord) -> MadeRecord:
    """car_a 1.2 % too high, bogie_a 1 % too low, car_b off by 0.012 m/s^2, bogie_b 0.4 ms late."""
    record.values[:, 5] = passed(record.values[:, 5], SensorResponse(delay=4e-4), 100)
    record.values[:, 2] *= 1.012
    record.values[:, 4] *= 0.99
    record.values[:, 3] += 0.012
    return record


def _accepted(report: Report) -> dict[tuple[str, str], tuple[float, float]]:
    return {(one.location, one.effect): (p.value, p.std) for one in report.calibration for p in one.parameters}


def test_a_rig_with_ordinary_instruments_is_consistent() -> None:
    report = diagnose(quarter_car(), _of_ordinary_instruments(simulate(seed=41)))
    assert (report.verdict, report.findings) == ("consistent", ())
    told = _accepted(report)  # how gains differ is surer than what they are: the road's own is one of them
    for key, truth in {("car_a", "sensor_gain"): 1.012, ("bogie_a", "sensor_gain"): 0.99}.items():
        assert abs(told[key][0] - truth) < 3 * told[key][1] < 0.03
    assert told["car_b", "sensor_bias"][0] == pytest.approx(0.012, abs=1e-3)
    late = told["bogie_b", "sensor_lag"][0] - told.get(("bogie_a", "sensor_lag"), (0.0, 0.0))[0]
    assert late == pytest.approx(4e-4, abs=1e-4)
    assert "within calibration: " in report.summary


@pytest.mark.parametrize(("ratio", "calibrations", "told"), [(1.02, 5, True), (0.97, 5, False), (1.02, 0, False)])
def test_a_mass_is_weighed_no_better_than_instruments_show(ratio: float, calibrations: int, told: bool) -> None:
    """Where instruments are exact, it is a finding, however small."""
    system = SimpleNamespace(file=quarter_car().file, tolerances=(), channels=())
    state: Any = SimpleNamespace(system=system, options=Options(), calibrations=calibrations, signals=None)
    assert within_tolerance(state, Term(find_law("mass_change"), "car", (ratio,))) == told


@pytest.mark.slow
def test_beside_ordinary_instruments_a_law_is_the_only_finding() -> None:
    record = _of_ordinary_instruments(simulate(lambda d, v: 300 * np.tanh(v / 0.002), seed=42))
    report = diagnose(quarter_car(), record)
    assert report.verdict == "missing_physics"
    assert [(f.location, f.effect) for f in report.findings] == [("secondary", "coulomb_friction")]
    force = report.findings[0].parameters[0]
    assert abs(force.value - 300) < 3 * force.std
    assert ("car_b", "sensor_bias") in _accepted(report)


@pytest.mark.slow
@pytest.mark.parametrize(("sheet", "gain"), [("gain_std: 0.002", 1.012), ("gain_std: 0.015", 1.04)])
def test_what_a_data_sheet_does_not_leave_is_a_fault(sheet: str, gain: float) -> None:
    system = parse_system(SYSTEM.replace("noise: 0.004, csv: a}", f"noise: 0.004, {sheet}, csv: a}}"))
    record = simulate(seed=43)
    record.values[:, 2] *= gain
    report = diagnose(system, record)
    assert report.verdict == "sensor_fault"
    assert [(f.location, f.effect) for f in report.findings] == [("car_a", "sensor_gain")]


@pytest.mark.slow
def test_one_gain_that_stands_alone_is_a_fault_within_what_its_data_sheet_leaves() -> None:
    record = simulate(seed=44)
    record.values[:, 2] *= 1.012
    report = diagnose(quarter_car(), record)
    assert report.verdict == "sensor_fault"
    assert [(f.location, f.effect) for f in report.findings] == [("car_a", "sensor_gain")]


@pytest.mark.parametrize("more", [False, True])
def test_while_more_than_noise_is_left_no_gain_is_told_for_standing_alone(
    more: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    record = simulate(seconds=10.0, seed=44)
    record.values[:, 2] *= 1.02
    state = begun(quarter_car(), record, Options(), lambda share, text: None)
    gain = next(one.term for one in state.first.candidates if one.term.key[:2] == ("car_a", "sensor_gain"))
    monkeypatch.setattr(calibration, "leaves_more_than_noise", lambda state: more)
    after = calibration.calibrated(state, gain)
    assert bool(after.calibrations) == more
    if more:  # told when nothing else is left, and not before
        monkeypatch.setattr(calibration, "is_outlier", lambda fit, terms, key, rules: key == gain.key)
        assert calibration.faulty(after) == []
        monkeypatch.setattr(calibration, "leaves_more_than_noise", lambda state: False)
        assert [after.fit.point.terms[index].key for index in calibration.faulty(after)] == [gain.key]

"""Single wrong values of a force or a motion: left out, and told."""

from __future__ import annotations

import numpy as np
import pytest

from sprung.model.diagnosis.component.spikes import without_spikes
from sprung.model.signals import FloatArray
from tests.diagnosis.component.rigs import diagnosed, found, moved, recorded
from tests.diagnosis.component.test_component import RATE, RigRecording


def nothing(d: FloatArray, v: FloatArray) -> FloatArray:
    return np.zeros_like(d)


def friction(d: FloatArray, v: FloatArray) -> FloatArray:
    return 120.0 * np.tanh(v / 5e-4)


def spiked(record: RigRecording, column: int, at: list[int], size: float) -> RigRecording:
    values = record.values.copy()
    values[at, column] += size * np.std(values[:, column])
    return RigRecording(values)


@pytest.mark.parametrize(("column", "name"), [(1, "cell"), (0, "rod.displacement")])
@pytest.mark.parametrize("at", [[3100], [400, 1700, 3300]])
def test_a_few_wrong_values_of_a_linear_rig_are_told_and_it_stays_consistent(
    column: int, name: str, at: list[int]
) -> None:
    record = recorded(nothing, moved("random", 3))
    clean, report = diagnosed(record), diagnosed(spiked(record, column, at, 8.0))
    assert report.verdict == clean.verdict == "consistent"
    assert name in report.summary and all(f"{index / RATE:.2f}" in report.summary for index in at)
    assert report.augmented_validation.nrmse == pytest.approx(clean.augmented_validation.nrmse, rel=0.05)
    for one, other in zip(report.augmented, clean.augmented, strict=True):
        assert abs(one.value - other.value) < max(other.std, 1e-3 * abs(other.value))


def test_a_wrong_value_hides_no_friction_and_no_drift_of_the_cell() -> None:
    record = recorded(friction, moved("sweep"))
    record.values[:, 1] += 60.0 * (np.arange(len(record.values)) / len(record.values)) ** 2
    report = diagnosed(spiked(record, 1, [3500], 10.0))
    assert report.verdict == "missing_physics" and found(report) == {"coulomb_friction", "zero_drift"}
    assert "cell: a single value, at 17.50 s, stands out" in report.summary


@pytest.mark.parametrize("kind", ["sweep", "random"])
def test_jumps_of_friction_are_no_wrong_values(kind: str) -> None:
    values = recorded(friction, moved(kind, 3), 1e-3).values
    for column in values.T:
        series, at = without_spikes(column)
        assert not len(at) and series is column
    assert "left out" not in diagnosed(recorded(friction, moved(kind, 3))).summary


def test_a_zero_that_jumps_is_no_single_value() -> None:
    values = recorded(nothing, moved("random", 3)).values[:, 1]
    values[2000:] += 10 * np.std(values)
    assert not len(without_spikes(values)[1])


def test_values_beside_gaps_are_kept_and_so_are_gaps() -> None:
    series = np.sin(np.arange(400) / 20)
    series[100:104], series[250] = np.nan, 30.0
    mended, at = without_spikes(series)
    assert at.tolist() == [250]
    assert mended[250] == pytest.approx(np.sin(250 / 20), abs=1e-3)
    assert np.isnan(mended[100:104]).all() and np.isfinite(np.delete(mended, range(100, 104))).all()

"""Single wrong values of a force or a motion: left out, and told."""

from __future__ import annotations

import numpy as np
import pytest

from sprung.model.diagnosis.component.spikes import without_wrong_values
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
        series, wrong = without_wrong_values(column)
        assert not len(wrong.at) and not wrong.dropouts and series is column
    assert "left out" not in diagnosed(recorded(friction, moved(kind, 3))).summary


def test_a_zero_that_jumps_is_no_single_value() -> None:
    values = recorded(nothing, moved("random", 3)).values[:, 1]
    values[2000:] += 10 * np.std(values)
    assert without_wrong_values(values)[0] is values


@pytest.mark.parametrize(("column", "name"), [(1, "cell"), (0, "rod.displacement")])
@pytest.mark.parametrize("ratio", [1.0, 0.4, -1.0])
def test_two_wrong_values_in_a_row_are_told_as_well(column: int, name: str, ratio: float) -> None:
    record = recorded(nothing, moved("random", 3))
    clean, report = diagnosed(record), spiked(record, column, [3100], 8.0)
    report.values[3101, column] += ratio * 8.0 * np.std(record.values[:, column])
    said = diagnosed(report)
    assert said.verdict == clean.verdict == "consistent"
    assert f"{name}: a pair of values, at 15.50 s, stands out" in said.summary
    assert said.augmented_validation.nrmse == pytest.approx(clean.augmented_validation.nrmse, rel=0.05)


def test_a_pulse_that_the_sampling_resolves_is_a_force() -> None:
    values = recorded(nothing, moved("random", 3)).values[:, 1]
    for width in (3, 4, 6, 10):
        pulse = values.copy()
        pulse[2000 - width : 2001 + width] += 20 * np.std(values) * np.hanning(2 * width + 1)
        assert without_wrong_values(pulse)[0] is pulse


def dropped(record: RigRecording, column: int, at: list[int], length: int) -> RigRecording:
    values = record.values.copy()
    for start in at:
        values[start : start + length, column] = 0.0
    return RigRecording(values)


@pytest.mark.parametrize("length", [4, 12])
@pytest.mark.parametrize(("column", "name"), [(1, "cell"), (0, "rod.displacement")])
def test_a_channel_that_drops_out_for_a_few_samples_is_told_and_left_out(column: int, name: str, length: int) -> None:
    record = recorded(nothing, moved("random", 3))
    large = np.flatnonzero(np.abs(record.values[:, column]) > 1.5 * np.std(record.values[:, column]))
    at = [int(large[len(large) // 3]), int(large[2 * len(large) // 3])]
    report = diagnosed(dropped(record, column, at, length))
    assert report.verdict == "consistent", report.summary
    assert f"{name} drops out, at {at[0] / RATE:.2f}, {at[1] / RATE:.2f} s: " in report.summary
    clean = diagnosed(record)
    for one, other in zip(report.augmented, clean.augmented, strict=True):
        assert abs(one.value - other.value) < 2 * max(one.std, other.std)


def test_plateaus_of_tests_and_clipped_peaks_are_no_dropouts() -> None:
    time = np.arange(4000) / RATE
    noise = 1e-3 * np.random.default_rng(2).standard_normal(len(time))
    steps = np.round(2 * np.sign(np.sin(2 * np.pi * 0.31 * time))) + 0.0
    for series in (
        steps,
        np.clip(np.sin(2 * np.pi * time) + noise, -0.9, 0.9),
        np.round(np.sin(2 * np.pi * time) + noise, 1),
        np.where(time < 2.0, 0.0, np.sin(2 * np.pi * time) + noise),  # a test that begins
        np.where(np.abs(time - 9.9) < 0.6, 0.0, np.sin(2 * np.pi * time) + noise),  # and one that pauses
    ):
        assert not without_wrong_values(series)[1].dropouts


def test_values_beside_gaps_are_kept_and_so_are_gaps() -> None:
    series = np.sin(np.arange(400) / 20)
    series[100:104], series[250] = np.nan, 30.0
    mended, wrong = without_wrong_values(series)
    assert wrong.at.tolist() == [250]
    assert mended[250] == pytest.approx(np.sin(250 / 20), abs=1e-3)
    assert np.isnan(mended[100:104]).all() and np.isfinite(np.delete(mended, range(100, 104))).all()

"""Whole diagnoses of a quarter car that another integrator simulated."""

import json
from typing import Any

import numpy as np
import pytest

from sprung.model.diagnosis.api import Options, Report, diagnose
from sprung.model.diagnosis.record.channels import DiagnosisError, TooLittleError
from tests.diagnosis_cases import DAMPING, STIFFNESS, MadeRecord, quarter_car, simulate


def _diagnose(record: MadeRecord, **options: Any) -> Report:
    return diagnose(quarter_car(), record, Options(**options))


def test_clean_recording_is_consistent_and_errs_by_its_noise() -> None:
    report = _diagnose(simulate(seed=20))
    assert report.verdict == "consistent"
    assert report.findings == ()
    assert report.baseline_validation.nrmse == pytest.approx(report.noise_floor.nrmse, rel=0.1)


def test_dry_friction_is_found_named_and_sized() -> None:
    report = _diagnose(simulate(lambda d, v: 300 * np.tanh(v / 0.002), seed=21))
    first = report.findings[0]
    assert report.verdict == "missing_physics"
    assert (first.location, first.effect) == ("secondary", "coulomb_friction")
    force = first.parameters[0]
    assert abs(force.value - 300) < max(4 * force.std, 6.0)
    assert report.augmented_validation.nrmse < report.baseline_validation.nrmse
    assert report.explained is not None and report.explained > 0.9
    assert "dry friction" in first.sentence
    assert first.look_alikes["bouc_wen"] > 20  # odds against what similar data may suggest


def test_laws_that_a_recording_does_not_distinguish_are_called_a_family() -> None:
    """A weak friction that turns slowly, and a valve that opens at a low rate."""
    report = _diagnose(simulate(lambda d, v: 10 * np.tanh(v / 0.006), seed=21, seconds=30))
    (finding,) = report.findings
    assert finding.family is not None
    assert set(finding.family.split(" or ")) == {"coulomb_friction", "damper_blowoff"}
    assert "cannot distinguish" in finding.sentence
    assert finding.advice is not None and "would tell them apart" in finding.advice


def test_weak_friction_is_no_hysteresis_that_hardly_gives_way() -> None:
    """Of a stiffness and what it yields over the recording tells the product alone, which is the friction."""
    report = _diagnose(simulate(lambda d, v: 8 * np.tanh(v / 0.002), seed=21, seconds=30))
    (finding,) = report.findings
    assert (finding.effect, finding.family) == ("coulomb_friction", None)
    assert abs(finding.parameters[0].value - 8) < 3 * finding.parameters[0].std < 4
    assert finding.look_alikes["bouc_wen"] > 10


@pytest.mark.slow
def test_friction_whose_corner_is_sharper_than_sampling_shows_says_so() -> None:
    sharp = 0.0003
    report = _diagnose(simulate(lambda d, v: 300 * np.tanh(v / sharp), seed=26))
    assert [(f.location, f.effect) for f in report.findings] == [("secondary", "coulomb_friction")]
    force, smoothing = report.findings[0].parameters
    assert abs(force.value - 300) < 3 * force.std < 15
    assert abs(smoothing.value - sharp) < 3 * smoothing.std
    assert smoothing.std > 0.3 * sharp


def test_cubic_spring_is_not_taken_for_a_bump_stop() -> None:
    report = _diagnose(simulate(lambda d, v: 4e9 * d**3, seed=22))
    assert [(f.location, f.effect) for f in report.findings] == [("secondary", "cubic_stiffness")]
    assert report.findings[0].runner_up is not None


def test_wrong_gain_of_one_sensor_is_no_physics() -> None:
    record = simulate(seed=23)
    record.values[:, 4] *= 0.95
    report = _diagnose(record)
    assert report.verdict == "sensor_fault"
    (finding,) = report.findings
    assert (finding.location, finding.effect) == ("bogie_a", "sensor_gain")
    assert finding.parameters[0].value == pytest.approx(0.95, abs=0.005)
    assert finding.runner_up is not None and finding.delta_bic is not None and finding.runner_up[0] != "sensor_gain"
    assert finding.runner_up[1] is not None and finding.runner_up[1] > finding.delta_bic + 100


def test_late_sensor_is_timed_right_although_its_misfit_passed_for_noise() -> None:
    record = simulate(seed=25, seconds=30)
    signal, lag, delay = record.values[:, 4], 0.02, -0.0004  # lead, as a bilinear filter has it beside its lag
    s = 2j * np.pi * np.fft.rfftfreq(2 * len(signal), 1 / record.sample_rate)
    both = np.fft.rfft(np.concatenate([signal, signal[::-1]]))
    record.values[:, 4] = np.fft.irfft(both * np.exp(-s * delay) / (1 + s * lag))[: len(signal)]
    report = _diagnose(record)
    assert [(f.location, f.effect) for f in report.findings] == [("bogie_a", "sensor_lag")]
    time, further = report.findings[0].parameters
    assert abs(time.value - lag) < 3 * time.std < 0.01 * lag
    assert abs(further.value - delay) < 3 * further.std < 0.12 * abs(delay)


def test_stuck_sensor_is_named_and_left_out() -> None:
    record = simulate(seed=24)
    record.values[1200:, 3] = record.values[1200, 3]
    report = _diagnose(record)
    assert report.verdict == "sensor_fault"
    assert [(f.location, f.effect) for f in report.findings] == [("car_b", "sensor_stuck")]
    assert "car_b" not in report.baseline_validation.per_sensor


def test_noisy_sensor_is_distinguished_from_physics() -> None:
    record = simulate(seed=25)
    rng = np.random.default_rng(0)
    record.values[:, 2] += 0.01 * rng.standard_normal(len(record.values))
    report = _diagnose(record)
    assert [(f.location, f.effect) for f in report.findings] == [("car_a", "sensor_noise")]


def test_recording_of_another_system_is_not_explained_by_physics() -> None:
    record = simulate(seed=26)
    rng = np.random.default_rng(1)
    record.values[:, 2:] = rng.standard_normal((len(record.values), 4)) * record.values[:, 2:].std(axis=0)
    report = _diagnose(record)
    assert report.verdict == "unknown_physics"
    assert report.findings == ()
    assert "system file" in report.advice[0]


def test_missing_input_is_refused_by_name() -> None:
    record = simulate(seed=27, seconds=10)
    record.values[:, :2] = np.nan
    with pytest.raises(DiagnosisError, match="wheel"):
        _diagnose(record)


def test_short_recording_is_refused_with_what_is_needed() -> None:
    record = simulate(seed=28, seconds=10)
    with pytest.raises(TooLittleError, match="200"):
        _diagnose(MadeRecord(record.values[:90]))


def test_still_recording_is_refused_with_what_is_needed() -> None:
    record = simulate(seed=30, seconds=10, level=1e-4)
    with pytest.raises(TooLittleError, match="noise"):
        _diagnose(record)


def test_report_is_json_with_the_contracts_keys() -> None:
    report = _diagnose(simulate(seed=29, seconds=12))
    data = json.loads(json.dumps(report.to_dict(), allow_nan=False))
    keys = {"system", "recording", "verdict", "baseline", "findings", "augmented", "noise_floor", "localization"}
    assert keys <= set(data)
    assert set(data["baseline"]["validation"]) == {"nrmse", "per_sensor"}


def test_valve_that_takes_nearly_all_of_the_damping_is_no_friction() -> None:
    """Read without the law, the damper is weaker than what the valve takes away: more than all of it is asked for."""
    knee, ratio, damping = 0.02, 0.1, DAMPING["secondary"]
    report = _diagnose(simulate(lambda d, v: (ratio - 1) * damping * (v - np.clip(v, -knee, knee)), seed=28))
    assert [(f.location, f.effect) for f in report.findings] == [("secondary", "damper_blowoff")]
    for parameter, truth in zip(report.findings[0].parameters, (knee, ratio), strict=True):
        assert abs(parameter.value - truth) < max(4 * parameter.std, 0.03 * truth)


def test_a_force_that_no_law_explains_is_reported_as_a_formula_with_its_values() -> None:
    report = _diagnose(simulate(lambda d, v: 120 * np.sin(d / 6e-4), seed=29))
    assert report.verdict == "unknown_physics"
    assert [(f.location, f.effect, f.formula) for f in report.findings] == [("secondary", "formula", "a * sin(d / L)")]
    assert report.explained is not None and report.explained > 0.99
    for parameter, truth in zip(report.findings[0].parameters, (120.0, 6e-4), strict=True):
        assert abs(parameter.value - truth) < 3 * parameter.std
    assert {"finding.0.curve_mean", "finding.0.curve_law"} <= set(report.plot_data)
    spring = next(p for p in report.augmented if p.name == "secondary.stiffness")
    assert abs(spring.value - STIFFNESS["secondary"]) < 3 * spring.std

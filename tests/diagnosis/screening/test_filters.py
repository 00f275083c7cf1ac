"""Accelerometers that are not flat: their own dynamics are no physics of the vehicle, and a hung mass is no sensor's.

Signals pass closed forms here, before their noise; the quarter car is simulated by code of its own.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from sprung.benchmarks.sensitivity_cases import QUARTER_CAR
from sprung.model.diagnosis.api import diagnose
from sprung.model.diagnosis.fit.optimise import optimise
from sprung.model.diagnosis.record.spectra import ComplexArray
from sprung.model.diagnosis.report.report import Finding, Report
from sprung.model.diagnosis.response.point import Point
from sprung.model.diagnosis.screening.filters import filter_candidates
from sprung.model.diagnosis.screening.score import Projector
from sprung.model.signals import FloatArray
from sprung.model.system import parse_system
from sprung.service.diagnosis.improved import improved_text
from tests.diagnosis.screening.test_structures import SYSTEM as HALF
from tests.diagnosis.screening.test_structures import _recording
from tests.diagnosis_cases import MadeRecord, problem_of, quarter_car, simulate

ALL = ("car_a", "car_b", "bogie_a", "bogie_b")
NOISE = [1e-5, 5e-4, 4e-3, 4e-3, 3e-2, 3e-2]
Response = Callable[[FloatArray], ComplexArray]  # of frequencies in Hz


def high_pass(corner: float, order: int = 1) -> Response:
    def response(f: FloatArray) -> ComplexArray:
        x = 1j * np.asarray(f) / corner
        return np.asarray(x / (1 + x) if order == 1 else x**2 / (1 + np.sqrt(2) * x + x**2))

    return response


def resonance(frequency: float, ratio: float) -> Response:
    return lambda f: np.asarray(1 / (1 + 2 * ratio * 1j * f / frequency - (f / frequency) ** 2))


def behind(
    response: Response, names: tuple[str, ...], seconds: float = 30.0, seed: int = 31, noise: float = 1.0
) -> MadeRecord:
    """The middle of a longer ride, whose accelerometers show it behind a filter; noise comes after."""
    before = 15.0
    values = simulate(seconds=seconds + 2 * before, seed=seed, noise=0.0).values
    for name in names:
        column = 2 + ALL.index(name)
        values[:, column] = through(values[:, column], response)
    values += noise * np.random.default_rng([seed, 1]).standard_normal(values.shape) * NOISE
    return MadeRecord(values[int(before * 100) : int((before + seconds) * 100)])


def through(signal: FloatArray, response: Response, rate: float = 100.0) -> FloatArray:
    both = np.fft.rfft(np.concatenate([signal, signal[::-1]]))
    frequency = np.arange(len(both)) * rate / (2 * len(signal))
    found: FloatArray = np.fft.irfft(both * response(frequency))[: len(signal)]
    return found


def said(report: Report) -> Finding:
    """The only finding, which is a fault of the measurement."""
    assert report.verdict == "sensor_fault", report.summary
    (finding,) = report.findings
    return finding


def within(finding: Finding, **truth: float) -> None:
    for parameter in finding.parameters:
        assert abs(parameter.value - truth[parameter.name]) < 4 * parameter.std < 0.2 * truth[parameter.name], finding


@pytest.mark.parametrize(("corner", "at"), [(0.1, ALL[:1]), (0.3, ALL[2:3]), (0.1, ALL), (1.0, ALL[:2]), (2.0, ALL)])
def test_the_corner_of_an_accelerometer_or_of_a_kind_is_no_physics(corner: float, at: tuple[str, ...]) -> None:
    finding = said(diagnose(quarter_car(), behind(high_pass(corner), at)))
    assert (finding.location, finding.effect) == ("|".join(at), "high_pass")
    within(finding, corner=corner)


def test_a_filter_of_second_order_is_told_as_such() -> None:
    finding = said(diagnose(quarter_car(), behind(high_pass(0.3, order=2), ALL[:1])))
    assert (finding.location, finding.effect) == ("car_a", "high_pass")
    assert "second order" in finding.sentence
    within(finding, corner=0.3, damping_ratio=np.sqrt(0.5))


@pytest.mark.parametrize(("frequency", "at"), [(25.0, "bogie_a"), (45.0, "car_a")])
def test_a_resonance_of_one_mounting_is_no_hung_mass(frequency: float, at: str) -> None:
    """At 45 Hz, above the compared band, its skirt is seen."""
    finding = said(diagnose(quarter_car(), behind(resonance(frequency, 0.03), (at,))))
    assert (finding.location, finding.effect) == (at, "mounting_resonance")
    assert finding.parameters[0].value == pytest.approx(frequency, rel=0.02)


def test_a_hung_mass_stays_one_beside_a_high_pass_filter() -> None:
    part, record = _recording("suspended_mass", 4)
    column = len(HALF.inputs)
    record.values[:, column] = through(record.values[:, column], high_pass(0.3), record.sample_rate)
    report = diagnose(HALF, record)
    assert {(f.location, f.effect) for f in report.findings} == {
        (part.location, "suspended_mass"),
        (HALF.sensors[0], "high_pass"),
    }, report.summary


def test_accelerometers_with_corners_of_their_own_are_no_physics() -> None:
    """One of them is left out, as the others contradict it, while they share a filter with it."""
    record = behind(high_pass(0.08), ALL[:1], noise=0.0)
    for name, corner in zip(ALL[1:], (0.1, 0.12, 0.15), strict=True):
        column = 2 + ALL.index(name)
        record.values[:, column] = behind(high_pass(corner), (name,), noise=0.0).values[:, column]
    record.values[:] += np.random.default_rng(5).standard_normal(record.values.shape) * NOISE
    report = diagnose(quarter_car(), record)
    assert report.verdict == "sensor_fault", report.summary
    assert {place for finding in report.findings for place in finding.location.split("|")} <= set(ALL)


def test_a_sensor_with_a_declared_filter_can_be_left_out() -> None:
    place = "bogie_b: {kind: acceleration, "
    assert QUARTER_CAR.count(place) == 1
    declared = parse_system(QUARTER_CAR.replace(place, place + "laws: [{high_pass: {corner: 0.1}}], "))
    record = behind(high_pass(0.1), ALL[3:])
    record.values[:, 5] += 0.05 * record.values[:, 5] ** 3  # a curved characteristic
    report = diagnose(declared, record)
    assert report.verdict == "sensor_fault" and [f.location for f in report.findings] == ["bogie_b"], report.summary


@pytest.mark.parametrize("seed", [41, 42, 43])
def test_no_filter_is_sought_far_in_clean_recordings(seed: int) -> None:
    """The scores of its trials are those of noise: correlated, so that the best is below that of as many alone."""
    problem = problem_of(simulate(seed=seed, seconds=12))
    fit = optimise(problem, Point(np.zeros(4), (), np.zeros(4)))
    candidates = [one for one, _ in filter_candidates(Projector(problem, fit), problem.system.catalogue)]
    assert {one.effect for one in candidates} == {"high_pass", "mounting_resonance"}
    assert max(one.score for one in candidates) < 20.0


def test_a_declared_filter_is_consistent_and_goes_back_into_the_file() -> None:
    record = behind(high_pass(0.1), ALL)
    report = diagnose(quarter_car(), record)
    text = improved_text(QUARTER_CAR, quarter_car(), report)
    declared = parse_system(text)
    assert [(law.location, law.law.name) for law in declared.laws] == [(name, "high_pass") for name in ALL]
    again = diagnose(declared, record)
    assert again.verdict == "consistent" and not again.findings, again.summary
    assert [law.effect for law in again.laws] == ["high_pass"] * 4
    assert improved_text(text, declared, again).count("high_pass") == 4

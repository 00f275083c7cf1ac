"""Windows of a vehicle with laws in its file: values, deviations, what is refused."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.signal import fftconvolve

from sprung.model.identification.identify import Identifier, load_identifier
from sprung.model.identification.measurements.deviations import deviations
from sprung.model.identification.nonlinear.search import LawSearch
from sprung.model.identifier import UnusableWindow
from sprung.model.signals import Estimate
from sprung.model.system import parse_system
from tests.strut import TEXT, recorded, strut

FRICTION = "{coulomb_friction: {force: 50, smoothing: {value: 0.02, fixed: true}}}"


@pytest.fixture(scope="module")
def windows() -> np.ndarray:
    """29 windows of a strut with 60 N of friction."""
    values = recorded(31.0, 11, lambda v, z: 60 * np.tanh(v / 0.02))
    return np.stack([values[i : i + 200] for i in range(200, 6000, 200)])


def test_values_of_the_law_and_the_element_are_found_with_calibrated_deviations(windows: np.ndarray) -> None:
    vehicle = strut(FRICTION)
    truth = np.log([1.0, 22 / 20, 14 / 15, 60 / 50])
    estimates = load_identifier(vehicle).identify(windows)
    names = [p.name for p in vehicle.tracked]
    assert names == ["tyre.stiffness", "strut.stiffness", "strut.damping", "strut.coulomb_friction.force"]
    assert np.mean([e.adequate for e in estimates]) > 0.9
    estimates = [e for e in estimates if e.adequate]
    deviations = np.array([(e.log_ratio - truth) / np.sqrt(np.diag(e.covariance)) for e in estimates])
    assert np.mean(np.abs(deviations) < 3) > 0.95 and 0.6 < np.sqrt(np.mean(deviations**2)) < 1.5
    information = sum(np.linalg.inv(e.covariance) for e in estimates)
    mean = np.linalg.solve(information, sum(np.linalg.inv(e.covariance) @ e.log_ratio for e in estimates))
    assert np.abs(mean - truth).max() < 0.01  # of all windows together
    linear = load_identifier(strut()).identify(windows)
    biased = np.mean([e.log_ratio[2] for e in linear])
    assert abs(biased - truth[2]) > 10 * abs(mean[2] - truth[2])  # what the linear model makes of the damper


def test_a_start_from_the_tracker_gives_the_same_answer(windows: np.ndarray) -> None:
    identifier = load_identifier(strut(FRICTION))
    first = identifier.identify(windows[:4])
    again = identifier.identify(windows[:4], np.array([e.log_ratio for e in first]))
    for a, b in zip(first, again, strict=True):
        assert np.abs(a.log_ratio - b.log_ratio).max() < 0.5 * np.sqrt(np.diag(a.covariance)).max()


def test_faults_of_measurements_that_the_file_states_are_taken_out(windows: np.ndarray) -> None:
    wrong = windows.copy()
    wrong[:, :, 3] *= 1.2
    plain = load_identifier(strut(FRICTION)).identify(windows[:6])
    mended = strut(FRICTION, "{sensor_gain: {gain: 1.2}}")
    for a, b in zip(plain, load_identifier(mended).identify(wrong[:6]), strict=True):
        np.testing.assert_allclose(a.log_ratio, b.log_ratio, rtol=1e-9, atol=1e-9)


def test_laws_that_no_window_can_hold_are_refused_by_name() -> None:
    vehicle = strut("{time_varying_damping: {p: 0.1, tau: 10}}")
    with pytest.raises(UnusableWindow, match="strut: windows cannot be identified with time_varying_damping"):
        load_identifier(vehicle)


def test_a_window_that_takes_too_long_has_no_values_and_says_so(windows: np.ndarray) -> None:
    identifier = load_identifier(strut(FRICTION), seconds=0.0)
    for estimate in identifier.identify(windows[:2]):
        assert not estimate.identified and estimate.informative and estimate.iterations == 0
        assert estimate.reason == "not identified: took longer than 0 s of processor time"
        assert not estimate.identifiable.any() and np.isfinite(estimate.covariance).all()
    assert all(e.identified and e.reason is None for e in load_identifier(strut(FRICTION)).identify(windows[:2]))


def test_looking_for_the_cause_of_a_misfit_ends_with_the_time_of_the_window(
    windows: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    wrong, iterated = windows[:2].copy(), [0]
    drawn = np.random.default_rng(3).normal(0, 30, wrong.shape[:2])
    wrong[:, :, 2] = fftconvolve(drawn, np.hanning(21)[None] / 10, mode="same", axes=1)  # no noise: nothing at the top
    identifier = load_identifier(strut(FRICTION), seconds=1.0)
    assert isinstance(identifier, Identifier)
    iterate = LawSearch._iterate

    def counted(*given: Any, **named: Any) -> None:
        iterated[0] += 1
        if iterated[0] == 10:  # the window itself is done by then
            identifier._work.until = 0.0
        iterate(*given, **named)

    monkeypatch.setattr(LawSearch, "_iterate", counted)
    for estimate in identifier.examine(wrong, np.ones(2, dtype=bool)):
        assert estimate.identified and not estimate.adequate
        assert estimate.reason is not None and estimate.reason.endswith("takes longer than 1 s of processor time")
    assert iterated[0] <= 10


@pytest.mark.parametrize("law", ["{formula: {formula: '-a*v', a: 1.0e5}}", "{cubic_stiffness: {k3: -1.0e12}}"])
def test_a_window_that_cannot_be_simulated_says_so(windows: np.ndarray, law: str) -> None:
    for estimate in load_identifier(strut(law)).identify(windows[:2]):
        assert not estimate.identified and not estimate.adequate and estimate.informative
        assert estimate.reason is not None and estimate.reason.startswith("cannot be simulated: ")


def test_a_window_at_standstill_is_uninformative() -> None:
    still = np.random.default_rng(2).normal(0, [1e-5, 5e-4, 0.03, 0.01, 2.0], (2, 200, 5))
    for estimate in load_identifier(strut(FRICTION)).identify(still):
        assert not estimate.informative


@pytest.mark.parametrize("silent", [0, 1])
def test_a_support_that_is_still_measured_is_enough(windows: np.ndarray, silent: int) -> None:
    """Displacement or velocity alone says where it is; a window without either says why it has no values."""
    truth = np.log([1.0, 22 / 20, 14 / 15, 60 / 50])
    some = windows.copy()
    some[:, :, silent] = np.nan
    some[3, :, :2] = np.nan
    estimates = load_identifier(strut(FRICTION)).examine(some, np.ones(len(some), dtype=bool))
    without = estimates.pop(3)
    assert (without.identified, without.reason) == (False, "missing input road.displacement and 1 more")
    assert {f.kind for e in estimates for f in e.faults} == {"silent"}
    fitting = [e for e in estimates if e.adequate]
    assert len(fitting) > 0.9 * len(estimates)
    errors = np.array([(e.log_ratio - truth) / np.sqrt(np.diag(e.covariance)) for e in fitting])
    assert np.mean(np.abs(errors) < 3) > 0.95 and 0.5 < np.sqrt(np.mean(errors**2)) < 1.5


def test_a_wrong_shape_is_named(windows: np.ndarray) -> None:
    with pytest.raises(UnusableWindow, match="shape"):
        load_identifier(strut(FRICTION)).identify(windows[:, :, :4])


def _pooled(estimates: list[Estimate]) -> tuple[np.ndarray, np.ndarray]:
    """Deviations as all windows say them under the priors of the data sheets, and their standard deviations."""
    found = [e.deviating for e in estimates if e.deviating is not None]
    parts = deviations(strut(FRICTION))
    information = sum(one.information for one in found) + np.diag([part.std**-2 for part in parts])
    pull = sum(one.score + one.information @ one.point for one in found)
    return np.linalg.solve(information, pull), np.sqrt(np.diag(np.linalg.inv(information)))


@pytest.mark.parametrize("channel", [0, 3])
def test_a_gain_beside_a_law_is_reported(windows: np.ndarray, channel: int) -> None:
    wrong = windows.copy()
    wrong[:, :, channel] *= 1.02
    identifier = load_identifier(strut(FRICTION))
    assert isinstance(identifier, Identifier)
    gains = _pooled(identifier.identify(wrong, weigh=np.ones(len(wrong), dtype=bool)))[0][:5]
    assert gains[channel] - np.median(np.delete(gains, channel)) == pytest.approx(0.02, abs=0.003)


def test_a_wrong_sensor_beside_a_law_is_taken_back(windows: np.ndarray) -> None:
    wrong = windows[:6].copy()
    wrong[:, :, 3] *= 1.3
    identifier = load_identifier(strut(FRICTION))
    assert isinstance(identifier, Identifier)
    mended = identifier.examine(wrong, np.ones(6, dtype=bool))
    assert sum(e.adequate for e in mended) >= 5
    assert all({fault.channel for fault in e.faults} == {"car_a"} for e in mended if e.adequate)


def test_a_load_beside_a_law_is_reported_and_biases_nothing(windows: np.ndarray) -> None:
    light = parse_system(TEXT.format(law=FRICTION, sensor="").replace("{mass: 400}", "{mass: 360, load: true}"))
    estimates = load_identifier(light).identify(windows)
    truth, load = np.log([1.0, 22 / 20, 14 / 15, 60 / 50]), np.log(400 / 360)
    found = [e.deviating for e in estimates if e.adequate and e.deviating is not None]
    information = sum(one.information[-1, -1] for one in found)
    mean = sum(one.information[-1, -1] * one.point[-1] + one.score[-1] for one in found) / information
    assert abs(mean - load) < 4 / np.sqrt(information) + 1e-3
    values = np.mean([e.log_ratio for e in estimates if e.adequate], axis=0)
    assert np.abs(values - truth).max() < 0.015

"""Windows of a vehicle with laws in its file: values, deviations, what is refused."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicHermiteSpline
from scipy.signal import firwin

from sprung.model.identification.identify import load_identifier
from sprung.model.identifier import UnusableWindow
from sprung.model.system import System, parse_system

RATE = 200.0
TEXT = """
name: quarter-car
sample_rate: 200
window: 200
bodies:
  wheel: {{mass: 45}}
  car: {{mass: 400}}
inputs:
  road:
    kind: displacement
    displacement: {{csv: road, noise: 1.0e-5}}
    velocity: {{csv: rate, noise: 5.0e-4}}
elements:
  tyre: {{upper: wheel, lower: road, stiffness: 200000, damping: {{value: 50, fixed: true}}}}
  strut: {{upper: car, lower: wheel, stiffness: 20000, damping: 1500{strut}}}
sensors:
  wheel_a: {{kind: acceleration, body: wheel, csv: a, noise: 0.03}}
  car_a: {{kind: acceleration, body: car, csv: b, noise: 0.01{sensor}}}
  strut_f: {{kind: force, element: strut, csv: f, noise: 2.0}}
"""
FRICTION = ", laws: [{{coulomb_friction: {{force: {force}, smoothing: {{value: 0.02, fixed: true}}}}}}]"


def system(force: float | None = None, sensor: str = "") -> System:
    return parse_system(TEXT.format(strut="" if force is None else FRICTION.format(force=force), sensor=sensor))


@pytest.fixture(scope="module")
def windows() -> np.ndarray:
    """29 windows of a strut with 60 N of friction, 22 kN/m and 1.4 kN s/m, by DOP853, with noise."""
    rng = np.random.default_rng(11)
    t = np.arange(6200) / RATE
    f, phase = rng.uniform(0.4, 25, 120), rng.uniform(0, 6.3, 120)
    road = (8e-3 / f / 4 * np.sin(2 * np.pi * f * t[:, None] + phase)).sum(axis=1)
    speed = (8e-3 / 2 * np.pi * np.cos(2 * np.pi * f * t[:, None] + phase)).sum(axis=1)
    u = CubicHermiteSpline(t, road, speed)
    rate = u.derivative()

    def strut(w: float, c: float, wv: float, cv: float) -> float:
        return 22e3 * (c - w) + 1400 * (cv - wv) + 60 * np.tanh((cv - wv) / 0.02)

    def slope(time: float, x: np.ndarray) -> list[float]:
        tyre = 2e5 * (x[0] - u(time)) + 50 * (x[2] - rate(time))
        pull = strut(*x)
        return [x[2], x[3], (pull - tyre) / 45, -pull / 400]

    fine = np.arange(8 * (len(t) - 1) + 1) / (8 * RATE)
    x = solve_ivp(slope, (0, t[-1]), np.zeros(4), t_eval=fine, rtol=1e-7, atol=1e-10, max_step=1 / RATE).y
    pull = strut(*x)
    tyre = 2e5 * (x[0] - u(fine)) + 50 * (x[2] - rate(fine))
    sensors = np.stack([(pull - tyre) / 45, -pull / 400, pull], axis=1)
    taps = firwin(8 * 64 + 1, 0.9 / 8)  # the anti-alias filter that a recorder has
    shown = np.apply_along_axis(np.convolve, 0, sensors, taps, "same")[::8]
    clean = np.concatenate([road[:, None], speed[:, None], shown], axis=1)
    noisy = clean + rng.normal(0, [1e-5, 5e-4, 0.03, 0.01, 2.0], clean.shape)
    return np.stack([noisy[i : i + 200] for i in range(200, 6000, 200)])


def test_values_of_the_law_and_the_element_are_found_with_honest_deviations(windows: np.ndarray) -> None:
    vehicle = system(50.0)
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
    linear = load_identifier(system()).identify(windows)
    biased = np.mean([e.log_ratio[2] for e in linear])
    assert abs(biased - truth[2]) > 10 * abs(mean[2] - truth[2])  # what the linear model makes of the damper


def test_a_start_from_the_tracker_gives_the_same_answer(windows: np.ndarray) -> None:
    identifier = load_identifier(system(50.0))
    first = identifier.identify(windows[:4])
    again = identifier.identify(windows[:4], np.array([e.log_ratio for e in first]))
    for a, b in zip(first, again, strict=True):
        assert np.abs(a.log_ratio - b.log_ratio).max() < 0.5 * np.sqrt(np.diag(a.covariance)).max()


def test_faults_of_measurements_that_the_file_states_are_taken_out(windows: np.ndarray) -> None:
    wrong = windows.copy()
    wrong[:, :, 3] *= 1.2
    plain = load_identifier(system(50.0)).identify(windows[:6])
    mended = parse_system(TEXT.format(strut=FRICTION.format(force=50.0), sensor=", laws: [{sensor_gain: {gain: 1.2}}]"))
    for a, b in zip(plain, load_identifier(mended).identify(wrong[:6]), strict=True):
        np.testing.assert_allclose(a.log_ratio, b.log_ratio, rtol=1e-9, atol=1e-9)


def test_laws_that_no_window_can_hold_are_refused_by_name() -> None:
    vehicle = parse_system(TEXT.format(strut=", laws: [{time_varying_damping: {p: 0.1, tau: 10}}]", sensor=""))
    with pytest.raises(UnusableWindow, match="strut: windows cannot be identified with time_varying_damping"):
        load_identifier(vehicle)


def test_a_window_at_standstill_tells_nothing() -> None:
    still = np.random.default_rng(2).normal(0, [1e-5, 5e-4, 0.03, 0.01, 2.0], (2, 200, 5))
    for estimate in load_identifier(system(50.0)).identify(still):
        assert not estimate.informative


def test_a_missing_input_and_a_wrong_shape_are_named(windows: np.ndarray) -> None:
    broken = windows[:1].copy()
    broken[0, 3, 1] = np.nan
    with pytest.raises(UnusableWindow, match=r"road\.velocity"):
        load_identifier(system(50.0)).identify(broken)
    with pytest.raises(UnusableWindow, match="shape"):
        load_identifier(system(50.0)).identify(windows[:, :, :4])

"""Where windows of a system with laws begin."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from sprung.model.identification.identify import Identifier, load_identifier
from sprung.model.identification.likelihood.linearise import WindowModel
from sprung.model.identification.nonlinear.initial import initial_iterate
from sprung.model.identification.nonlinear.iterate import Iterate
from sprung.model.identification.nonlinear.window import LawWindows
from sprung.model.identification.nonlinear.with_laws import acting_laws, without_laws
from sprung.model.signals import FloatArray
from sprung.model.simulate.ride import simulate_ride
from sprung.model.system import System, parse_system

VEHICLE = """
name: quarter-car
sample_rate: 100
window: 100
bodies:
  car: {mass: 8000}
  bogie: {mass: 1300}
inputs:
  wheel:
    kind: support
    displacement: {csv: d, noise: 1.0e-5}
    velocity: {csv: v, noise: 5.0e-4}
elements:
  primary: {upper: bogie, lower: wheel, stiffness: 2.4e+6, damping: 1.0e+4}
  secondary:
    upper: car
    lower: bogie
    stiffness: 4.3e+5
    damping: 2.0e+4
    laws: LAWS
sensors:
  car_a: {kind: acceleration, body: car, noise: 0.004, csv: a}
  bogie_a: {kind: acceleration, body: bogie, noise: 0.03, csv: e}
"""
STOP = "[{bump_stop: {gap: 0.004, stiffness: 3.0e+6}}]"
CUBIC = "[{cubic_stiffness: {k3: 1.0e+12}}]"


def ride(laws: str, seconds: float = 6.0) -> tuple[System, FloatArray]:
    """The vehicle and its channels (T, C) over a rough track."""
    system = parse_system(VEHICLE.replace("LAWS", laws))
    random = np.random.default_rng(5)
    time = np.arange(round(seconds * 100)) / 100
    w, phase = random.uniform(3, 40, 12), random.uniform(0, 2 * np.pi, 12)
    size = 0.012 / w
    displacement = (size * np.sin(w * time[:, None] + phase)).sum(axis=1)
    velocity = (size * w * np.cos(w * time[:, None] + phase)).sum(axis=1)
    driven = np.stack([displacement, velocity], axis=1)
    sensors = simulate_ride(system, driven, noise=random).sensors
    return system, np.concatenate([driven, sensors], axis=1)


def windows_of(values: FloatArray) -> FloatArray:
    return np.stack([values[i : i + 100] for i in range(100, len(values) - 99, 50)])


def test_the_opening_has_the_stop_where_it_is_met() -> None:
    """Forces of the opening are near those along its own motion, where those of the linear motion are far too large."""
    system, values = ride(STOP)
    windows = windows_of(values)
    w = LawWindows(without_laws(system), acting_laws(system), WindowModel(without_laws(system), 100))
    data = w.model.batch(w.model.knots(windows), windows, np.ones(2, dtype=bool))
    B = len(windows)
    start = Iterate(torch.zeros(B, w.unknowns), torch.zeros(B, 4), torch.zeros(B, 100, 1))
    start = Iterate(*(part.double() for part in (start.unknowns, start.x0, start.force)))
    point = initial_iterate(w, start, data)
    stationary = np.zeros((2, B, 100, 2))
    steps = w.steps(point, data)
    states, _ = w.simulate(steps, point.force, point.x0, data)
    law = w.forces_along(w.along(states, data, stationary, point, steps), point, steps)
    assert law.square().mean() > 100.0**2  # N: the stop is met at all
    assert (law - point.force).square().mean().sqrt() < 0.2 * law.square().mean().sqrt()


def test_windows_within_a_hard_stop_converge_at_once() -> None:
    system, values = ride(STOP)
    found = load_identifier(system).identify(windows_of(values))
    assert all(estimate.adequate for estimate in found)
    assert np.mean([estimate.iterations for estimate in found]) < 2.5


def test_a_law_that_throws_the_motion_out_of_bounds_is_no_end_of_the_batch() -> None:
    """The file's cubic is far too strong for these windows: they do not fit, and say so."""
    system, _ = ride(CUBIC)
    _, values = ride("[]")
    found = load_identifier(system).identify(1.5 * windows_of(values))
    assert all(np.isfinite(estimate.log_ratio).all() and np.isfinite(estimate.covariance).all() for estimate in found)


def test_a_window_whose_sensors_show_nonsense_is_no_end_of_the_batch() -> None:
    """Its motion leaves all bounds before any window has been followed."""
    system, values = ride(CUBIC.replace("e+12", "e+9"), 4.0)
    windows = windows_of(values)[:3]
    spoiled = windows.copy()
    spoiled[1, :, 2:] += 30 * np.random.default_rng(0).normal(size=(100, 2)) * np.std(windows[:, :, 2:])
    _, nonsense, last = load_identifier(system).identify(spoiled)
    assert not nonsense.adequate and last.adequate
    assert np.all(np.abs(last.log_ratio) < 2 * np.sqrt(np.diag(last.covariance)))


def test_windows_whose_forces_are_not_those_of_the_law_do_not_fit() -> None:
    """The cubic is so strong that its motion is lost: forces that sensors suggest are not the law's."""
    system, values = ride(CUBIC, 4.0)
    with np.errstate(all="ignore"):
        found = load_identifier(system).identify(windows_of(values)[:3])
    assert not any(estimate.adequate for estimate in found)


@pytest.mark.slow
def test_a_law_that_pushes_windows_away_is_no_end_of_the_batch() -> None:
    """Gains and delays are weighed of windows whose motion has not run away."""
    _, values = ride(CUBIC, 4.0)
    windows = windows_of(values)[:3]
    for law in ("formula: {formula: 'a * d * abs(v)', a: 3.0e+8}", "bouc_wen: {alpha: 3.0e+6, beta: 1.0e+30, n: 8}"):
        identifier = load_identifier(parse_system(VEHICLE.replace("LAWS", f"[{{{law}}}]")))
        assert isinstance(identifier, Identifier)
        with np.errstate(all="ignore"):
            found = identifier.examine(windows, np.ones(3, dtype=bool))
        assert not any(estimate.adequate for estimate in found)
        assert all(np.isfinite(estimate.covariance).all() for estimate in found)

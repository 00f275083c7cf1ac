"""Loads from air-spring pressures: constants learned ride by ride, and what a learned pressure then tells."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sprung.model.signals import FloatArray
from sprung.model.tracking import cargo as cargos
from sprung.model.tracking.cargo import GAUGE, KNOWN, Cargo

EMPTY = 4.2e5  # Pa
OPEN = np.array([0.3**2, 0.3**2])  # variances of the loads' logarithms without a pressure
NONE = np.full(2, np.nan)


def pressure(load: float, gauge: float = 0.0) -> FloatArray:
    """Of the first of two bodies; the second has no gauge."""
    return np.array([EMPTY * np.exp(load + gauge), np.nan])


def ridden(cargo: Cargo, load: float, std: float = 0.005, gauge: float = 0.0) -> Cargo:
    """After a ride whose windows determine the load with a standard deviation, from a departure with a pressure."""
    cargo = cargos.before_ride(cargo, pressure(load, gauge), OPEN)
    windows = np.array([load, load])
    information = std**-2 + 1 / cargo.prior_variance  # with the prior, as the tracker's belief has it
    believed = (windows * std**-2 + cargo.prior / cargo.prior_variance) / information
    return cargos.after_ride(cargo, believed, 1 / information)


def test_without_a_ride_a_pressure_says_nothing_of_the_load() -> None:
    cargo = cargos.before_ride(cargos.start(OPEN), pressure(0.2), OPEN)
    np.testing.assert_allclose(cargo.prior_variance, OPEN, rtol=1e-6)


def test_a_constant_is_learned_from_rides_and_the_next_load_known_at_departure() -> None:
    cargo = cargos.start(OPEN)
    for load in (0.0, 0.08, 0.15):
        cargo = ridden(cargo, load)
    assert cargo.constant[0] == pytest.approx(np.log(EMPTY), abs=1e-6)
    assert cargo.constant[1] == 0.0 and cargo.variance[1] == cargos.UNKNOWN  # no gauge, nothing learned
    departed = cargos.before_ride(cargo, pressure(0.11), OPEN)
    assert departed.prior[0] == pytest.approx(0.11, abs=0.005)
    assert GAUGE < np.sqrt(departed.prior_variance[0]) < 2 * GAUGE
    assert departed.prior_variance[1] == OPEN[1]


def test_the_variance_of_a_constant_falls_with_the_number_of_rides() -> None:
    first = ridden(cargos.start(OPEN), 0.1)
    many = first
    for _ in range(3):
        many = ridden(many, 0.1)
    assert many.variance[0] == pytest.approx(first.variance[0] / 4, rel=0.05)


def test_a_ride_that_hardly_determines_the_load_teaches_nothing() -> None:
    cargo = ridden(cargos.start(OPEN), 0.1, std=2 * KNOWN)
    assert cargo.variance[0] == cargos.UNKNOWN


def test_a_gauge_that_strays_is_believed_less() -> None:
    steady, straying = cargos.start(OPEN), cargos.start(OPEN)
    for gauge in (0.0, 0.0, 0.0, 0.3):
        steady, straying = ridden(steady, 0.1), ridden(straying, 0.1, gauge=gauge)
    assert steady.scatter[0] == 0.0 and straying.scatter[0] > GAUGE**2


def test_windows_contradict_a_pressure_beyond_their_common_uncertainty() -> None:
    cargo = cargos.start(OPEN)
    for load in (0.0, 0.1, 0.2):
        cargo = ridden(cargo, load)
    cargo = cargos.before_ride(cargo, pressure(0.1), OPEN)
    known = np.full(2, 0.004**2)
    assert not cargos.contradicted(cargo, np.array([0.1, 0.0]), known, OPEN)
    assert cargos.contradicted(cargo, np.array([0.3, 0.0]), known, OPEN)
    assert not cargos.contradicted(replace(cargo, prior_variance=OPEN), np.array([0.3, 0.0]), known, OPEN)


def test_a_ride_keeps_the_mean_of_its_pressures_and_lost_ones_change_nothing() -> None:
    cargo = cargos.during_ride(cargos.start(OPEN), pressure(0.0))
    assert cargo.pressure[0] == pytest.approx(np.log(EMPTY))
    assert cargos.during_ride(cargo, NONE) is cargo
    for _ in range(200):
        cargo = cargos.during_ride(cargo, pressure(0.1))
    assert cargo.pressure[0] == pytest.approx(np.log(EMPTY) + 0.1, abs=1e-4) and np.isnan(cargo.pressure[1])


def test_loads_are_disputed_from_the_first_window_that_contradicts_them_on() -> None:
    cargo = cargos.disputed(cargos.start(OPEN), 100, contradicting=True)
    later = cargos.disputed(cargo, 200, contradicting=True)
    assert cargo.disputed[0] == later.disputed[0] == 100
    assert cargos.disputed(later, 300, contradicting=False).disputed[0] == 0

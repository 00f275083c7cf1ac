"""Simulated buildings and cars: they move as mechanics has it, and are diagnosed."""

from __future__ import annotations

import numpy as np
import pytest

from sprung.benchmarks.shaken import ShakenRig, building, car, integrated
from sprung.model.diagnosis.api import diagnose


def test_an_oscillator_answers_a_steady_push_in_closed_form() -> None:
    omega, rate = 9.0, 100.0
    pushed = np.ones((300, 1))
    found = integrated(
        lambda x, u: np.array([x[1], u[0] - omega**2 * x[0]]), lambda x, u: x[:1], np.zeros(2), pushed, rate
    )[:, 0]
    exact = (1 - np.cos(omega * np.arange(300) / rate)) / omega**2
    np.testing.assert_allclose(found, exact, atol=1e-7)


@pytest.fixture(scope="module")
def as_stated() -> ShakenRig:
    return building(3, "as stated", seed=5, seconds=20.0)


def test_the_top_of_a_building_moves_most(as_stated: ShakenRig) -> None:
    assert as_stated.values.shape == (2000, 4)
    assert np.all(np.diff(np.std(as_stated.values[:, 1:], axis=0)) > 0)


def test_a_building_as_stated_is_consistent(as_stated: ShakenRig) -> None:
    assert diagnose(as_stated.system, as_stated).verdict == "consistent"


def test_valves_that_open_let_the_wheel_move_more() -> None:
    plain, opened = (car(False, valve, seed=3, seconds=4.0).values for valve in (False, True))
    np.testing.assert_allclose(plain[:, :2], opened[:, :2])  # the same road, with the same noise
    assert np.std(opened[:, 3]) > 1.01 * np.std(plain[:, 3])

"""Newton's method: periodic forces that depend on their own response, for short and long transients."""

from __future__ import annotations

import numpy as np
from scipy.linalg import expm

from sprung.model.diagnosis.response.newton import periodic_response

STEPS, STEP = 1500, 0.005


def held(frequency: float, loss: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A mass of 1 kg on a spring: transition over a step, and what a force at its beginning and its end adds."""
    w = 2 * np.pi * frequency
    block = np.zeros((4, 4))
    block[:2, :2] = np.array([[0.0, 1.0], [-(w**2), -2 * loss * w]]) * STEP
    block[:2, 2], block[2, 3] = np.array([0.0, -1.0]) * STEP, 1.0
    found = expm(block)
    return found[:2, :2], found[:2, 2:3] - found[:2, 3:], found[:2, 3:]


def test_multiple_shooting_finds_the_periodic_response_of_a_lightly_damped_structure() -> None:
    hold = held(1.3, 0.02)
    random = np.random.default_rng(4)
    gains = np.zeros((STEPS, 1, 2))
    gains[:, 0, 0] = 60.0 * (random.random(STEPS) < 0.3)  # a stop that is hit now and then
    defect = random.standard_normal((STEPS, 1))
    found = periodic_response(hold, gains, defect, 1.5 / (0.02 * 2 * np.pi * 1.3 * STEP))
    transition, begin, end = hold
    x, f = np.zeros(2), np.zeros(1)
    for k in range(-16 * STEPS, STEPS):  # until it is periodic
        at = k % STEPS
        moved = transition @ x + begin @ f
        f = np.linalg.solve(np.eye(1) - gains[at] @ end, gains[at] @ moved + defect[at])
        x = moved + end @ f
        if k >= 0:
            np.testing.assert_allclose(found[at], f, rtol=1e-6, atol=1e-6)


def test_integration_from_rest_and_multiple_shooting_agree_for_a_heavily_damped_structure() -> None:
    hold = held(1.3, 0.5)
    random = np.random.default_rng(5)
    gains = 40.0 * random.random((STEPS, 1, 2)) * np.array([1.0, 0.02])
    defect = random.standard_normal((STEPS, 1))
    quick = periodic_response(hold, gains, defect, 20 / (0.5 * 2 * np.pi * 1.3 * STEP))
    np.testing.assert_allclose(quick, periodic_response(hold, gains, defect, 1e9), atol=1e-6)


def test_an_unstable_correction_is_not_finite() -> None:
    transition, begin, end = held(1.3, 0.02)
    found = periodic_response((2 * transition, begin, end), np.zeros((STEPS, 1, 2)), np.ones((STEPS, 1)), 1e9)
    assert not np.all(np.isfinite(found))

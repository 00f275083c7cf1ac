"""Newton's steps: forces that answer their own change, however long the structure remembers."""

from __future__ import annotations

import numpy as np
from scipy.linalg import expm

from sprung.model.diagnosis.response.newton import answered

STEPS, STEP = 1500, 0.005


def held(frequency: float, loss: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A mass of 1 kg on a spring: transition over a step, and what a force at its beginning and its end adds."""
    w = 2 * np.pi * frequency
    block = np.zeros((4, 4))
    block[:2, :2] = np.array([[0.0, 1.0], [-(w**2), -2 * loss * w]]) * STEP
    block[:2, 2], block[2, 3] = np.array([0.0, -1.0]) * STEP, 1.0
    found = expm(block)
    return found[:2, :2], found[:2, 2:3] - found[:2, 3:], found[:2, 3:]


def test_a_structure_that_remembers_for_long_is_answered_by_what_comes_back_to_itself() -> None:
    hold = held(1.3, 0.02)
    random = np.random.default_rng(4)
    gains = np.zeros((STEPS, 1, 2))
    gains[:, 0, 0] = 60.0 * (random.random(STEPS) < 0.3)  # a stop that is hit now and then
    missing = random.standard_normal((STEPS, 1))
    found = answered(hold, gains, missing, 1.5 / (0.02 * 2 * np.pi * 1.3 * STEP))
    transition, begin, end = hold
    x, f = np.zeros(2), np.zeros(1)
    for k in range(-16 * STEPS, STEPS):  # until it is periodic
        at = k % STEPS
        moved = transition @ x + begin @ f
        f = np.linalg.solve(np.eye(1) - gains[at] @ end, gains[at] @ moved + missing[at])
        x = moved + end @ f
        if k >= 0:
            np.testing.assert_allclose(found[at], f, rtol=1e-6, atol=1e-6)


def test_what_forgets_quickly_is_answered_alike_by_stretches_from_rest() -> None:
    hold = held(1.3, 0.5)
    random = np.random.default_rng(5)
    gains = 40.0 * random.random((STEPS, 1, 2)) * np.array([1.0, 0.02])
    missing = random.standard_normal((STEPS, 1))
    quick = answered(hold, gains, missing, 20 / (0.5 * 2 * np.pi * 1.3 * STEP))
    np.testing.assert_allclose(quick, answered(hold, gains, missing, 1e9), atol=1e-6)


def test_what_grows_beyond_all_bounds_is_told_by_its_numbers() -> None:
    transition, begin, end = held(1.3, 0.02)
    found = answered((2 * transition, begin, end), np.zeros((STEPS, 1, 2)), np.ones((STEPS, 1)), 1e9)
    assert not np.all(np.isfinite(found))

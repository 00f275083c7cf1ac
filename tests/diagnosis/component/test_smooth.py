"""Stops and progressive springs are named where a smooth curve over the deflection of as many numbers does worse."""

from __future__ import annotations

import numpy as np
import pytest

from sprung.model.diagnosis.component.smooth import smooth_serves
from sprung.model.diagnosis.force.fit import NO_LAWS, refined
from sprung.model.signals import FloatArray
from tests.diagnosis.force.test_deviations import D, V, piece, task

TRAVEL = 0.5 * float(np.ptp(D))
MIDDLE = 0.5 * float(D.max() + D.min())
X = (D - MIDDLE) / TRAVEL


def stops(power: float) -> FloatArray:
    return 400 * np.maximum(X - 0.4, 0.0) ** power - 700 * np.maximum(-X - 0.6, 0.0) ** power


@pytest.mark.parametrize(
    ("force", "effect", "numbers", "shape", "serves"),
    [
        (stops(1.0), "bump_stop", 4, (0.4, 0.6), False),
        (stops(2.0), "progressive_stop", 5, (0.4, 0.6, 2.0), False),
        (stops(1.0) * (X > 0), "bump_stop", 4, (0.4, 0.6), False),
        (600 * X**2, "bump_stop", 4, (0.4, 0.6), True),
        (600 * X**2, "progressive_stop", 5, (0.3, 0.3, 2.0), True),
        (200 * np.exp(X), "progressive_stop", 5, (0.3, 0.3, 2.0), True),
    ],
)
def test_stops_are_distinguished_from_a_smooth_spring(
    force: FloatArray, effect: str, numbers: int, shape: tuple[float, ...], *, serves: bool
) -> None:
    start = (*(TRAVEL * x for x in shape[:2]), *shape[2:])
    fit = refined(task(force), NO_LAWS.plus(piece(effect, numbers), start))
    assert smooth_serves(fit, 0) is serves


def test_one_law_of_few_numbers_is_not_asked() -> None:
    fit = refined(task(600 * X**2 + 50 * np.tanh(V / 1e-3)), NO_LAWS.plus(piece("bump_stop", 2), (0.5 * TRAVEL,)))
    assert not smooth_serves(fit, 0)


@pytest.mark.parametrize(
    ("beside", "serves"),
    [
        (60 * np.abs(X), True),
        (0.0 * X, False),
        (40 * np.tanh(V / 1e-2), False),  # what they leave is no curve
    ],
)
def test_a_sum_of_laws_that_leaves_another_curve_is_none_of_them(beside: FloatArray, *, serves: bool) -> None:
    start = NO_LAWS.plus(piece("bump_stop", 4), (0.4 * TRAVEL, 0.6 * TRAVEL)).plus(piece("cubic_stiffness", 1), ())
    fit = refined(task(stops(1.0) + 300 * X**3 + beside), start)
    assert smooth_serves(fit, 0) is serves

"""Motion of a support from its acceleration alone: sines whose deflection is known."""

from __future__ import annotations

import numpy as np
import pytest

from sprung.model.diagnosis.component.integrated import integrated, without_slow

RATE, SECONDS, NOISE = 200.0, 60, 0.02  # Hz, s, m/s^2
TIME = np.arange(int(RATE * SECONDS)) / RATE
TONES = ((2.0, 3e-3, 0.3), (3.7, 1e-3, 1.0), (9.0, 2e-4, 2.0))  # Hz, m, phase


def of_tones(order: int) -> np.ndarray:
    """The motion, its rate or its acceleration."""
    turns = [(2 * np.pi * f, size, phase + order * np.pi / 2) for f, size, phase in TONES]
    return np.asarray(sum(size * w**order * np.sin(w * TIME + phase) for w, size, phase in turns))


def test_a_motion_is_that_of_its_acceleration_within_the_noise_that_is_stated() -> None:
    rng = np.random.default_rng(4)
    found = integrated(of_tones(2) + NOISE * rng.standard_normal(len(TIME)), RATE)
    assert found is not None and 0.2 < found.lowest < 2.0
    known = np.isfinite(found.displacement)
    assert known.mean() > 0.8 and not known[0] and not known[-1]
    known &= (TIME > 10) & (TIME < SECONDS - 10)  # where what an end breaks off is forgotten
    for shown, order, noise in (
        (found.displacement, 0, found.displacement_noise),
        (found.velocity, 1, found.velocity_noise),
    ):
        error = (shown - of_tones(order))[known]
        assert 0.5 * noise < np.std(error) < 2.0 * noise
        assert np.std(error) < 0.1 * np.std(of_tones(order))


def test_noise_alone_is_no_motion() -> None:
    assert integrated(np.random.default_rng(1).standard_normal(len(TIME)), RATE) is None


def test_a_force_loses_what_is_slow_and_keeps_its_gaps() -> None:
    force = of_tones(0) + 0.5 * np.sin(2 * np.pi * 0.05 * TIME)
    force[1000:1010] = np.nan
    fast = without_slow(force, RATE, 1.0)
    inner = np.isfinite(fast) & (TIME > 10) & (TIME < SECONDS - 10)
    assert np.isnan(fast[1000:1010]).all() and np.isfinite(fast).sum() == len(TIME) - 10
    assert np.std((fast - of_tones(0))[inner]) < 0.01 * np.std(of_tones(0))


@pytest.mark.parametrize("at", [0, 700])
def test_a_missing_sample_stays_missing(at: int) -> None:
    acceleration = of_tones(2)
    acceleration[at] = np.nan
    found = integrated(acceleration + NOISE * np.random.default_rng(2).standard_normal(len(TIME)), RATE)
    assert found is not None and np.isnan(found.displacement[at])

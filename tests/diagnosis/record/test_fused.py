"""Parity residuals of a support that is measured by displacement, velocity and acceleration at once."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sprung.model.diagnosis.record.fused import FusedMotion, ParityResiduals, parity_residuals

DT, T = 0.01, 1500
NOISE = {0: 2e-5, 1: 4e-4, 2: 2e-2}  # m, m/s, m/s^2


def fused(seed: int = 0, noise: float = 1.0) -> FusedMotion:
    """A few tones below 12 Hz, whose derivatives are known."""
    rng = np.random.default_rng(seed)
    time, series = np.arange(T) * DT, {order: np.zeros(T) for order in NOISE}
    for f, phase in zip(np.linspace(0.7, 12.0, 15), rng.uniform(0, 2 * np.pi, 15), strict=True):
        w = 2 * np.pi * f
        for order in series:
            series[order] += 4e-3 / f**2 * w**order * np.sin(w * time + phase + order * np.pi / 2)
    return FusedMotion(0, {n: s + noise * NOISE[n] * rng.standard_normal(T) for n, s in series.items()}, NOISE)


def residuals(one: FusedMotion) -> ParityResiduals:
    found = parity_residuals(one, DT)
    assert found is not None
    return found


def test_what_is_left_of_sound_channels_is_their_noise() -> None:
    found = residuals(fused())
    assert found.orders == (0, 1, 2) and found.freedom == 2 * T
    assert found.chi_square / found.freedom == pytest.approx(1.0, abs=4 * np.sqrt(2 / found.freedom))


@pytest.mark.parametrize("order", [0, 1, 2])
@pytest.mark.parametrize("gain", [0.01, -0.02])
def test_a_gain_is_estimated_with_its_size_at_its_channel(order: int, gain: float) -> None:
    one = fused(1)
    wrong = replace(one, series={**one.series, order: (1 + gain) * one.series[order]})
    found = residuals(wrong)
    evidence = {}
    for other in found.orders:
        product, square = found.score(other, found.shown(other)[0])
        evidence[other] = product**2 / square
        if other == order:
            assert product / square == pytest.approx(gain, rel=0.1)
    assert max(evidence, key=lambda one: evidence[one]) == order and evidence[order] > 25


def test_the_zero_of_an_accelerometer_is_no_contradiction() -> None:
    one = fused(2)
    moved = replace(one, series={**one.series, 2: one.series[2] + 0.3})
    assert residuals(moved).chi_square == pytest.approx(residuals(one).chi_square, rel=1e-6)
    product, square = residuals(moved).score(2, np.ones(T))
    assert (product, square) == (0.0, 0.0)


def test_shares_are_those_of_least_squares() -> None:
    """The quietest channel of all at a frequency carries the displacement there, and all together all of it."""
    found = residuals(fused())
    shares = found.shares_at(2 * np.pi * np.array([0.2, 40.0]))
    assert abs(shares[0][0]) > 0.5 and sum(abs(part[0]) for part in shares.values()) == pytest.approx(1.0, abs=0.05)


def test_a_channel_that_is_exact_is_compared_with_nothing() -> None:
    assert parity_residuals(replace(fused(), noise={0: 0.0, 1: 1e-4}), DT) is None

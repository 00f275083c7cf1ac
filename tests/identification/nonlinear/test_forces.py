"""Forces of laws along windows: the motion between their samples."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from sprung.model.identification.nonlinear import forces as law_forces
from sprung.model.identification.nonlinear.forces import (
    LawAlongMotion,
    add_motion_between_samples,
    band_limited,
    spline_compensation,
)
from sprung.model.laws import CATALOGUE, ElementLaw, SpringDamper
from sprung.model.signals import FloatArray

RATE = 100.0


def law(name: str) -> ElementLaw:
    return next(one for one in CATALOGUE if one.name == name and isinstance(one, ElementLaw))


@pytest.mark.parametrize(("frequency", "error"), [(15.0, 1e-4), (30.0, 2e-3), (40.0, 0.012)])
def test_rates_between_samples_are_those_of_motions_near_half_the_sample_rate(frequency: float, error: float) -> None:
    omega, time = 2 * np.pi * frequency, np.arange(100) / RATE
    deflection, rate = np.sin(omega * time)[None], omega * np.cos(omega * time)[None]
    along = LawAlongMotion(law("coulomb_friction"), deflection, rate, RATE)
    assert along.v.shape == along.d.shape == (1, 99 * along.parts + 1)
    np.testing.assert_allclose(along.v[:, :: along.parts], rate, atol=1e-9 * omega)
    truth = omega * np.cos(omega * along.time)
    assert np.sqrt(np.mean((along.v[0] - truth) ** 2)) < error * omega / np.sqrt(2)


def rubbing(parts: int, samples: int, mass: float, element: SpringDamper, friction: tuple[float, float]) -> FloatArray:
    """Deflection, rate and friction of a mass above a moving support on a grid of `parts` per sample, (3, grid)."""
    force, smoothing = friction
    k, c = element
    omega, phase = 2 * np.pi * np.array([1.3, 4.1, 9.7, 17.3]), np.array([0.1, 1.7, 2.9, 4.4])
    amplitude = np.array([2.0, 0.8, 0.3, 0.1]) * 1e-3
    finer = 4
    step = 1 / (RATE * parts * finer)
    time = np.arange(2 * samples * parts * finer + 2)[:, None] * step / 2
    supported = -amplitude * omega * np.cos(omega * time + phase)
    moving, turning = supported.sum(1).tolist(), (amplitude * omega**2 * np.sin(omega * time + phase)).sum(1).tolist()
    x, v = 0.0, moving[0]  # deflection and its rate; the support's acceleration loads them

    def rate(x: float, v: float, at: int) -> tuple[float, float]:
        return v, -(k * x + c * v + force * math.tanh(v / smoothing)) / mass + turning[at]

    found = np.empty((3, samples * parts))
    for i in range(samples * parts * finer):
        if i % finer == 0:
            found[:, i // finer] = x, v, force * math.tanh(v / smoothing)
        a, b = rate(x, v, 2 * i)
        a2, b2 = rate(x + step / 2 * a, v + step / 2 * b, 2 * i + 1)
        a3, b3 = rate(x + step / 2 * a2, v + step / 2 * b2, 2 * i + 1)
        a4, b4 = rate(x + step * a3, v + step * b3, 2 * i + 2)
        x, v = x + step / 6 * (a + 2 * (a2 + a3) + a4), v + step / 6 * (b + 2 * (b2 + b3) + b4)
    return found


def test_friction_rounds_its_own_corner_by_shaking_the_body_between_samples() -> None:
    samples, mass, element, friction = 201, 480.0, SpringDamper(1.2e6, 4.0e3), (350.0, 0.004)
    parts = LawAlongMotion(law("coulomb_friction"), np.zeros((1, 9)), np.zeros((1, 9)), RATE).parts
    fine = rubbing(parts, samples, mass, element, friction)[:, : (samples - 1) * parts + 1]
    deflection, rate, truth = (band_limited(x[None], parts) for x in fine)
    at = [np.array([[x]]) for x in friction], SpringDamper(*(np.array([[x]]) for x in element)), np.zeros(1)
    along = LawAlongMotion(law("coulomb_friction"), deflection, rate, RATE)

    def error() -> float:
        return float(np.sqrt(np.mean((along.force(*at) - truth)[0, 12:-12] ** 2)))

    before = error()
    add_motion_between_samples([along], [at], np.array([[[1 / mass]]]))
    assert before > 0.015 * friction[0]
    assert error() < 0.35 * before


@pytest.mark.parametrize("share", [0.1, 0.2, 0.3])
def test_the_motion_that_a_sharpened_spline_makes_of_a_tone_is_right_at_the_samples(share: float) -> None:
    """A mass under the force: the second integral of the spline, against that of the tone itself."""
    time = np.arange(200.0)
    w = 2 * np.pi * share
    tone = np.sin(w * time + 0.4)

    def off(force: FloatArray) -> float:
        moved = CubicSpline(time, force).antiderivative(2)(time)
        drift = np.polynomial.Polynomial.fit(time, left := (moved + tone / w**2), 1)(time)
        return float(np.abs(left - drift)[20:-20].max() * w**2)

    assert off(spline_compensation(200) @ tone) < 0.01
    assert share < 0.2 or off(spline_compensation(200) @ tone) < 0.35 * off(tone)


def test_hysteresis_that_yields_within_a_sample_is_followed(monkeypatch: pytest.MonkeyPatch) -> None:
    """0.3 mm are passed in 4 ms, samples are 10 ms apart; beside it, a grid sixteen times finer than a sample."""
    time = np.arange(200) / RATE
    deflection, rate = np.zeros(200), np.zeros(200)
    for w, phase in ((11.0, 0.3), (34.0, 1.1), (73.0, 2.0)):
        deflection += 0.06 / w * np.sin(w * time + phase)
        rate += 0.06 * np.cos(w * time + phase)
    values, element = [np.full((1, 1), x) for x in (4.5e5, 6e6, 2.0)], SpringDamper(1.2e6, 4e3)

    def force() -> np.ndarray:
        return LawAlongMotion(law("bouc_wen"), deflection[None], rate[None], RATE).force(values, element, np.zeros(1))

    ours = force()
    monkeypatch.setattr(law_forces, "_OVERSAMPLING_MEMORY", 16)
    fine = force()
    assert np.std(ours - fine) < 0.01 * np.std(fine)

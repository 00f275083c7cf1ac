"""What a motion does between samples, and what its noise and sampling leave open of the laws along it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sprung.model.diagnosis.force.deviations import covariance, left_open
from sprung.model.diagnosis.force.fit import NO_LAWS, ComponentTask, fitted, refined
from sprung.model.diagnosis.force.motion import element_motion
from sprung.model.diagnosis.force.pieces import PIECES
from sprung.model.laws.paths import presliding_path

REACH, FORCE = 4e-4, 150.0
DAHL = next(piece for piece in PIECES if piece.effect == "dahl")


def shaken(rate: float, seconds: float = 20.0) -> np.ndarray:
    t = np.arange(int(seconds * rate)) / rate
    sines = ((0.008, 0.7, 0.2), (0.004, 2.3, 1.1), (0.002, 4.7, 2.0))
    return np.asarray(sum(size * np.sin(2 * np.pi * f * t + phase) for size, f, phase in sines))


def test_a_memory_turns_between_samples() -> None:
    exact = presliding_path(shaken(6400.0), REACH)[::64]
    motion = element_motion(shaken(100.0), None, 100.0)
    column = DAHL.columns(motion, (REACH,))[:, 0]
    assert np.std(column - exact) < 0.004
    coarse = presliding_path(shaken(100.0), REACH)
    assert np.std(column - exact) < 0.2 * np.std(coarse - exact)


@pytest.mark.parametrize("stride", [2, 3, 8])
def test_a_thinned_motion_is_still_followed_between_its_samples(stride: int) -> None:
    motion = element_motion(shaken(800.0), None, 800.0)
    whole, thinned = DAHL.columns(motion, (REACH,)), DAHL.columns(motion.every(stride), (REACH,))
    assert np.std(whole[::stride] - thinned) < 0.01


@pytest.mark.parametrize("noise", [1e-6, 3e-5])
def test_noise_and_sampling_are_in_the_deviations(noise: float) -> None:
    random, rate = np.random.default_rng(5), 100.0
    force = (2e4 * shaken(6400.0) + FORCE * presliding_path(shaken(6400.0), REACH))[::64]
    motion = element_motion(shaken(rate) + noise * random.standard_normal(len(force)), None, rate)
    task = ComponentTask(motion, force + 0.2 * random.standard_normal(len(force)), int(0.7 * len(force)))
    fit = refined(task, fitted(task, NO_LAWS.plus(DAHL, (2 * REACH,))).model)
    full = covariance(fit)[0] + left_open(fit)
    found = np.array([fit.strengths[0], fit.model.shapes[0][0]])
    deviation = np.sqrt(np.diag(full))[-2:]
    assert np.all(np.abs(found - (FORCE, REACH)) < 3 * deviation)
    assert np.all(deviation < 0.1 * found)


def test_a_motion_without_noise_is_made_no_noisier() -> None:
    motion = element_motion(shaken(100.0), None, 100.0)
    for deflection, rate in ((0.0, 0.0), (1e-5, 0.0), (1e-5, 1e-9)):
        quiet = replace(motion, deflection_noise=deflection, rate_noise=rate)
        assert np.array_equal(quiet.noisier().deflection, motion.deflection)
    moved = replace(motion, deflection_noise=1e-4, rate_noise=1e-3).noisier()
    assert np.std(moved.deflection - motion.deflection) == pytest.approx(1e-4)
    assert np.std(moved.rate - motion.rate) == pytest.approx(1e-3, rel=0.2)


@pytest.mark.parametrize(
    ("motion", "repeats"), [("sine", True), ("two amplitudes", False), ("sweep", False), ("several sines", False)]
)
def test_one_cycle_again_and_again_is_distinguished_from_other_motion(motion: str, repeats: bool) -> None:
    t = np.arange(4000) / 200.0
    sine = 0.01 * np.sin(2 * np.pi * 1.3 * t)
    shapes = {
        "sine": sine,
        "two amplitudes": np.where(t < 10, 0.6, 1.0) * sine,
        "sweep": 0.01 * np.sin(2 * np.pi * (0.5 + 0.1 * t) * t),
        "several sines": shaken(200.0),
    }
    noise = 1e-5 * np.random.default_rng(0).standard_normal(len(t))
    assert element_motion(shapes[motion] + noise, None, 200.0).repeats() is repeats

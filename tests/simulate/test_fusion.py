"""Displacement and velocity fused."""

import numpy as np

from sprung.model.signals import FloatArray
from sprung.model.simulate.fusion import motion, motion_noise

NOISE = {0: 1e-5, 1: 5e-4}


def test_smooth_motion_passes_unchanged() -> None:
    t = np.arange(400) / 100
    for frequency in (0.5, 5, 15):
        w = 2 * np.pi * frequency
        d, v = motion({0: np.sin(w * t), 1: w * np.cos(w * t)}, 0.01, NOISE)
        assert np.abs(d - np.sin(w * t))[20:-20].max() < 1e-3
        assert np.abs(v - w * np.cos(w * t))[20:-20].max() < 1e-3 * w


def test_remaining_noise_has_the_stated_spectrum() -> None:
    rng = np.random.default_rng(0)
    d, _ = motion({order: std * rng.standard_normal((400, 256)) for order, std in NOISE.items()}, 0.01, NOISE)
    power = (np.abs(np.fft.rfft(d[:, 28:-28] * np.hanning(200), axis=1)) ** 2).mean(axis=0) / (
        np.hanning(200) ** 2
    ).sum()
    frequency: FloatArray = np.fft.rfftfreq(200, 0.01).astype(float)
    stated = motion_noise(2 * np.pi * frequency, 0.01, NOISE) ** 2
    band = (frequency > 2) & (frequency < 30)
    assert np.abs(power[band] / stated[band] - 1).max() < 0.25
    assert abs((power[band] / stated[band]).mean() - 1) < 0.03


def test_long_and_short_records_are_smoothed_alike() -> None:
    rng = np.random.default_rng(1)
    d, v = rng.standard_normal(700), 100 * rng.standard_normal(700)
    long, _ = motion({0: d, 1: v}, 0.01, {0: 1.0, 1: 100.0})
    short, _ = motion({0: d[:500], 1: v[:500]}, 0.01, {0: 1.0, 1: 100.0})
    assert np.allclose(long[:400], short[:400], atol=1e-7)

"""Motion of a support from its acceleration alone: integrated twice above the lowest frequency of the test.

Noise of variance N per bin becomes N / w^4 in the deflection, so that drift dominates at low frequencies.  Motion and
force are high-pass filtered alike, which preserves their linear relation.  The transients of the filter at both ends
are cut off.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import median_filter, uniform_filter1d

from sprung.model.diagnosis.force.motion import without_gaps
from sprung.model.diagnosis.record.white_noise import white_noise
from sprung.model.diagnosis.rules import RULES, Rules
from sprung.model.signals import FloatArray

_RAMP = 0.6  # of the lowest frequency, start of the filter's transition


@dataclass(frozen=True)
class IntegratedMotion:
    """Motion from an acceleration; NaN at the ends."""

    displacement: FloatArray  # m, (T,)
    velocity: FloatArray  # m/s, (T,)
    displacement_noise: float  # m
    velocity_noise: float  # m/s
    lowest: float  # Hz, edge of the filter


def integrated(acceleration: FloatArray, sample_rate: float, all_rules: Rules = RULES) -> IntegratedMotion | None:
    """Motion from an acceleration (T,), m/s^2; None if it contains nothing but noise."""
    rules, good = all_rules.component, np.isfinite(acceleration)
    at = np.arange(len(acceleration))
    series = without_gaps(acceleration)
    series = series - series.mean()
    whole, frequency = _mirrored(series, sample_rate)
    spectrum = np.fft.rfft(whole)
    noise = white_noise(series, all_rules.white_noise)
    lowest = _lowest(
        np.abs(spectrum) ** 2 / len(whole),
        frequency,
        rules.stands_clear * max(noise**2, 1e-300),
        rules.periods * sample_rate / len(series),
    )
    if lowest is None:
        return None
    passed = _passed(frequency, lowest)
    omega = 2 * np.pi * np.maximum(frequency, _RAMP * lowest)  # limits the gain in the stop band
    here = slice(len(series) - 1, 2 * len(series) - 1)
    velocity, displacement = (
        np.fft.irfft(spectrum * passed / (1j * omega) ** power, len(whole))[here] for power in (1, 2)
    )
    deviations = [noise * float(np.sqrt(2 * np.sum((passed / omega**p) ** 2) / len(whole))) for p in (1, 2)]
    lost = int(rules.integral_settled * sample_rate / lowest)
    known = good & (at >= lost) & (at < len(series) - lost)
    return IntegratedMotion(
        np.where(known, displacement, np.nan), np.where(known, velocity, np.nan), deviations[1], deviations[0], lowest
    )


def without_slow(series: FloatArray, sample_rate: float, lowest: float) -> FloatArray:
    """A force (T,) filtered like a motion with the given lowest frequency, Hz; gaps are kept."""
    whole, frequency = _mirrored(without_gaps(series), sample_rate)
    fast = np.fft.irfft(np.fft.rfft(whole) * _passed(frequency, lowest), len(whole))
    return np.where(np.isfinite(series), fast[len(series) - 1 : 2 * len(series) - 1], np.nan)


def _mirrored(series: FloatArray, sample_rate: float) -> tuple[FloatArray, FloatArray]:
    """A series extended by its mirror image at both ends, and the frequencies of its spectrum, Hz."""
    whole = np.concatenate([series[:0:-1], series, series[-2::-1]])
    return whole, np.asarray(np.fft.rfftfreq(len(whole), 1 / sample_rate), dtype=np.float64)


def _passed(frequency: FloatArray, lowest: float) -> FloatArray:
    ramp: FloatArray = np.clip((frequency / lowest - _RAMP) / (1 - _RAMP), 0.0, 1.0)
    return np.asarray(0.5 - 0.5 * np.cos(np.pi * ramp))


def _lowest(power: FloatArray, frequency: FloatArray, clear: float, least: float) -> float | None:
    """The lowest frequency, Hz, of the band with power per bin well above the noise."""
    smooth = uniform_filter1d(median_filter(power, size=5), size=max(5, 2 * len(power) // 1000) | 1)
    out = np.flatnonzero((smooth > clear) & (frequency >= least))
    return float(frequency[out[0]]) if len(out) else None

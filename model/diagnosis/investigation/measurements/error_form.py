"""The form of a sensor's error, in words: cut off, a tone, another channel's signal, in moments, or its band."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from sprung.model.diagnosis.record.spectra import main_band
from sprung.model.signals import FloatArray

_REPEATED, _CROWDED = 5, 3.0  # samples at an extreme value, and times as many as at the next one
_TONE, _OF_TONE = 2, 0.8  # bins beside its own, that a tone leaks into, and its share of the power beyond the noise
_OFFSET = 0.5  # of an error's power
_PERIODS = 5  # of a tone within the record, at least
_COPY = 0.9  # correlation with another signal
_BRIEF = 0.1  # of the samples, in which most of the power is


def form_of(
    true: FloatArray, shown: FloatArray, others: Mapping[str, FloatArray], sample_rate: float, unit: str
) -> str:
    """What the error of a sensor looks like, in words.

    true, shown: what it should show and what it does, (T,), of that unit; others: other sensors' signals (T,), by name.
    """
    error = shown - true
    level = cut_off(shown)
    if level is not None:
        return f"it is cut off at {level:.3g} {unit}"
    offset = float(np.mean(error))
    if offset**2 > _OFFSET * np.mean(error**2):
        return f"off by {offset:.2g} {unit}"
    tone = _tone(error, sample_rate)
    if tone is not None:
        return f"a tone at {tone[0]:.3g} Hz of {tone[1]:.2g} {unit}"
    copied = _copied(error, {"": true}) or _copied(error, others)
    if copied is not None:
        source, factor = copied
        return f"{factor:.2g} times what {source} shows" if source else f"its gain comes to {1 + factor:.3g}"
    power = np.sort(error**2)[::-1]
    brief = int(np.searchsorted(np.cumsum(power), 0.9 * np.sum(power))) / len(error)
    low, high = main_band(error, sample_rate)
    band = f"most of it at {low:.3g} to {high:.3g} Hz"
    return f"{band} and within {100 * brief:.2g} % of the time" if brief < _BRIEF else band


def cut_off(shown: FloatArray) -> float | None:
    """The level at which a signal (T,) is cut off; None if it is not.

    There its extreme value repeats, which it does more often than the value next to it, as a rounded one would.
    """
    values, counts = np.unique(shown, return_counts=True)
    if len(values) < _REPEATED:
        return None
    ends = [(counts[-1], counts[-2], values[-1]), (counts[0], counts[1], values[0])]
    found = [(count, level) for count, beside, level in ends if count >= _REPEATED and count > _CROWDED * beside]
    return float(abs(max(found)[1])) if found else None


def _tone(error: FloatArray, sample_rate: float) -> tuple[float, float] | None:
    """Frequency (Hz) and amplitude of a tone that is most of an error beyond its noise; None if none is."""
    power = np.abs(np.fft.rfft(error * np.hanning(len(error))))[1:] ** 2
    noise = float(np.median(power)) / np.log(2)  # of an exponential distribution
    peak = int(np.argmax(power))
    near = power[max(0, peak - _TONE) : peak + _TONE + 1]
    of_tone, beyond = float(np.sum(near - noise)), float(np.sum(power - noise))
    if peak + 1 < _PERIODS or of_tone < _OF_TONE * beyond or of_tone < _OF_TONE * noise * len(power) ** 0.5:
        return None
    amplitude = np.sqrt(of_tone / 6) * 8 / len(error)  # of Hann's window: 6 = (2^2 + 1 + 1), half its height is 1/4
    return (peak + 1) * sample_rate / len(error), float(amplitude)


def _copied(error: FloatArray, others: Mapping[str, FloatArray]) -> tuple[str, float] | None:
    """The other signal of which an error is a copy, and the factor; None if it is of none."""
    best: tuple[float, str, float] = (0.0, "", 0.0)
    for name, signal in others.items():
        product, square = float(error @ signal), float(signal @ signal)
        correlation = product**2 / max(square * float(error @ error), 1e-300)
        best = max(best, (correlation, name, product / max(square, 1e-300)))
    return (best[1], best[2]) if best[0] > _COPY**2 else None

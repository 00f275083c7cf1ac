"""What a measuring channel makes of a signal: gain, first-order lag, delay and offset, and the way back."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sprung.model.signals import FloatArray

_PAD = 64  # samples mirrored at both ends, so that a shift in the frequency domain does not wrap round


class SensorResponse(NamedTuple):
    """What a measurement shows of the truth: gain e^{-s delay} / (1 + s lag) truth + offset."""

    gain: float = 1.0
    lag: float = 0.0  # s, time constant
    delay: float = 0.0  # s
    offset: float = 0.0


def passed(truth: FloatArray, response: SensorResponse, sample_rate: float) -> FloatArray:
    """What a channel shows of the truth (..., T)."""
    late = _filtered(truth, sample_rate, response.lag, response.delay, 1) if response.lag or response.delay else truth
    return response.gain * late + response.offset


def undone(shown: FloatArray, response: SensorResponse, sample_rate: float) -> FloatArray:
    """The true signal of a shown one (..., T); the inverse of a lag amplifies noise like a derivative."""
    late = (shown - response.offset) / response.gain
    return _filtered(late, sample_rate, response.lag, response.delay, -1) if response.lag or response.delay else late


def _filtered(signal: FloatArray, sample_rate: float, lag: float, delay: float, power: int) -> FloatArray:
    """(e^{-s delay} / (1 + s lag))^power of a signal (..., T), power 1 or -1.

    Both ends are continued by point reflection, so that values and slopes run on; the first and last few samples
    are as good as that continuation.
    """
    signal = np.asarray(signal, dtype=float)
    n = signal.shape[-1]
    pad = min(_PAD, n - 1)
    head = 2 * signal[..., :1] - signal[..., pad:0:-1]
    tail = 2 * signal[..., -1:] - signal[..., -2 : -pad - 2 : -1]
    padded = np.concatenate([head, signal, tail], axis=-1)
    size = padded.shape[-1]
    ramp = np.linspace(0, 1, size)  # takes out the step between the two ends; a ramp is only late
    trend = padded[..., :1] + (padded[..., -1:] - padded[..., :1]) * ramp
    slope = (padded[..., -1:] - padded[..., :1]) * (sample_rate / (size - 1))
    s = 2j * np.pi * np.fft.rfftfreq(size, 1 / sample_rate)
    response = (np.exp(-s * delay) / (1 + s * lag)) ** power
    shifted = np.fft.irfft(np.fft.rfft(padded - trend, axis=-1) * response, size, axis=-1)
    found: FloatArray = (shifted + trend - power * slope * (delay + lag))[..., pad : pad + n]
    return found

"""Filters and windows of `scipy.signal`, which is imported when one is first needed.

It brings half of SciPy, for half a second of processor time; a service or replica whose vehicles have no laws needs
none of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from sprung.model.signals import FloatArray

Coefficients = Sequence[float] | FloatArray


def _signal() -> Any:
    from scipy import signal

    return signal


def preload() -> None:
    """Import now what the first filter would have to wait for."""
    _signal()


def lfilter(numerator: Coefficients, denominator: Coefficients, series: FloatArray) -> FloatArray:
    """A series (T,) through a digital filter at rest."""
    found: FloatArray = _signal().lfilter(numerator, denominator, series)
    return found


def lfilter_from(
    numerator: Coefficients, denominator: Coefficients, series: FloatArray, state: Coefficients
) -> FloatArray:
    """The same of a series (T,) from a state (order,) of the filter, as `lfilter_zi` has it."""
    found: FloatArray = _signal().lfilter(numerator, denominator, series, zi=state)[0]
    return found


def lfilter_zi(numerator: Coefficients, denominator: Coefficients) -> FloatArray:
    """The state (order,) of a filter that has seen ones for ever."""
    found: FloatArray = _signal().lfilter_zi(numerator, denominator)
    return found


def firwin(taps: int, cutoff: float, window: Any, rate: float = 2.0) -> FloatArray:
    """A low-pass of linear phase, its taps (N,).

    cutoff: in the unit of `rate`, the sample rate; left out, in half of that.
    """
    found: FloatArray = _signal().firwin(taps, cutoff, window=window, fs=rate)
    return found


def low_pass(passed: float, stopped: float, attenuation: float, rate: float, multiple: int = 1) -> FloatArray:
    """The taps (2 h + 1,) of a low-pass of linear phase behind a Kaiser window; h is a multiple of `multiple`.

    passed, stopped: edges of pass band and stop band, in the unit of `rate`, the sample rate; attenuation: dB.
    """
    taps, beta = _signal().kaiserord(attenuation, (stopped - passed) / (rate / 2))
    half = -(-(int(taps) // 2 + 1) // multiple) * multiple
    return firwin(2 * half + 1, (passed + stopped) / 2, ("kaiser", float(beta)), rate)


def upfirdn(taps: FloatArray, series: FloatArray, up: int = 1, down: int = 1) -> FloatArray:
    """A series (T, ...) at `up` times its rate through a filter, of which one sample of `down` is kept."""
    found: FloatArray = _signal().upfirdn(taps, series, up, down, axis=0)
    return found


def tukey(samples: int, edge: float) -> FloatArray:
    """A window (samples,) with cosines at both ends, together the share `edge` of it."""
    found: FloatArray = _signal().windows.tukey(samples, edge)
    return found


def analog_bandpass(order: int, low: float, high: float, omega: FloatArray) -> np.ndarray:
    """The response of a Butterworth band-pass at angular frequencies (F,); low, high: its edges, rad/s."""
    zeros, poles, gain = _signal().butter(order, [low, high], "bandpass", analog=True, output="zpk")
    found: np.ndarray = _signal().freqs_zpk(zeros, poles, gain, omega)[1]
    return found


def welch(series: FloatArray, **how: Any) -> tuple[FloatArray, FloatArray]:
    """Frequencies (F,) and power spectral density (F,) of a series (T,), as `scipy.signal.welch` has them."""
    found: tuple[FloatArray, FloatArray] = _signal().welch(series, **how)
    return found

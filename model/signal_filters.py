"""Filters and windows of `scipy.signal`, which is imported when one is first needed.

It brings half of SciPy, for half a second of processor time; a service or replica whose vehicles have no laws needs
none of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from sprung.model.signals import FloatArray

Coefficients = Sequence[float] | FloatArray


def _signal() -> Any:
    from scipy import signal

    return signal


def lfilter(numerator: Coefficients, denominator: Coefficients, series: FloatArray) -> FloatArray:
    """A series (T,) through a digital filter at rest."""
    found: FloatArray = _signal().lfilter(numerator, denominator, series)
    return found


def lfilter_from(
    numerator: Coefficients, denominator: Coefficients, series: FloatArray, state: Coefficients
) -> FloatArray:
    """The same from a state of the filter, as `lfilter_zi` has it."""
    found: FloatArray = _signal().lfilter(numerator, denominator, series, zi=state)[0]
    return found


def lfilter_zi(numerator: Coefficients, denominator: Coefficients) -> FloatArray:
    """The state of a filter that has seen ones for ever."""
    found: FloatArray = _signal().lfilter_zi(numerator, denominator)
    return found


def firwin(taps: int, cutoff: float, window: Any) -> FloatArray:
    """A low-pass of linear phase, its taps (N,); cutoff: in half the sample rate."""
    found: FloatArray = _signal().firwin(taps, cutoff, window=window)
    return found


def upfirdn(taps: FloatArray, series: FloatArray, down: int) -> FloatArray:
    """A series through a filter, of which one sample of `down` is kept."""
    found: FloatArray = _signal().upfirdn(taps, series, down=down)
    return found


def tukey(samples: int, edge: float) -> FloatArray:
    """A window (samples,) with cosines at both ends, together the share `edge` of it."""
    found: FloatArray = _signal().windows.tukey(samples, edge)
    return found

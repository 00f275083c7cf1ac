"""What a measuring channel makes of a signal: gain, first-order lag, delay, filters and offset, and the way back."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.polynomial.polynomial import polyval
from numpy.typing import NDArray
from scipy.integrate import cumulative_trapezoid

from sprung.model.signals import FloatArray

ComplexArray = NDArray[np.complexfloating[Any, Any]]
_PAD = 64  # samples mirrored at both ends, so that a shift in the frequency domain does not wrap round


class FilterSection(NamedTuple):
    """A filter of first or second order, n(s) / d(s), with coefficients of rising powers of s; d(0) > 0.

    A high-pass filter has the last term of d(s) as its n(s), other filters pass what is constant: n(0) > 0.
    """

    numerator: tuple[float, ...]
    denominator: tuple[float, ...]

    @property
    def order(self) -> int:
        """Number of its states."""
        return len(self.denominator) - 1

    def at(self, s: ComplexArray) -> ComplexArray:
        """Frequency response at complex frequencies of any shape, rad/s."""
        found: ComplexArray = polyval(s, self.numerator) / polyval(s, self.denominator)
        return found

    def expanded(self, count: int) -> FloatArray:
        """The first coefficients of its power series in s, (count,): its steady response to polynomials."""
        left = np.zeros(count)
        left[: len(self.numerator)] = self.numerator[:count]
        found = np.zeros(count)
        for k in range(count):
            found[k] = left[k] / self.denominator[0]
            reach = min(len(self.denominator), count - k)
            left[k : k + reach] -= found[k] * np.array(self.denominator[:reach])
        return found

    def of_matrix(self, rows: FloatArray, A: FloatArray) -> FloatArray:
        """Its steady response to rows e^{A t}, as rows at t = 0: (..., N) of A (N, N)."""
        up: FloatArray = np.zeros_like(rows)
        down: FloatArray = np.zeros_like(A)
        for coefficient in reversed(self.numerator):
            up = up @ A + coefficient * rows
        for coefficient in reversed(self.denominator):
            down = down @ A + coefficient * np.eye(len(A))
        return np.asarray(np.linalg.solve(down.T, up.T).T)

    def companion(self) -> FloatArray:
        """State matrix (order, order) of its free motion, whose first state is what it shows."""
        A = np.eye(self.order, k=1)
        A[-1] = -np.array(self.denominator[:-1]) / self.denominator[-1]
        return A


def high_pass_section(corner: float, damping_ratio: float | None = None) -> tuple[FilterSection, ...]:
    """A high-pass filter with its corner in Hz, of second order if it has a damping ratio; none where that is 0."""
    if corner <= 0:
        return ()
    w = 2 * np.pi * corner
    if damping_ratio is None:
        return (FilterSection((0.0, 1.0), (w, 1.0)),)
    return (FilterSection((0.0, 0.0, 1.0), (w**2, 2 * damping_ratio * w, 1.0)),)


def resonance_section(frequency: float, damping_ratio: float, *, of_base: bool = False) -> tuple[FilterSection, ...]:
    """A resonance between a surface and what is measured of it, in Hz; none where that is infinite.

    of_base: whether its damper acts against the surface, as a bracket's does, and not within the instrument.
    """
    if not np.isfinite(frequency):
        return ()
    w = 2 * np.pi * frequency
    damper = 2 * damping_ratio / w
    return (FilterSection((1.0, damper) if of_base else (1.0,), (1.0, damper, w**-2)),)


class SensorResponse(NamedTuple):
    """What a measurement shows of the truth: gain e^{-s delay} / (1 + s lag) sections(s) truth + offset."""

    gain: float = 1.0
    lag: float = 0.0  # s, time constant
    delay: float = 0.0  # s
    offset: float = 0.0
    sections: tuple[FilterSection, ...] = ()  # one after the other


def passed(truth: FloatArray, response: SensorResponse, sample_rate: float) -> FloatArray:
    """What a channel shows of the truth (..., T)."""
    late = _filtered(truth, sample_rate, response.lag, response.delay, 1) if response.lag or response.delay else truth
    for section in response.sections:
        late = _through(late, section, sample_rate)
    return response.gain * late + response.offset


def undone(shown: FloatArray, response: SensorResponse, sample_rate: float) -> FloatArray:
    """The true signal of a shown one (..., T); the inverse of a lag amplifies noise like a derivative.

    The inverse of a high-pass filter integrates: what is constant in the true signal is not known, and begins at none.
    """
    late = (shown - response.offset) / response.gain
    for section in response.sections:
        late = _before(late, section, sample_rate)
    return _filtered(late, sample_rate, response.lag, response.delay, -1) if response.lag or response.delay else late


def _through(truth: FloatArray, section: FilterSection, sample_rate: float) -> FloatArray:
    """What a filter shows of a signal (..., T) before which it saw the same signal backwards."""
    return _mirrored(truth, section.at, sample_rate)


def _before(shown: FloatArray, section: FilterSection, sample_rate: float) -> FloatArray:
    """The signal before a filter (..., T)."""
    if section.numerator[0]:
        return _mirrored(shown, lambda s: 1 / section.at(s), sample_rate)
    result, integral = shown, shown
    for coefficient in reversed(section.denominator[:-1]):
        integral = cumulative_trapezoid(integral, dx=1 / sample_rate, axis=-1, initial=0)
        result = result + coefficient * integral
    return result


def _mirrored(signal: FloatArray, response: Callable[[ComplexArray], ComplexArray], sample_rate: float) -> FloatArray:
    """A signal (..., T) through a frequency response, continued by its own reflection."""
    signal = np.asarray(signal, dtype=float)
    both = np.concatenate([signal, signal[..., ::-1]], axis=-1)
    size = both.shape[-1]
    s = 2j * np.pi * np.fft.rfftfreq(size, 1 / sample_rate)
    found: FloatArray = np.fft.irfft(np.fft.rfft(both, axis=-1) * response(s), size, axis=-1)
    return found[..., : signal.shape[-1]]


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

"""Discrete Fourier transforms of finite records, arranged so that a linear system maps bin to bin.

A record of N samples is written as  polynomial + periodic remainder.  The polynomial matches value and slope at
both ends, so the remainder continues smoothly around the record and its transform is mapped by the frequency
response G(j omega) without leakage; the polynomial is mapped in closed form (`Plant.polynomial_response`).  What then
remains between the periodic solution and the recorded one is a free motion of the system: 2n numbers.

Transforms are scaled by 1/sqrt(N): white noise of variance s^2 has E|X|^2 = s^2 in every bin.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from sprung.model.signals import FloatArray

ComplexArray = NDArray[np.complexfloating[Any, Any]]

DEGREE = 5  # of the polynomials: quadratic inputs, integrated twice by a free body
OVERSAMPLING = 4  # laws with kinks make harmonics beyond the Nyquist frequency of the record
_MAIN = 0.8  # of the power, in the band that is reported
HIGH_PASS_ORDER = 4  # Butterworth, run forwards and backwards


def high_pass_gain(ratio: FloatArray) -> FloatArray:
    """Gain at frequencies (F,) in units of the cutoff: a Butterworth filter's, squared."""
    power = np.abs(ratio) ** (2 * HIGH_PASS_ORDER)
    gain: FloatArray = power / (1 + power)
    return gain


@dataclass(frozen=True)
class Grid:
    """The time and frequency grid of one record part: N samples every `step` seconds."""

    samples: int
    step: float
    start: float = 0.0  # s, time of the first sample of this part since the start of the recording
    compared: float = 0.3  # of the sample rate, up to which spectra are compared
    cutoff: float = 0.0  # Hz, of the high-pass filter that all signals have passed (`highpass`); 0: none

    @cached_property
    def omega(self) -> FloatArray:
        """Angular frequencies of the bins, rad/s, shape (F,)."""
        return np.asarray(2 * np.pi * np.fft.rfftfreq(self.samples, self.step), dtype=np.float64)

    @property
    def nyquist(self) -> float:
        """Half of the sample rate, Hz."""
        return 0.5 / self.step

    @cached_property
    def band(self) -> slice:
        """Bins that are compared."""
        return slice(0, max(2, int(self.compared * self.samples)))

    @cached_property
    def weight(self) -> FloatArray:
        """sqrt of the real degrees of freedom of each compared bin: 1 for zero frequency, else sqrt 2."""
        weight = np.full(self.band.stop, np.sqrt(2.0))
        weight[0] = 1.0
        return weight

    @cached_property
    def time(self) -> FloatArray:
        """Seconds since the start of this part, shape (N,)."""
        return np.arange(self.samples, dtype=np.float64) * self.step

    @cached_property
    def fine_time(self) -> FloatArray:
        """The oversampled time axis, shape (OVERSAMPLING N,)."""
        return np.arange(OVERSAMPLING * self.samples, dtype=np.float64) * (self.step / OVERSAMPLING)

    @property
    def length(self) -> float:
        return self.samples * self.step

    @cached_property
    def monomials(self) -> FloatArray:
        """(t / length)^k, shape (N, DEGREE + 1)."""
        return np.vander(self.time / self.length, DEGREE + 1, increasing=True)

    @cached_property
    def monomial_spectra(self) -> ComplexArray:
        """Their transforms, shape (F, DEGREE + 1)."""
        return self.forward(self.monomials)

    @cached_property
    def fine_monomials(self) -> FloatArray:
        """(t / length)^k on the oversampled axis, shape (OVERSAMPLING N, DEGREE + 1)."""
        return np.vander(self.fine_time / self.length, DEGREE + 1, increasing=True)

    def forward(self, series: FloatArray) -> ComplexArray:
        """Transform along the first axis: (N, ...) -> (F, ...)."""
        found: ComplexArray = scipy.fft.rfft(series, axis=0, norm="ortho")
        return found

    def inverse(self, spectrum: ComplexArray) -> FloatArray:
        """(F, ...) -> (N, ...)."""
        found: FloatArray = scipy.fft.irfft(spectrum, self.samples, axis=0, norm="ortho")
        return found

    def fine(self, spectrum: ComplexArray) -> FloatArray:
        """Band-limited series on the oversampled axis: (F, ...) -> (OVERSAMPLING N, ...)."""
        found: FloatArray = scipy.fft.irfft(spectrum, OVERSAMPLING * self.samples, axis=0) * (
            OVERSAMPLING * np.sqrt(self.samples)
        )
        return found

    @cached_property
    def _law_gain(self) -> FloatArray | None:
        """Gain of the signals' high-pass filter over the bins of the oversampled axis, (2N + 1,); None without one."""
        if not self.cutoff:
            return None
        bins = np.fft.rfftfreq(OVERSAMPLING * self.samples, self.step / OVERSAMPLING)
        return high_pass_gain(np.asarray(bins / self.cutoff, dtype=np.float64))

    def law_transform(self, forces: FloatArray, axis: int = 0) -> ComplexArray:
        """Transform of oversampled forces of laws along an axis, 4N -> 2N + 1 bins, not scaled, as the signals show it.

        Signals behind a high-pass filter show of the forces what passes it, too.
        """
        found: ComplexArray = scipy.fft.rfft(forces, axis=axis)
        if self._law_gain is None:
            return found
        return found * self._law_gain.reshape((-1,) + (1,) * (found.ndim - 1 - axis))

    def split_law_forces(self, forces: FloatArray) -> tuple[ComplexArray, FloatArray]:
        """Periodic part of oversampled forces of laws (4N, m), as `law_transform`, and polynomial, (DEGREE + 1, m).

        The polynomial consists of the line through both ends and the mean of the remainder; it does not pass a
        high-pass filter.
        """
        line = np.zeros((DEGREE + 1, forces.shape[1]))
        line[1] = forces[-1] - forces[0]
        rest = forces - self.fine_monomials[:, 1:2] * line[1]
        line[0] = rest.mean(axis=0)
        periodic = self.law_transform(rest - line[0])
        return periodic, np.zeros_like(line) if self.cutoff else line

    def coarse_forces(self, forces: FloatArray) -> ComplexArray:
        """Transform of oversampled forces of laws, (4N, ...) -> (F, ...), up to the record's Nyquist frequency."""
        found: ComplexArray = self.law_transform(forces)[: len(self.omega)] / (OVERSAMPLING * np.sqrt(self.samples))
        return found

    def compared_forces(self, forces: FloatArray) -> ComplexArray:
        """Compared bins of oversampled forces of laws, (m, 4N) -> (m, compared bins)."""
        full = self.law_transform(forces, axis=1)
        found: ComplexArray = full[:, self.band] / (OVERSAMPLING * np.sqrt(self.samples))
        return found

    def compared_spectra(self, fine_series: FloatArray) -> ComplexArray:
        """Compared bins of oversampled series, (m, OVERSAMPLING N) -> (m, compared bins), in one transform."""
        full = scipy.fft.rfft(fine_series, axis=1)
        found: ComplexArray = full[:, self.band] / (OVERSAMPLING * np.sqrt(self.samples))
        return found

    def pack(self, spectrum: ComplexArray) -> FloatArray:
        """Compared bins of whitened spectra (F, S, ...) as real vectors (2 F S, ...) of unit-variance noise."""
        shape = (-1,) + (1,) * (spectrum.ndim - 1)
        weighted = spectrum[self.band] * self.weight.reshape(shape)
        real, imag = weighted.real, weighted.imag
        flat = (-1, *spectrum.shape[2:])
        return np.concatenate([real.reshape(flat), imag.reshape(flat)])

    def unpack(self, packed: FloatArray, sensors: int) -> ComplexArray:
        """Compared bins (F, S) of one packed vector (2 F S,)."""
        real, imag = packed.reshape(2, -1, sensors)
        found: ComplexArray = np.empty(real.shape, dtype=complex)
        found.real, found.imag = real / self.weight[:, None], imag / self.weight[:, None]
        return found


@dataclass(frozen=True)
class ThinnedGrid(Grid):
    """A regular subset of the compared bins without zero frequency, for responses only."""

    stride: int = 1

    @cached_property
    def omega(self) -> FloatArray:
        """Angular frequencies of those bins, rad/s."""
        bins = np.fft.rfftfreq(self.samples, self.step)[self.band][self.stride :: self.stride]
        return np.asarray(2 * np.pi * bins, dtype=np.float64)


def derivative(polynomial: FloatArray, length: float) -> FloatArray:
    """Time derivative of polynomials over t / length, (DEGREE + 1, ...)."""
    result = np.zeros_like(polynomial)
    orders = np.arange(1, len(polynomial)).reshape((-1,) + (1,) * (polynomial.ndim - 1))
    result[:-1] = polynomial[1:] * orders / length
    return result


def detrend_ends(series: FloatArray, slopes: tuple[FloatArray, FloatArray] | None, grid: Grid) -> FloatArray:
    """Polynomial coefficients over t / length that make the remainder continue around the record.

    `series` (N, m); `slopes` its derivative at the first and last sample (each (m,), per second), where measured.
    Returns (DEGREE + 1, m): quadratic with slopes, linear without, and a constant that leaves no mean.
    The period is N steps, so the value after the last sample is extrapolated from the end.
    """
    n, length = grid.samples, grid.length
    coefficients = np.zeros((DEGREE + 1, series.shape[1]))
    if slopes is None:
        after = 2 * series[-1] - series[-2] if n > 2 else series[-1]
        coefficients[1] = after - series[0]
    else:
        first, last = slopes
        after = series[-1] + last * grid.step
        jump, bend = after - series[0], (last - first) * length
        # p(1) - p(0) = jump and p'(1) - p'(0) = bend with p = a t + b t^2
        coefficients[2] = bend / 2
        coefficients[1] = jump - bend / 2
    remainder = series - grid.monomials @ coefficients
    coefficients[0] = remainder.mean(axis=0)
    return coefficients


def main_band(error: FloatArray, sample_rate: float) -> tuple[float, float]:
    """Band with most of the power of an error (T,), Hz."""
    power = np.abs(np.fft.rfft(error - np.mean(error))) ** 2
    share = np.cumsum(power) / max(float(np.sum(power)), 1e-300)
    frequency = np.fft.rfftfreq(len(error), 1 / sample_rate)
    ends = [(1 - _MAIN) / 2, (1 + _MAIN) / 2]
    low, high = (float(frequency[min(int(np.searchsorted(share, end)), len(frequency) - 1)]) for end in ends)
    return low, high

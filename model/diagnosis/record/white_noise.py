"""White noise of series, from what changes faster than anything mechanical moves."""

from __future__ import annotations

from math import comb

import numpy as np

from sprung.model.signals import FloatArray

_ORDER = 6  # of the differences of which the noise is estimated: they pass motion above a third of the sample rate
_ROUGH_ORDER = 8  # the same for the upper limit of the noise
_BLOCKS = 40  # of them, whose median counts: bursts are no noise
_SAMPLES, _FEWEST = 100, 5  # samples of a block, and blocks at least, whose spectrum is looked at for a filter's cutoff
_EVEN_BANDS = ((0.26, 0.30), (0.30, 0.34), (0.34, 0.38))  # of the sample rate, below the cutoff of any usual filter
_EMPTY_BAND = (0.46, 0.5)  # of the sample rate, beyond it
_EVEN, _EMPTY = 1.8, 0.2  # ratios of power: bands within the first are even, one below the second is empty


def white_noise(series: FloatArray) -> float:
    """Standard deviation of the white noise that a series (T,) carries, from its differences of high order.

    Smooth motion leaves them by its power above about a third of the sample rate only.  Of a series from which a
    filter took what is next to half the sample rate (`_below_the_cutoff`), that of the noise before the filter.
    """
    differences = np.diff(series, _ORDER) ** 2 / comb(2 * _ORDER, _ORDER)
    blocks = np.array_split(differences, min(_BLOCKS, max(1, len(differences) // 10)))
    return max(float(np.sqrt(np.median([block.mean() for block in blocks]))), _below_the_cutoff(series))


def _below_the_cutoff(series: FloatArray) -> float:
    """Standard deviation of white noise that a filter has cut off below half the sample rate, as resampling does.

    Its spectrum is even up to the filter's cutoff and has next to nothing beyond; 0 where it is not.
    """
    count = min(_BLOCKS, len(series) // _SAMPLES)
    if count < _FEWEST:
        return 0.0
    size = len(series) // count
    window = np.hanning(size)
    rest = np.diff(series[: count * size], prepend=series[0]).reshape(count, size)  # what moves slowly leaks less
    frequency = np.fft.rfftfreq(size)
    power = np.abs(np.fft.rfft(rest * window)) ** 2 / np.sum(window**2)
    power[:, 1:] /= (2 * np.sin(np.pi * frequency[1:])) ** 2
    bands = [(frequency >= low) & (frequency < high) for low, high in (*_EVEN_BANDS, _EMPTY_BAND)]
    *even, empty = (float(np.median(power[:, band].mean(axis=1))) for band in bands)
    cut = max(even) < _EVEN * min(even) and empty < _EMPTY * min(even)
    return float(np.sqrt(np.mean(even))) if cut else 0.0


def roughness(series: FloatArray) -> FloatArray:
    """The strongest white noise that series (T, m) can hold, (m,): that of their differences of high order."""
    differences = np.diff(series, _ROUGH_ORDER, axis=0)
    return np.asarray(np.std(differences, axis=0) / np.sqrt(comb(2 * _ROUGH_ORDER, _ROUGH_ORDER)))

"""Single values of a channel that stand out from all its changes: a node's error, and no force or motion.

A single wrong value among thousands outweighs everything that a law explains: the held-out part is then all error.  It
is far from what its neighbours interpolate, while beside it nothing is.  Jumps, as of friction, are not single values,
and so set the scale from which one stands out.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sprung.model.diagnosis.record.white_noise import white_noise
from sprung.model.diagnosis.rules import RULES, Rules
from sprung.model.signals import FloatArray

_WEIGHTS = np.array([-1.0, 4.0, 0.0, 4.0, -1.0]) / 6.0  # of a cubic through two neighbours on either side
_REACH = 2  # samples of it to either side
_MARGIN = 2 * _REACH + 1  # samples between two single values


def without_spikes(series: FloatArray, rules: Rules = RULES) -> tuple[FloatArray, NDArray[np.intp]]:
    """A series (T,) with its single wrong values interpolated, and their indices; gaps (NaN) are kept."""
    finite, none = series[np.isfinite(series)], np.array([], dtype=np.intp)
    if len(finite) < rules.record.minimum_samples:
        return series, none
    away = _away(series)
    largest = _apart(np.abs(away), rules.component.spikes + 1)
    sizes = np.abs(away[largest])
    least = rules.component.spike_noise * white_noise(finite, rules.white_noise)
    for count in range(len(largest) - 1, 0, -1):
        mended, at = series.copy(), largest[:count]
        mended[at] -= away[at]
        left = float(np.nanmax(np.abs(_away(mended))))
        if sizes[count - 1] > max(rules.component.spike * left, least):
            return mended, np.sort(at)
    return series, none


def _away(series: FloatArray) -> FloatArray:
    """How far every value is from what its neighbours interpolate, (T,); 0 at the ends and beside gaps."""
    whole = np.zeros(len(series))
    if len(series) > 2 * _REACH:
        inner = slice(_REACH, len(series) - _REACH)
        whole[inner] = series[inner] - np.convolve(series, _WEIGHTS, "valid")
    return np.nan_to_num(whole, posinf=0.0, neginf=0.0)


def _apart(sizes: FloatArray, count: int) -> NDArray[np.intp]:
    """Where the largest of `sizes` (T,) are, largest first: at most so many, and none beside another."""
    rest, found = sizes.copy(), list[int]()
    while len(found) < count and np.any(rest > 0):
        found.append(int(np.argmax(rest)))
        rest[max(0, found[-1] - _MARGIN) : found[-1] + _MARGIN + 1] = 0.0
    return np.array(found, dtype=np.intp)

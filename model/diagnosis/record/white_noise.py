"""White noise of series, from what changes faster than anything mechanical moves."""

from __future__ import annotations

from itertools import pairwise
from math import comb

import numpy as np

from sprung.model.diagnosis.rules import RULES, WhiteNoiseRules
from sprung.model.signals import FloatArray


def white_noise(series: FloatArray, rules: WhiteNoiseRules = RULES.white_noise) -> float:
    """Standard deviation of the white noise that a series (T,) carries, from its differences of high order.

    Smooth motion leaves them by its power above about a third of the sample rate only.  Of a series from which a
    filter took what is next to half the sample rate (`_below_the_cutoff`), that of the noise before the filter.
    """
    differences = np.diff(series, rules.order) ** 2 / comb(2 * rules.order, rules.order)
    blocks = np.array_split(differences, min(rules.blocks, max(1, len(differences) // 10)))
    return max(float(np.sqrt(np.median([block.mean() for block in blocks]))), _below_the_cutoff(series, rules))


def without_motion(series: FloatArray, motion: FloatArray, rules: WhiteNoiseRules = RULES.white_noise) -> FloatArray:
    """A series (T,) less what is a linear response to a motion (T,) at the highest frequencies.

    What a rig is still driven with there makes forces of inertia and of dampers that are no noise.  A filter of few
    samples either way is fitted to differences of high order, which motion far below hardly enters.
    """
    reach = rules.response
    if len(series) < rules.response_samples * (2 * reach + 1):
        return series
    shifted = np.lib.stride_tricks.sliding_window_view(np.pad(motion, reach, mode="edge"), 2 * reach + 1)
    fast, target = np.diff(shifted, rules.order, axis=0), np.diff(series, rules.order)
    size = np.linalg.norm(fast, axis=0)
    if not np.all(size > 0):
        return series
    response = np.linalg.lstsq(fast / size, target, rcond=rules.response_seen)[0] / size
    return np.asarray(series - shifted @ response)


def _below_the_cutoff(series: FloatArray, rules: WhiteNoiseRules) -> float:
    """Standard deviation of white noise that a filter has cut off below half the sample rate, as resampling does.

    Its spectrum is even up to the filter's cutoff and has next to nothing beyond; 0 where it is not.
    """
    count = min(rules.blocks, len(series) // rules.filtered_samples)
    if count < rules.filtered_blocks:
        return 0.0
    size = len(series) // count
    window = np.hanning(size)
    rest = np.diff(series[: count * size], prepend=series[0]).reshape(count, size)  # what moves slowly leaks less
    frequency = np.fft.rfftfreq(size)
    power = np.abs(np.fft.rfft(rest * window)) ** 2 / np.sum(window**2)
    power[:, 1:] /= (2 * np.sin(np.pi * frequency[1:])) ** 2
    edges = np.linspace(rules.even_from, rules.even_to, 4).round(9).tolist()
    pairs = (*pairwise(edges), (rules.empty_from, 0.5))
    bands = [(frequency >= low) & (frequency < high) for low, high in pairs]
    *even, empty = (float(np.median(power[:, band].mean(axis=1))) for band in bands)
    cut = max(even) < rules.even * min(even) and empty < rules.empty * min(even)
    return float(np.sqrt(np.mean(even))) if cut else 0.0


def roughness(series: FloatArray, rules: WhiteNoiseRules = RULES.white_noise) -> FloatArray:
    """The strongest white noise that series (T, m) can hold, (m,): that of their differences of high order."""
    order = rules.upper_order
    return np.asarray(np.std(np.diff(series, order, axis=0), axis=0) / np.sqrt(comb(2 * order, order)))

"""Choice of the diagnosed stretch of a recording: without standstill, and of limited length."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import uniform_filter1d

from sprung.model.diagnosis.rules import RULES
from sprung.model.signals import BoolArray, FloatArray


def standstill(values: FloatArray, least: int, share: float) -> BoolArray:
    """Mask (T,) of samples at which more than a share of channels (T, C) repeat one value `least` times or more."""
    present = np.isfinite(values).any(axis=0)
    resting = np.zeros(len(values))
    for series in values[:, present].T:
        changes = np.flatnonzero(np.diff(series) != 0) + 1
        edges = np.concatenate([[0], changes, [len(series)]])
        long = np.flatnonzero(np.diff(edges) >= least)
        for run in long:
            resting[edges[run] : edges[run + 1]] += 1
    return np.asarray(resting > share * present.sum())


def at_rest(values: FloatArray, noise: FloatArray, least: int) -> BoolArray:
    """Mask (T,) of the runs of `least` samples or more in which every channel (T, C) shows its noise (C,) alone.

    noise: limit of a channel's deviation over a fifth of that time.  Missing samples count as the channel's median.
    """
    still = np.ones(len(values), dtype=bool)
    span = max(least // 5, 2)
    for series, limit in zip(values.T, noise, strict=True):
        if np.isfinite(series).any():
            moved = np.nan_to_num(series - np.nanmedian(series))
            mean = uniform_filter1d(moved, span, mode="nearest")
            power = uniform_filter1d((moved - mean) ** 2, span, mode="nearest")
            still &= power < limit**2
    edges = np.flatnonzero(np.diff(np.concatenate([[0], still.astype(int), [0]])))
    still[:] = False
    for start, stop in zip(edges[::2], edges[1::2], strict=True):
        if stop - start >= least:  # a stop is over within the time over which it is looked for
            still[max(start - span, 0) : stop + span] = True
    return still


def liveliest(sensors: FloatArray, longest: int, shock: float = RULES.record.shock) -> tuple[int, int]:
    """The stretch of `longest` samples in which the sensors (T, S) move most, relative to their mean power.

    shock: most of its mean power that a sample counts as.
    """
    power = (sensors - np.mean(sensors, axis=0)) ** 2
    mean = power.mean(axis=0)
    level = (power[:, mean > 0] / mean[mean > 0]).mean(axis=1) if np.any(mean > 0) else np.zeros(len(sensors))
    around = uniform_filter1d(np.minimum(level, shock), longest, mode="nearest")
    half = longest // 2
    middle = half + int(np.argmax(around[half : len(sensors) - longest + half + 1]))
    return middle - half, middle - half + longest

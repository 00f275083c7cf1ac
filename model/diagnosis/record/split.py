"""Split of a recording at quiet moments, into lengths with fast transforms.

A part is represented as a parabola plus a periodic remainder.  Faster motion at its ends, such as a wheel on a rail
joint, violates this and leaves errors in the first and last samples of the residual.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import uniform_filter1d

from sprung.model.diagnosis.record.signals import Signals
from sprung.model.diagnosis.rules import RULES, RecordRules
from sprung.model.signals import FloatArray

_PRIMES = (2, 3, 5, 7, 11)  # factors of lengths with fast transforms


def cut(signals: Signals, rules: RecordRules = RULES.record) -> tuple[Signals, int]:
    """A recording cut at quiet moments, and the number of fitted samples: about the first `rules.fitted`."""
    samples = signals.samples
    reach = int(min(rules.cut_seconds * signals.sample_rate, rules.cut_share * samples))
    loud = _loudness(signals, rules.cut_samples)
    first, last = range(reach + 1), range(samples - reach, samples + 1)
    start, stop = _quietest(loud, [(a, b) for a in first for b in last])
    meant = start + round(rules.fitted * (stop - start))
    _, split = _quietest(loud, [(start, b) for b in range(meant - reach, meant + reach + 1)])
    return signals.part(start, stop), split - start


def _quietest(loud: FloatArray, stretches: list[tuple[int, int]]) -> tuple[int, int]:
    """The stretch with the quietest ends among those of fast length; if there is none, the first one, shortened."""
    quick = [(a, b) for a, b in stretches if _is_quick(b - a)]
    if not quick:
        start, stop = stretches[0]
        return next((start, b) for b in range(stop, start, -1) if _is_quick(b - start))
    return min(quick, key=lambda ends: float(loud[ends[0]] + loud[ends[1] - 1]))


def _loudness(signals: Signals, around: int) -> FloatArray:
    """Power of the second differences over `around` samples at every one, each channel over its mean, (T,)."""
    moved = np.where(np.isfinite(signals.velocity), signals.velocity, signals.displacement)
    bends = np.diff(np.column_stack([moved, signals.force, signals.sensors]), 2, axis=0, prepend=0, append=0) ** 2
    bends[[0, -1]] = bends[[1, -2]]
    mean = bends.mean(axis=0)
    power = (bends[:, mean > 0] / mean[mean > 0]).mean(axis=1) if np.any(mean > 0) else np.zeros(len(bends))
    return np.asarray(uniform_filter1d(power, around, mode="nearest"))


def _is_quick(length: int) -> bool:
    for prime in _PRIMES:
        while length % prime == 0 and length:
            length //= prime
    return length == 1

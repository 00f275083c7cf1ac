"""Own baseline of every parameter, and sequential tests for a change from it.

Page's test (CUSUM) on the log-likelihood ratio of "changed by `size`" against "as the baseline", two-sided, on the
marginal of each parameter: the estimate of one parameter is unbiased whatever its neighbours do, so a jump in one
does not alarm another.  Arrays are (..., P): one vehicle, or many at once for Monte Carlo.  Nothing here knows how
windows were made; noise is what `variance` says.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sprung.model.signals import BoolArray, FloatArray, IntArray
from sprung.model.tracking.settings import TrackerSettings, design


@dataclass(frozen=True, slots=True, eq=False)
class Changes:
    """Sums for the baseline and running statistics of the tests."""

    learned: FloatArray  # s of used windows, shape (..., P)
    weight: FloatArray  # sum of 1 / variance, shape (..., P)
    weighted: FloatArray  # sum of log-ratio / variance, shape (..., P)
    up: FloatArray  # log-likelihood ratio for an increase, shape (..., P)
    down: FloatArray
    up_since: IntArray  # ns, when `up` last left zero, shape (..., P)
    down_since: IntArray
    recovery: FloatArray  # log-likelihood ratio for "healthy again", shape (..., P)
    active: NDArray[np.int8]  # -1, 0, +1: the change that is alarmed, shape (..., P)

    @property
    def baseline(self) -> FloatArray:
        """Log-ratio to nominal of the vehicle's own healthy state, shape (..., P); NaN before any window."""
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.where(self.weight > 0, self.weighted / self.weight, np.nan)

    @property
    def baseline_variance(self) -> FloatArray:
        """Shape (..., P); infinite before any window."""
        with np.errstate(divide="ignore"):
            return np.where(self.weight > 0, 1.0 / self.weight, np.inf)

    def shifted(self, by: int) -> Changes:
        """With times that are later by `by`, ns."""
        return replace(self, up_since=self.up_since + by, down_since=self.down_since + by)


def start(shape: tuple[int, ...]) -> Changes:
    zeros = np.zeros(shape)
    since = np.zeros(shape, dtype=np.int64)
    return Changes(zeros, zeros, zeros, zeros, zeros, since, since, zeros, np.zeros(shape, dtype=np.int8))


def update(
    changes: Changes,
    value: FloatArray,  # log-ratios of one window, shape (..., P)
    variance: FloatArray,  # of independent information: scatter and overlap included, shape (..., P)
    mask: BoolArray,  # measured by this window, shape (..., P)
    *,
    seconds: float,  # of signal that no earlier window held
    time: int,  # ns, centre of the window
    settings: TrackerSettings,
    plausible: FloatArray | None = None,  # `value` with outliers pulled in, for the baseline, shape (..., P)
    doubt: FloatArray | float = 0.0,  # variance of the baseline beyond its own, at this window's conditions
) -> Changes:
    """After one window: tests, then learns."""
    armed = mask & (changes.learned >= settings.learning)
    variance = np.where(mask, variance, 1.0)
    tested, highest, threshold = _tested(changes, value, variance, armed, time, settings, doubt)
    quiet = (highest < settings.rules.changes.quiet * threshold) & (tested.active == 0)
    refining = quiet & (changes.weight < settings.baseline_std**-2)
    gain = np.where(mask & (~armed | refining), 1.0 / variance, 0.0)
    return replace(
        tested,
        learned=changes.learned + np.where(mask, seconds, 0.0),
        weight=changes.weight + gain,
        weighted=changes.weighted + gain * np.where(mask, value if plausible is None else plausible, 0.0),
    )


def _tested(
    changes: Changes,
    value: FloatArray,
    variance: FloatArray,
    armed: BoolArray,
    time: int,
    settings: TrackerSettings,
    doubt: FloatArray | float,
) -> tuple[Changes, FloatArray, FloatArray]:
    """Statistics and alarms after one window where `armed`; the larger statistic and the threshold, (..., P)."""
    baseline = changes.weighted / np.maximum(changes.weight, np.finfo(float).tiny)
    spread = 1.0 / np.maximum(changes.weight, settings.prior**-2) + doubt
    size, threshold = design(settings.evidence(value.shape[-1]), settings.change, spread)
    offset = np.where(armed, value - baseline, 0.0)
    scale = np.where(armed, size / variance, 0.0)
    most = threshold / settings.rules.changes.steps
    up = _page(changes.up, scale * (offset - size / 2), most, threshold)
    down = _page(changes.down, scale * (-offset - size / 2), most, threshold)
    highest = np.maximum(up, down)

    closed, active, recovery = np.zeros_like(armed), changes.active, changes.recovery
    if active.any():
        mild = settings.rules.changes.recovery
        healthy = scale * mild * (mild * size / 2 - active * offset)
        recovery = _page(recovery, np.where(active != 0, healthy, 0.0), most, threshold)
        closed = (active != 0) & (recovery >= settings.recovery_evidence)
        active = np.where(closed, 0, active)
    crossed = armed & (active == 0) & ~closed & (highest >= threshold)
    active = np.where(crossed, np.where(up >= down, 1, -1), active).astype(np.int8)
    tested = replace(
        changes,
        up=np.where(closed, 0.0, up),
        down=np.where(closed, 0.0, down),
        up_since=np.where((changes.up == 0) & (up > 0), time, changes.up_since),
        down_since=np.where((changes.down == 0) & (down > 0), time, changes.down_since),
        recovery=np.where(active == 0, 0.0, recovery),
        active=active,
    )
    return tested, highest, threshold


def _page(statistic: FloatArray, increment: FloatArray, most: FloatArray, threshold: FloatArray) -> FloatArray:
    """One step of Page's test; bounded increments, so that one outlying window neither alarms nor clears."""
    bounded = np.minimum(np.maximum(increment, -2.0 * most), most)
    return np.minimum(np.maximum(statistic + bounded, 0.0), 2.0 * threshold)


def restarted(changes: Changes, since: int, reported: BoolArray) -> Changes:
    """Statistics from zero, after a measurement jumped at `since`, ns: what they had gathered was its doing.

    Only changes that are `reported` (..., P), and whose onset lies before the jump, are kept: one that still waits for
    evidence would have to be dated, and a jump is dated too late rather than too early.
    """
    onset = np.where(changes.active > 0, changes.up_since, changes.down_since)
    own = (changes.active != 0) & (onset < since) & reported
    kept = {name: np.where(own, getattr(changes, name), 0.0) for name in ("up", "down", "recovery")}
    return replace(changes, active=np.where(own, changes.active, 0).astype(np.int8), **kept)


def relearn(changes: Changes, rows: BoolArray) -> Changes:
    """Forgets the baseline where `rows` (..., P), e.g. after a repair."""
    zero = {
        name: np.where(rows, 0.0, getattr(changes, name))
        for name in ("learned", "weight", "weighted", "up", "down", "recovery")
    }
    return replace(changes, active=np.where(rows, 0, changes.active).astype(np.int8), **zero)

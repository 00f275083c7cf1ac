"""Variance inflation: how much more a vehicle's windows scatter than their covariances say (overdispersion).

Judged from differences of windows that do not overlap, because neither a drift nor a wrong filter enters these: over
one second a parameter stands still.  Pairs are timed component by component: one that is seen every other minute is
never compared across that minute.  Arrays are (..., P): one vehicle, or many at once.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sprung.model.signals import BoolArray, FloatArray, IntArray

MEMORY = 60.0  # pairs of windows that the running mean remembers
STALE = 5.0  # windows; a pair further apart than this does not measure scatter, for a drift may enter
CLIP = 9.0  # a squared score counts at most as this: one outlier moves the mean by 0.13 at most


@dataclass(frozen=True, slots=True, eq=False)
class VarianceInflation:
    """Running mean of squared scores, and the last window that a pair started from."""

    anchor: FloatArray  # log-ratios, shape (..., P); NaN: none yet
    anchored: IntArray  # ns, start of the anchor's window, shape (..., P)
    anchor_variance: FloatArray  # shape (..., P)
    square: FloatArray  # running mean, 1 when covariances are right, shape (..., P)

    @property
    def factor(self) -> FloatArray:
        """Factor on the windows' variances; never below 1, since luck is not precision."""
        return np.maximum(1.0, self.square)

    def shifted(self, by: int) -> VarianceInflation:
        """With times that are later by `by`, ns."""
        return replace(self, anchored=self.anchored + by)


def start(shape: tuple[int, ...]) -> VarianceInflation:
    return VarianceInflation(np.full(shape, np.nan), np.zeros(shape, dtype=np.int64), np.ones(shape), np.ones(shape))


def update(
    inflation: VarianceInflation, value: FloatArray, variance: FloatArray, mask: BoolArray, *, time: int, window: int
) -> VarianceInflation:
    """After the window of `window` ns that starts at `time`; values, variances and mask (..., P).

    Components outside `mask`, and those whose anchor it still overlaps, keep their anchor.
    """
    apart = time - inflation.anchored
    known = np.isfinite(inflation.anchor)
    mask = mask & (~known | (apart >= window))
    paired = mask & known & (apart <= STALE * window)
    total = np.where(mask, variance, 1.0) + inflation.anchor_variance
    score = np.where(paired, (value - inflation.anchor) ** 2 / total, 1.0)
    step = np.where(paired, 1.0 / MEMORY, 0.0)
    return VarianceInflation(
        np.where(mask, value, inflation.anchor),
        np.where(mask, time, inflation.anchored),
        np.where(mask, variance, inflation.anchor_variance),
        inflation.square + step * (np.minimum(score, CLIP) - inflation.square),
    )

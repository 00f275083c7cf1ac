"""How much more a vehicle's windows scatter than their covariances say.

Judged from differences of windows that do not overlap, because neither a drift nor a wrong filter enters these: over
one second a parameter stands still.  Pairs are timed component by component: one that is seen every other minute is
never compared across that minute.  Arrays are (..., P): one vehicle, or many at once.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sprung.model.signals import BoolArray, FloatArray, IntArray

MEMORY = 60.0  # pairs of windows that the running mean remembers
STALE = 5.0  # windows; a pair further apart than this does not measure scatter, for a drift may enter
CLIP = 9.0  # a squared score counts at most as this: one outlier moves the mean by 0.13 at most


@dataclass(frozen=True, slots=True, eq=False)
class Scatter:
    """Running mean of squared scores, and the last window that a pair started from."""

    anchor: FloatArray  # log-ratios, shape (..., P); NaN: none yet
    anchored: IntArray  # ns, start of the anchor's window, shape (..., P)
    anchor_variance: FloatArray  # shape (..., P)
    square: FloatArray  # running mean, 1 when covariances are right, shape (..., P)

    @property
    def inflation(self) -> FloatArray:
        """Factor on the windows' variances; never below 1, since luck is not precision."""
        return np.maximum(1.0, self.square)


def start(shape: tuple[int, ...]) -> Scatter:
    return Scatter(np.full(shape, np.nan), np.zeros(shape, dtype=np.int64), np.ones(shape), np.ones(shape))


def update(
    scatter: Scatter, value: FloatArray, variance: FloatArray, mask: BoolArray, *, time: int, window: int
) -> Scatter:
    """After the window of `window` ns that starts at `time`.

    Components outside `mask`, and those whose anchor it still overlaps, keep their anchor.
    """
    apart = time - scatter.anchored
    known = np.isfinite(scatter.anchor)
    mask = mask & (~known | (apart >= window))
    paired = mask & known & (apart <= STALE * window)
    total = np.where(mask, variance, 1.0) + scatter.anchor_variance
    score = np.where(paired, (value - scatter.anchor) ** 2 / total, 1.0)
    step = np.where(paired, 1.0 / MEMORY, 0.0)
    return Scatter(
        np.where(mask, value, scatter.anchor),
        np.where(mask, time, scatter.anchored),
        np.where(mask, variance, scatter.anchor_variance),
        scatter.square + step * (np.minimum(score, CLIP) - scatter.square),
    )

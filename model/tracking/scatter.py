"""How much more a vehicle's windows scatter than their covariances say.

Judged from differences of windows that do not overlap, because neither a drift nor a wrong filter enters these: over
one second a parameter stands still.  Arrays are (..., P): one vehicle, or many at once.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sprung.model.signals import BoolArray, FloatArray

MEMORY = 60.0  # pairs of windows that the running mean remembers
CLIP = 9.0  # a squared score counts at most as this: one outlier moves the mean by 0.13 at most


@dataclass(frozen=True, slots=True, eq=False)
class Scatter:
    """Running mean of squared scores, and the last window that a pair started from."""

    anchor: FloatArray  # log-ratios, shape (..., P); NaN: none yet
    anchor_variance: FloatArray  # shape (..., P)
    square: FloatArray  # running mean, 1 when covariances are right, shape (..., P)

    @property
    def inflation(self) -> FloatArray:
        """Factor on the windows' variances; never below 1, since luck is not precision."""
        return np.maximum(1.0, self.square)


def start(shape: tuple[int, ...]) -> Scatter:
    return Scatter(np.full(shape, np.nan), np.ones(shape), np.ones(shape))


def update(scatter: Scatter, value: FloatArray, variance: FloatArray, mask: BoolArray) -> Scatter:
    """After a window that does not overlap the anchor; components outside `mask` keep their anchor."""
    paired = mask & np.isfinite(scatter.anchor)
    total = np.where(mask, variance, 1.0) + scatter.anchor_variance
    score = np.where(paired, (value - scatter.anchor) ** 2 / total, 1.0)
    step = np.where(paired, 1.0 / MEMORY, 0.0)
    return Scatter(
        np.where(mask, value, scatter.anchor),
        np.where(mask, variance, scatter.anchor_variance),
        scatter.square + step * (np.minimum(score, CLIP) - scatter.square),
    )

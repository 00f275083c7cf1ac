"""Innovation CUSUM: has the filter lost a parameter?  Page's test (1954); when it fires, that level is reopened.

This is no alarm: it costs certainty for a few seconds and nothing else, so that it may fire more often.  It is what
lets the process noise be small: drifts are in the process, jumps are here.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sprung.model.signals import BoolArray, FloatArray

REFERENCE = 0.5  # standard deviations of prediction and window: half of the smallest lag worth a reaction
THRESHOLD = 14.0  # exp(2 * 0.5 * 14) = 1.2e6 windows between false reopenings of one side of one parameter
MOST = 4.0  # one score counts at most as this: four windows at least


@dataclass(frozen=True, slots=True, eq=False)
class InnovationCusum:
    """Page's statistics for predictions that are too low and too high, shape (P,)."""

    up: FloatArray
    down: FloatArray


def start(size: int) -> InnovationCusum:
    return InnovationCusum(np.zeros(size), np.zeros(size))


def update(
    cusum: InnovationCusum,
    residual: FloatArray,  # value - prediction, shape (P,)
    variance: FloatArray,  # of the residual, overlap included, shape (P,)
    mask: BoolArray,
) -> tuple[InnovationCusum, FloatArray]:
    """After one window: statistics, and the variance (P,) to reopen levels with; 0 where the filter follows."""
    score = np.where(mask, residual / np.sqrt(variance), 0.0)
    score = np.clip(score, -MOST, MOST)
    idle = np.where(mask, REFERENCE, 0.0)
    up = np.maximum(0.0, cusum.up + score - idle)
    down = np.maximum(0.0, cusum.down - score - idle)
    lost = np.maximum(up, down) >= THRESHOLD
    return (
        InnovationCusum(np.where(lost, 0.0, up), np.where(lost, 0.0, down)),
        np.where(lost, np.maximum(residual**2, 4.0 * variance), 0.0),
    )

"""Innovation CUSUM: has the filter lost a parameter?  Page's test (1954); when it fires, that level is reopened.

Until it fires, the windows since the statistic left zero lie to one side of what is believed by some offset.  As far as
their evidence goes, the parameter is there and not where the filter has it: that is part of its stated deviation.

This is no alarm: it costs certainty for a few seconds and nothing else, so that it may fire more often.  It is what
lets the process noise be small: drifts are in the process, jumps are here.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import expit

from sprung.model.signals import BoolArray, FloatArray, IntArray

REFERENCE = 0.5  # standard deviations of prediction and window: half of the smallest lag worth a reaction
THRESHOLD = 14.0  # exp(2 * 0.5 * 14) = 1.2e6 windows between false reopenings of one side of one parameter
ALIKE = 0.35  # mean correlation of the errors of elements of a kind within a window, at most; measured: -0.06 to 0.34
MOST = 4.0  # one score counts at most as this: four windows at least
# Log-likelihood ratios of a jump at which half of it is uncertainty: the evidence of one window at most; and of a jump
# of all of a kind, less, since chance gives them opposite signs
DOUBT, DOUBT_OF_KIND = 0.5 * MOST**2, 6.0


@dataclass(frozen=True, slots=True, eq=False)
class InnovationCusum:
    """Page's statistics for predictions that are too low and too high, shape (P,)."""

    up: FloatArray
    down: FloatArray
    score: FloatArray  # sum of the scores of the last windows on one side, at most since that left zero, shape (P,)
    windows: FloatArray  # number of these, shape (P,): the last alone where it is more evidence than with those before
    offset: FloatArray  # mean of their residuals, shape (P,)

    def pending_variance(self, group: IntArray) -> FloatArray:
        """Variance (P,) of levels that may have jumped, alone or with all of their kind.

        group: number of each parameter's kind, (P,); -1: none.  What a kind shows together is evidence for those as
        well that noise has hidden it in.
        """
        sigmas = self.score / np.sqrt(np.maximum(self.windows, 1.0))
        found = expit(0.5 * sigmas**2 - DOUBT) * self.offset**2
        for number in range(int(group.max(initial=-1)) + 1):
            members = group == number
            count = int(members.sum())
            together = float(sigmas[members].sum() ** 2 / (2 * count * (1 + (count - 1) * ALIKE)))
            common = expit(together - DOUBT_OF_KIND) * float(self.offset[members].mean()) ** 2
            found[members] = np.maximum(found[members], common)
        return np.asarray(found)


def start(size: int) -> InnovationCusum:
    return InnovationCusum(*(np.zeros(size) for _ in range(5)))


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
    goes_on = (cusum.windows > 0) & (np.where(up >= down, cusum.score, -cusum.score) > 0)
    # What chance had added up before a jump would hide the evidence of its first window.
    goes_on &= np.abs(score) * np.sqrt(cusum.windows + 1) < np.abs(cusum.score + score)
    sums = np.where(goes_on, [cusum.score, cusum.windows, cusum.offset], 0.0)
    windows = sums[1] + mask
    offset = sums[2] + np.where(mask, residual - sums[2], 0.0) / np.maximum(windows, 1.0)
    one_sided = np.where((up > 0) | (down > 0), ~lost, False)
    kept = (np.where(one_sided, part, 0.0) for part in (sums[0] + score, windows, offset))
    return (
        InnovationCusum(np.where(lost, 0.0, up), np.where(lost, 0.0, down), *kept),
        np.where(lost, np.maximum(residual**2, 4.0 * variance), 0.0),
    )

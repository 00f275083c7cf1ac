"""Drift of parameters against the vehicle's own baseline, and what several have in common."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sprung.model.signals import FloatArray, IntArray


@dataclass(frozen=True, slots=True)
class Drift:
    """Posterior over baseline of every parameter."""

    change: FloatArray  # value / baseline - 1 without the level common to all of a kind, shape (P,)
    std: FloatArray
    whole: FloatArray  # the same with that level, but for its slow part, which is attributed to weather


def common_change(drift: Drift, members: IntArray) -> tuple[float, float]:
    """Median change of some parameters, and its standard deviation."""
    change, std = drift.change[members], drift.std[members]
    return float(np.nanmedian(change)), float(1.25 * np.sqrt(np.nanmean(std**2) / len(members)))


def is_between(change: float, common: float) -> bool:
    """Whether a change lies between none and the common one: it follows that, or has not come along."""
    return bool(0 <= change * np.sign(common) <= abs(common))

"""What is wrong with the measurements of a window, and when a window fits."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np

from sprung.model.identification.refinement.refine import Refined
from sprung.model.signals import BoolArray, FloatArray, IntArray, MeasurementFault

FIT_SIGMAS = 6.0  # chi-square further than this above its expectation: the window does not fit


@dataclass(frozen=True, slots=True)
class FaultExplanation:
    """The faults of one window that did not fit."""

    refined: Refined  # of the corrected window
    point: FloatArray  # deviations that were taken back, shape (H,)
    faults: tuple[MeasurementFault, ...]
    corrected: bool = True  # False: what is wrong is named, but still in the window


def fit_limit(freedom: FloatArray) -> FloatArray:
    """Chi-square per degree of freedom, of which there are `freedom` (B,), beyond which a window does not fit, (B,)."""
    return np.asarray(1 + FIT_SIGMAS * np.sqrt(2 / np.maximum(freedom, 1)), dtype=np.float64)


def fits(refined: Refined) -> BoolArray:
    """Which windows the model explains, (B,)."""
    return np.asarray((refined.chi_square < fit_limit(refined.freedom)) & refined.converged)


def unexplained(rows: IntArray, explained: Collection[int]) -> IntArray:
    """Those of the windows `rows` that are not among the explained ones."""
    return np.array([b for b in rows.tolist() if b not in explained], dtype=np.int64)

"""What everything that turns windows into estimates has in common."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from sprung.model.signals import BoolArray, Estimate, FloatArray, MeasurementFault
from sprung.model.system import System

PRIOR_STD = 1.0  # of every log-ratio: nominal values are right within a factor e either way


class UnusableWindow(ValueError):
    """A window that cannot be identified at all; the message names the channel and what to do."""


def checked_windows(system: System, windows: FloatArray) -> FloatArray:
    """Windows (B, T, C) as numbers of a system's channels.  Errors: `UnusableWindow`."""
    windows = np.asarray(windows, dtype=np.float64)
    channels = system.channels
    if windows.ndim != 3 or windows.shape[2] != len(channels):
        raise UnusableWindow(f"windows: shape (B, T, {len(channels)}) expected, {windows.shape} came")
    for column in np.flatnonzero(np.isinf(windows).any(axis=(0, 1))):
        raise UnusableWindow(f"{channels[column].name}: not finite")
    return windows


@dataclass(slots=True)
class StageTimes:
    """Seconds spent in the stages of the last batch, for metrics."""

    estimate: float = 0.0
    refine: float = 0.0


def without_values(P: int, S: int) -> Estimate:
    """The estimate of an uninformative window: P parameters as before it, S sensors of which it says nothing."""
    return Estimate(
        log_ratio=np.zeros(P),
        covariance=np.eye(P) * PRIOR_STD**2,
        identifiable=np.zeros(P, dtype=bool),
        nrmse=float("nan"),
        per_sensor=np.full(S, np.nan),
        chi_square=1.0,
        adequate=True,
        converged=True,
        iterations=0,
        informative=False,
    )


class Identifies(Protocol):
    """Windows in, estimates out."""

    @property
    def digest(self) -> str:
        """Names the model that made an estimate; estimates of another digest are not comparable."""

    @property
    def times(self) -> StageTimes:
        """Seconds spent in the stages of the last batch."""

    def identify(
        self, windows: FloatArray, start: FloatArray | None = None, *, states: bool = False, loads: bool = False
    ) -> list[Estimate]:
        """One `Estimate` per window of (B, T, C), columns in the order of `System.channels`, NaN for absent sensors.

        start: log-ratios (B, P) to begin from.  Errors: `UnusableWindow`.
        """

    def examine(
        self, windows: FloatArray, weigh: BoolArray, known: Sequence[tuple[MeasurementFault, ...]] = ()
    ) -> list[Estimate]:
        """As a tracker wants it: with evidence on gains, delays and wrong measurements, as far as it can be had.

        weigh: windows (B,) whose evidence on gains and delays is wanted; known: faults that earlier windows had, for
        each window.
        """

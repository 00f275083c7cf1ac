"""Windows that lack some of the inputs, refined with those that they have."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from sprung.model.chunks import alike
from sprung.model.identification.refinement.refine import Refined, Refines, in_order
from sprung.model.signals import BoolArray, FloatArray
from sprung.model.system import System

KEPT = 8  # refiners of windows without some inputs


class RefinerOfAnyInputs:
    """Windows of one system and length, whichever of their inputs are measured: NaN columns are those that are not.

    Windows that lack the same are refined together, by a refiner of the system without these channels (`System.lost`).
    """

    def __init__(self, system: System, make: Callable[[System], Refines]) -> None:
        """make: refiner of windows in which all inputs but those that are lost to a system are measured."""
        self._system, self._make = system, make
        self._whole = make(system)
        self.model, self.calibration = self._whole.model, self._whole.calibration
        self._lossy: dict[frozenset[str], Refines] = {}

    def lacks(self, windows: FloatArray) -> BoolArray:
        """Which inputs are not measured, (B, I), in windows (B, T, C)."""
        return np.asarray(np.isnan(windows[:, :, : len(self._system.inputs)]).any(axis=1))

    def without(self, lost: BoolArray) -> Refines:
        """The refiner of windows without some inputs (I,)."""
        if not lost.any():
            return self._whole
        key = frozenset(self._system.inputs[column].name for column in np.flatnonzero(lost))
        if key not in self._lossy:
            if len(self._lossy) >= KEPT:
                del self._lossy[next(iter(self._lossy))]
            self._lossy[key] = self._make(self._system.without(key))
        return self._lossy[key]

    def refine(
        self, windows: FloatArray, start: FloatArray | None = None, *, weigh: BoolArray | None = None, **options: Any
    ) -> Refined:
        """As `Refiner.refine`; start: read for windows with all inputs only."""
        lost = self.lacks(windows)
        if not lost.any():
            return self._whole.refine(windows, start, weigh=weigh, **options)
        parts = []
        groups = alike(lost, np.arange(len(windows)))
        for rows in groups:
            some = windows[rows]
            some[:, :, np.flatnonzero(lost[rows[0]])] = 0.0
            begin = None if start is None else start[rows]
            wanted = None if weigh is None else weigh[rows]
            parts.append(self.without(lost[rows[0]]).refine(some, begin, weigh=wanted, **options))
        return in_order(parts, np.concatenate(groups))

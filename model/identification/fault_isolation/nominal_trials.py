"""Reversed, exchanged and very late channels, tried at the nominal values.

They are too large for a linear step.  At the nominal values what the sensors should show depends on the inputs alone,
so that all trials of a window cost one solution; only the best few are refined.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from sprung.model.identification.fault_isolation.contradictions import Rearrangement
from sprung.model.identification.fault_isolation.corrections import MARGIN
from sprung.model.identification.fault_isolation.explanation import FaultExplanation
from sprung.model.identification.fault_isolation.restoring import BETTER, Restorer
from sprung.model.identification.refinement.nominal import nominal_cost
from sprung.model.signals import FloatArray

_LATE = (-0.045, -0.03, -0.02, -0.01, 0.01, 0.02, 0.03, 0.045)  # s: delays too large for a linear step
_APART = 0.015  # s between delays that are tried: half a period of what moves at 30 Hz
_TRIALS = 3  # of such delays, reversed signs or exchanges, by their squares at the nominal values


class NominalTrials:
    """Trials of windows of one system and length."""

    def __init__(self, restorer: Restorer, rearrangements: Sequence[Rearrangement]) -> None:
        """rearrangements: the reversed signs and exchanges that are tried."""
        self._restorer, self._rearrangements = restorer, rearrangements

    def rearranged(self, window: FloatArray) -> FaultExplanation | None:
        """One window (T, C) with a reversed or two exchanged channels corrected; None: it does not fit then."""
        names = self._restorer.names
        restored = np.array([window, *(one.undone(window) for one in self._rearrangements)])
        costs = nominal_cost(self._restorer.refiner(self._restorer.samples), restored)
        for trial in _promising(costs):
            fault = self._rearrangements[trial - 1].fault(names)
            explained = self._restorer.by_steps(restored[trial][None], [(fault,)])
            if 0 in explained:
                return explained[0]
        return None

    def late(self, window: FloatArray, *, far: bool) -> FaultExplanation | None:
        """One window (T, C) with a channel, or all of a clock, that is late or early by many samples corrected.

        far: clocks by very many, too.  None: it does not fit then.
        """
        steps, channels = self._restorer.steps, len(self._restorer.names)
        directions = steps.directions[steps.directions[:, channels : 2 * channels].any(axis=1)]
        found = self._late_by(window, directions, _LATE)
        return found if found is not None or not far else self._late_by(window, steps.late_clocks, self._far)

    @property
    def _far(self) -> tuple[float, ...]:
        """Delays, s, of a clock that was set anew: beyond those that electronics and filters have."""
        later = np.arange(max(_LATE) + _APART, self._restorer.corrections.longest, _APART)
        return (*-later[::-1], *later)

    def _late_by(self, window: FloatArray, rows: FloatArray, lates: Sequence[float]) -> FaultExplanation | None:
        """One window (T, C) with channels, of `rows` over the deviations, that are late by one of `lates`, s, put
        right."""
        restorer, corrections = self._restorer, self._restorer.corrections
        points = np.array([np.zeros(len(corrections.deviations)), *(row * late for row in rows for late in lates)])
        edge = int(np.ceil(max(lates, default=0.0) * restorer.system.sample_rate)) + MARGIN
        if restorer.samples <= 4 * edge or len(points) == 1:
            return None
        restored = corrections.corrected(np.repeat(window[None], len(points), axis=0), points)
        inner = restored[:, edge : restorer.samples - edge]
        for trial in _promising(nominal_cost(restorer.refiner(inner.shape[1]), inner)):
            explained = restorer.by_steps(window[None], [()], points[trial])
            if 0 in explained:
                return explained[0]
        return None


def _promising(costs: FloatArray) -> Iterator[int]:
    """The few best trials, by index, that cost clearly less than the window as it is, which comes first in `costs`."""
    for trial in (np.argsort(costs[1:])[:_TRIALS] + 1).tolist():
        if costs[trial] < BETTER * costs[0]:
            yield trial

"""Windows refined with their faults corrected: deviations taken back one by one, channels left out.

A gain, a delay or a load leaves a trace of its own in the residual (`measurements.calibration`).  The one with the most
evidence is taken back from the samples, and the window is refined again, until it fits or nothing helps.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from sprung.model.identification.fault_isolation.corrections import Corrections
from sprung.model.identification.fault_isolation.explanation import FaultExplanation, fits
from sprung.model.identification.fault_isolation.steps import DeviationSteps
from sprung.model.identification.refinement.any_inputs import RefinerOfAnyInputs
from sprung.model.identification.refinement.refine import Refined
from sprung.model.signals import BoolArray, FloatArray, IntArray, MeasurementFault
from sprung.model.system import System

ITERATIONS = 6  # of a refinement that is tried
BETTER = 0.8  # of chi-square: by chance one number takes a few of its thousand, so that less than this is no chance
_ROUNDS = 5  # corrections of one window at most

Faults = tuple[MeasurementFault, ...]
Step = Callable[[FloatArray, FloatArray], FloatArray]  # from score (H,) and information (H, H) to deviations (H,)


class Restorer:
    """Refines windows of one system and length with faults of their measurements corrected."""

    def __init__(
        self,
        system: System,
        samples: int,
        refiner: Callable[[int], RefinerOfAnyInputs],
        start: Callable[[FloatArray], FloatArray | None],
    ) -> None:
        """refiner: of windows of so many samples; start: from windows (B, T, C) to log-ratios to refine from."""
        self.system, self.samples, self.refiner, self.start = system, samples, refiner, start
        self.corrections = Corrections(system, samples, refiner(samples).calibration.deviations)
        self.steps = DeviationSteps(system, self.corrections)
        self.names = [channel.name for channel in system.channels]
        self._along = bool(system.loads or system.built)  # whether these are refined with the parameters

    def can_lose(self, columns: IntArray) -> bool:
        """Whether windows can be refined without these channels."""
        lost = {self.names[column] for column in columns.tolist()}
        return not any(names <= lost for names in self.system.needed)

    def cost(self, windows: FloatArray) -> FloatArray:
        """Chi-square (B,) of windows (B, T, C), refined as they are."""
        along = self._along
        start = self.start(windows)
        refined = self.refiner(self.samples).refine(windows, start, loads=along, built=along, iterations=ITERATIONS)
        return np.asarray(refined.chi_square * refined.freedom)

    def by_steps(
        self,
        windows: FloatArray,
        known: Sequence[Faults],
        start: FloatArray | None = None,
        *,
        step: Step | None = None,
    ) -> dict[int, FaultExplanation]:
        """Those of some windows (B, T, C), by index, that fit once deviations are taken back.

        One deviation at a time, the one with the most evidence, or what `step` makes of score and information.
        known: faults that were corrected before, of each window; start: deviations (H,) to begin with.
        """
        found: dict[int, FaultExplanation] = {}
        active, point = np.arange(len(windows)), np.zeros((len(windows), len(self.corrections.deviations)))
        if start is not None:
            measured = self.corrections.measured
            point[:, measured] = start[measured]
        before = np.full(len(windows), np.inf)
        loads = np.full(len(windows), self._along)
        for _ in range(_ROUNDS + 1):
            parts = self._refined(windows[active], point[active], loads[active])
            going = []
            for i, one in zip(active.tolist(), parts, strict=True):
                chi_square, weight = float(one.chi_square[0]), (one.score[0], one.information[0])
                further = self.steps.strongest(*weight)[0] if step is None else step(*weight)
                good = bool(fits(one)[0])
                if good:
                    found[i] = FaultExplanation(
                        one, self._with_load(point[i], one), (*known[i], *self.corrections.named(point[i]))
                    )
                if self.steps.apart(*weight) if good else chi_square < BETTER * before[i]:
                    before[i] = chi_square
                    point[i] = self.corrections.moved(point[i], further)
                    if self.corrections.credible(point[i]):
                        going.append(i)
            active = np.array(going, dtype=np.int64)
            if len(active) == 0:
                break
        return found

    def without(self, windows: FloatArray, faults: Sequence[Faults]) -> dict[int, FaultExplanation]:
        """Those of some windows (B, T, C), by index, that fit without the channels that the faults of each name."""
        without, sensible = windows.copy(), []
        for b, its in enumerate(faults):
            columns = [self.names.index(name) for fault in its for name in fault.channel.split("|")]
            if self.can_lose(np.array(columns)):
                without[b][:, columns] = np.nan
                sensible.append(b)
        explained = self.by_steps(without[sensible], [faults[b] for b in sensible])
        return {sensible[i]: e for i, e in explained.items()}

    def or_uncorrected(
        self, windows: FloatArray, faults: Sequence[Faults], explained: dict[int, FaultExplanation]
    ) -> list[FaultExplanation]:
        """Explanations of windows (B, T, C); where `explained` has none, the faults, though they are not corrected."""
        left = [b for b in range(len(windows)) if b not in explained]
        point = np.zeros((len(left), len(self.corrections.deviations)))
        refined = self._refined(windows[left], point, np.zeros(len(left), dtype=bool))
        uncorrected = {
            b: FaultExplanation(one, at, faults[b], False) for b, one, at in zip(left, refined, point, strict=True)
        }
        return [explained.get(b) or uncorrected[b] for b in range(len(windows))]

    def _refined(self, windows: FloatArray, point: FloatArray, loads: BoolArray) -> list[Refined]:
        """Corrected windows refined, with their evidence; one `Refined` of one window each."""
        margin = self.corrections.margin(point)
        alike = np.unique(np.column_stack([margin, loads]).astype(np.int64), axis=0, return_inverse=True)[1]
        out: list[Refined | None] = [None] * len(windows)
        for group in np.unique(alike):
            rows = np.flatnonzero(alike == group)
            edge, with_loads = int(margin[rows[0]]), bool(loads[rows[0]])
            restored = self.corrections.corrected(windows[rows], point[rows])
            inner = restored[:, edge : self.samples - edge]
            refined = self.refiner(inner.shape[1]).refine(
                inner,
                self.start(restored),
                loads=with_loads,
                built=with_loads,
                weigh=np.ones(len(rows), dtype=bool),
                iterations=ITERATIONS,
            )
            for k, row in enumerate(rows):
                out[row] = refined.take(np.array([k]))
        return [one for one in out if one is not None]

    def _with_load(self, point: FloatArray, one: Refined) -> FloatArray:
        """Deviations (H,) with the loads that were refined along: they are part of where the window was linearised."""
        P = len(self.system.tracked)
        out = point.copy()
        out[~self.corrections.measured] = one.log_ratio[0, P:] if one.log_ratio.shape[1] > P else 0.0
        return out

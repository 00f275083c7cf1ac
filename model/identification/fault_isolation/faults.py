"""Windows that do not fit: is it a measurement?

Redundant channels that contradict each other are looked at first (`contradictions`): springs cannot make them do so,
and an exchange or a reversed sign that ends the contradiction is undone.  A gain, a delay or a load leaves a trace of
its own in the residual (`calibration`): the one with the most evidence is taken back from the samples, and the window
is refined again, until it fits or nothing helps.  What is too large for a linear step, or an exchange that contradicts
nothing, is tried at the nominal values, where what the sensors should show depends on the inputs alone.  A frozen or
saturated sensor shows itself in its samples, a noisy one in their spectrum, and the window is refined without it.  A
window explained this way is as informative about the springs as any other.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from sprung.model.identification.fault_isolation.contradictions import Contradictions, Rearrangement, rearrangements
from sprung.model.identification.fault_isolation.corrections import MARGIN, Corrections
from sprung.model.identification.fault_isolation.steps import EVIDENT, DeviationSteps
from sprung.model.identification.fault_isolation.stuck import STUCK, StuckChannels
from sprung.model.identification.measurements.deviations import clock_groups
from sprung.model.identification.refinement.any_inputs import RefinerOfAnyInputs
from sprung.model.identification.refinement.nominal import nominal_cost
from sprung.model.identification.refinement.refine import Refined
from sprung.model.signals import BoolArray, FloatArray, IntArray, MeasurementFault
from sprung.model.system import System

FIT_SIGMAS = 6.0  # chi-square further than this above its expectation: the window does not fit
ROUNDS = 5  # corrections of one window at most
ITERATIONS = 6  # of a refinement that is tried
TRIED = 8  # windows of a batch; when none of them can be explained, the others are not tried
_BETTER = 0.8  # of chi-square: by chance one number takes a few of its thousand, so that less than this is no chance
_LATE = (-0.045, -0.03, -0.02, -0.01, 0.01, 0.02, 0.03, 0.045)  # s: delays too large for a linear step
_FAR_TRIED = 2  # windows of a batch, as many as it takes to have something in common
_APART = 0.015  # s between delays that are tried: half a period of what moves at 30 Hz
_LATE_TRIED = 3  # windows of a batch that they are tried on; others begin with what these have in common
_TRIALS = 3  # of such delays, reversed signs or exchanges, by their squares at the nominal values
_TOLERATED = 3.0  # of what a data sheet leaves open; channels that are all off by less are none of them wrong
_SLIGHT = 0.1  # of what a data sheet leaves open; less is not taken back


@dataclass(slots=True)
class FaultExplanation:
    """What was found for the windows that did not fit, one entry per window."""

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


def _numbers(things: Sequence[object]) -> IntArray:
    """A number for each that only equal ones share."""
    return np.array([things.index(thing) for thing in things], dtype=np.int64)


class Explainer:
    """Searches for what is wrong with the measurements of windows of one system."""

    def __init__(
        self,
        system: System,
        samples: int,
        refiner: Callable[[int], RefinerOfAnyInputs],
        start: Callable[[FloatArray], FloatArray | None],
    ) -> None:
        """refiner: of windows of so many samples; start: from windows (B, T, C) to log-ratios to refine from."""
        self.system, self.samples, self.start, self.refiner = system, samples, start, refiner
        calibration = refiner(samples).calibration
        self.corrections = Corrections(system, samples, calibration.deviations)
        self.steps = DeviationSteps(system, self.corrections)
        self.channels = len(system.channels)
        self.names = [channel.name for channel in system.channels]
        units = [channel.unit for channel in system.channels]
        alike = [(int(group), unit) for group, unit in zip(clock_groups(system), units, strict=True)]
        self.contradictions = Contradictions(calibration, _numbers(units))
        # Tried where nothing contradicts: of one clock, and of inputs, whose supports may be measured but once
        wide = rearrangements(_numbers(units))
        near = set(rearrangements(_numbers(alike)))
        self._rearrangements = [r for r in wide if r in near or max(r.columns) < len(system.inputs)]
        self.stuck = StuckChannels(system)
        self._along = bool(system.loads or system.built)  # whether these are refined with the parameters

    def again(
        self, windows: FloatArray, known: Mapping[int, tuple[MeasurementFault, ...]]
    ) -> dict[int, FaultExplanation]:
        """Explanations of windows of a batch (B, T, C) by the faults that earlier windows of their vehicles had.

        known: these faults, by window.  A window that does not show them, or does not fit with them put right, is left
        out: what is wrong with it must be looked for anew.
        """
        found: dict[int, FaultExplanation] = {}
        for faults in set(known.values()):
            rows = np.array([b for b, theirs in known.items() if theirs == faults], dtype=np.int64)
            found |= self._again(windows, rows, faults)
        return found

    def _again(
        self, windows: FloatArray, rows: IntArray, faults: tuple[MeasurementFault, ...]
    ) -> dict[int, FaultExplanation]:
        """The same for the windows `rows`, of which all are known to have these faults."""
        stuck = {f.channel for f in faults if f.kind in STUCK}
        turned = tuple(f for f in faults if f.kind not in STUCK)
        undone = [Rearrangement.of(f, self.names) for f in turned]
        noisy = any(f.kind == "noisy" for f in faults)
        seen = {int(b): self._shown(windows[b], noisy=noisy) for b in rows}
        rows = rows[[{f.channel for f in seen[b]} == stuck for b in rows.tolist()]]
        if None in undone or not len(rows):  # one of several, which these windows may decide
            return {}
        causes = [(*turned, *seen[b]) for b in rows.tolist()]
        columns = np.array([self.names.index(name) for name in stuck], dtype=np.int64)
        if not self._can_lose(columns):
            return dict(zip(rows.tolist(), self._or_as_they_are(windows[rows], causes, {}), strict=True))
        restored = windows[rows]
        for rearrangement in undone:
            restored = restored if rearrangement is None else rearrangement.undone(restored)
        restored[..., columns] = np.nan
        agree = np.flatnonzero(~self.contradictions.contradicted(restored))
        explained = self._by_steps(restored[agree], [causes[i] for i in agree])
        return {int(rows[agree[i]]): e for i, e in explained.items()}

    def _shown(self, window: FloatArray, *, noisy: bool) -> tuple[MeasurementFault, ...]:
        """What the samples of a window (T, C) show by themselves; noisy: noise, too."""
        stuck = self.stuck.channels(window)
        if not noisy:
            return stuck
        names = {fault.channel for fault in stuck}
        return stuck + tuple(f for f in self.stuck.noisy(window) if f.channel not in names)

    def _can_lose(self, columns: IntArray) -> bool:
        """Whether windows can be refined without these channels."""
        lost = {self.names[column] for column in columns.tolist()}
        return not any(names <= lost for names in self.system.needed)

    def contradictory(self, windows: FloatArray, bad: IntArray) -> dict[int, FaultExplanation]:
        """Explanations, by index, of those of the windows `bad` of a batch (B, T, C) whose redundant channels
        contradict each other until an exchange, or a reversed sign, is undone."""
        ends = {int(b): self.contradictions.ended_by(windows[b]) for b in bad if not self.stuck.channels(windows[b])}
        left = [b for b, candidates in ends.items() if candidates]
        found: dict[int, FaultExplanation] = {}
        while left:
            ((most, _),) = Counter(c for b in left for c in ends[b]).most_common(1)
            alike = [b for b in left if most in ends[b]]
            candidates = [c for c in ends[alike[0]] if all(c in ends[b] for b in alike)]
            explained = self._rearranged(windows[alike], candidates)
            found |= dict(zip(alike, explained, strict=True))
            left = [b for b in left if b not in alike]
        return found

    def _rearranged(self, windows: FloatArray, candidates: Sequence[Rearrangement]) -> list[FaultExplanation]:
        """Windows (B, T, C) with the candidate undone with which they fit best.

        Where several fit equally well, one fault of all their channels, and the windows are refined without these.
        """
        costs = self._costs(windows[:TRIED], candidates)
        likely = [c for c, cost in zip(candidates, costs, strict=True) if cost < costs.min() + 2 * EVIDENT]
        faults = [c.fault(self.names) for c in likely]
        if len(likely) > 1:
            channels = dict.fromkeys(channel for fault in faults for channel in fault.channel.split("|"))
            together = MeasurementFault("|".join(channels), faults[0].kind, faults[0].value)
            return self._without(windows, [(together,)] * len(windows))
        restored, known = likely[0].undone(windows), [tuple(faults)] * len(windows)
        return self._or_as_they_are(restored, known, self._by_steps(restored, known))

    def _costs(self, windows: FloatArray, candidates: Sequence[Rearrangement]) -> FloatArray:
        """Chi-square of refined windows (B, T, C), together, with each of the candidates undone."""
        restored = np.concatenate([candidate.undone(windows) for candidate in candidates])
        start, along = self.start(restored), self._along
        refined = self.refiner(self.samples).refine(restored, start, loads=along, built=along, iterations=ITERATIONS)
        return np.asarray((refined.chi_square * refined.freedom).reshape(len(candidates), -1).sum(axis=1))

    def explain(self, windows: FloatArray, bad: IntArray) -> dict[int, FaultExplanation]:
        """Explanations of the windows `bad` of a batch (B, T, C), by index; those without one are left out."""
        found = self._explain(windows[bad[:TRIED]], bad[:TRIED])
        common = self._common(found)
        if common is not None:  # what most of them have is tried first with the others
            others = np.array([b for b in bad if b not in found or self._key(found[b].point) != self._key(common)])
            again = self._by_steps(windows[others], [()] * len(others), common) if len(others) else {}
            found |= {int(others[i]): e for i, e in again.items()}
        together = self._together(found)
        if together is not None:
            others = np.array([b for b in bad if b not in found], dtype=np.int64)
            again = self._by_steps(windows[others], [()] * len(others), together) if len(others) else {}
            found |= {int(others[i]): e for i, e in again.items()}
        if found:
            rest = np.array([b for b in bad[TRIED:] if b not in found], dtype=np.int64)
            found |= self._explain(windows[rest], rest)
        return found

    def _key(self, point: FloatArray) -> tuple[int, ...]:
        return tuple(int(h) for h in np.flatnonzero(point[: 2 * self.channels]))

    def _common(self, found: dict[int, FaultExplanation]) -> FloatArray | None:
        """The deviations that most of the explained windows have in common, at their median; None: there are none."""
        plain = [e.point for e in found.values() if self._key(e.point)]
        keys = [self._key(point) for point in plain]
        most = max(keys, key=keys.count, default=())
        if keys.count(most) < 2:
            return None
        return np.asarray(np.median([p for p, key in zip(plain, keys, strict=True) if key == most], axis=0))

    def _together(self, found: dict[int, FaultExplanation]) -> FloatArray | None:
        """Gains and delays as the explained windows of a batch say them together; None: fewer than two do."""
        plain = [e for e in found.values() if self._key(e.point)]
        if len(plain) < 2:
            return None
        total = np.zeros((len(self.steps.std), len(self.steps.std)))
        pull = np.zeros(len(total))
        for e in plain:
            information = e.refined.information[0]
            total += information
            pull += e.refined.score[0] + information @ np.where(self.corrections.measured, e.point, 0.0)
        point = np.where(self.corrections.measured, self.steps.most_likely(pull, total), 0.0)
        return np.where(np.abs(point) > _SLIGHT * self.steps.std, point, 0.0)

    def _explain(self, windows: FloatArray, names: IntArray) -> dict[int, FaultExplanation]:
        stuck = [self.stuck.channels(window) for window in windows]
        noisy = {i: its for i, faults in enumerate(stuck) if not faults and (its := self.stuck.noisy(windows[i]))}
        at = list(noisy)
        found = {at[k]: e for k, e in self._left_out(windows[at], list(noisy.values())).items()}
        plain = np.array([i for i, faults in enumerate(stuck) if not faults and i not in found], dtype=np.int64)
        found |= {int(plain[i]): e for i, e in self._by_steps(windows[plain], [()] * len(plain)).items()}
        left = np.array([i for i in plain if i not in found], dtype=np.int64)
        if len(left) and len(self.steps.clocks) > 1:
            again = self._by_steps(windows[left], [()] * len(left), step=self.steps.of_clocks)
            found |= {int(left[i]): e for i, e in again.items()}
            left = np.array([i for i in left if i not in found], dtype=np.int64)
        if len(left):
            again = self._by_steps(windows[left], [()] * len(left), step=self.steps.of_all)
            found |= {int(left[i]): self._within_tolerance(e) for i, e in again.items()}
        still = [i for i, faults in enumerate(stuck) if faults]
        found |= dict(zip(still, self._without(windows[still], [stuck[i] for i in still]), strict=True))
        late = 0
        for i, window in enumerate(windows):
            if i not in found:
                strong = self._turned(window)
                if strong is None and late < _LATE_TRIED:
                    strong, late = self._late(window, far=late < _FAR_TRIED), late + 1
                if strong is not None:
                    found[i] = strong
        return {int(names[i]): explained for i, explained in found.items()}

    def _by_steps(
        self,
        windows: FloatArray,
        known: list[tuple[MeasurementFault, ...]],
        start: FloatArray | None = None,
        *,
        step: Callable[[FloatArray, FloatArray], FloatArray] | None = None,
    ) -> dict[int, FaultExplanation]:
        """One deviation at a time, the one with the most evidence, or what `step` makes of score and information;
        `known`: faults that were corrected before."""
        found: dict[int, FaultExplanation] = {}
        active, point = np.arange(len(windows)), np.zeros((len(windows), len(self.corrections.deviations)))
        if start is not None:
            point[:, : 2 * self.channels] = start[: 2 * self.channels]
        before = np.full(len(windows), np.inf)
        loads = np.full(len(windows), self._along)
        for _ in range(ROUNDS + 1):
            parts = self._refined(windows[active], point[active], loads[active])
            going = []
            for i, one in zip(active, parts, strict=True):
                chi_square, weight = float(one.chi_square[0]), (one.score[0], one.information[0])
                further = self.steps.strongest(*weight)[0] if step is None else step(*weight)
                good = bool(fits(one)[0])
                if good:
                    found[int(i)] = FaultExplanation(
                        one, self._with_load(point[i], one), (*known[i], *self.corrections.named(point[i]))
                    )
                if self.steps.apart(*weight) if good else chi_square < _BETTER * before[i]:
                    before[i] = chi_square
                    point[i] = self.corrections.moved(point[i], further)
                    if self.corrections.credible(point[i]):
                        going.append(i)
            active = np.array(going, dtype=np.int64)
            if len(active) == 0:
                break
        return found

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

    def together(self, before: FloatArray, cause: FaultExplanation) -> FaultExplanation:
        """The explanation of a window from which the deviations `before` (H,) had been taken back already."""
        if not before.any():
            return cause
        C, point, before = self.channels, cause.point.copy(), before.copy()
        for fault in cause.faults:
            columns = [self.names.index(name) for name in fault.channel.split("|")]
            if fault.kind == "swapped" and len(columns) == 2:  # columns were put right, then exchanged
                for part in (before[:C], before[C : 2 * C]):
                    part[columns] = part[columns[::-1]]
        more = np.abs(cause.point) > 0
        point[:C] = (1 + before[:C]) * (1 + point[:C]) - 1
        point[C : 2 * C] += before[C : 2 * C]
        hard = [f for f in cause.faults if f.kind not in ("gain", "delay")]
        return replace(
            cause,
            point=point,
            faults=(*hard, *self.corrections.named(np.where(more & self.corrections.measured, point, 0.0))),
        )

    def _within_tolerance(self, cause: FaultExplanation) -> FaultExplanation:
        """An explanation by all gains and delays together; only what no data sheet leaves open is a fault."""
        far = self.corrections.measured & (np.abs(cause.point) > _TOLERATED * self.steps.std)
        return replace(cause, faults=self.corrections.named(np.where(far, cause.point, 0.0)))

    def _with_load(self, point: FloatArray, one: Refined) -> FloatArray:
        """The loads that were refined along are part of where the window was linearised."""
        P = len(self.system.tracked)
        out = point.copy()
        out[2 * self.channels :] = one.log_ratio[0, P:] if one.log_ratio.shape[1] > P else 0.0
        return out

    def _without(self, windows: FloatArray, faults: Sequence[tuple[MeasurementFault, ...]]) -> list[FaultExplanation]:
        """Windows (B, T, C) without the channels that the faults of each name."""
        return self._or_as_they_are(windows, faults, self._left_out(windows, faults))

    def _left_out(
        self, windows: FloatArray, faults: Sequence[tuple[MeasurementFault, ...]]
    ) -> dict[int, FaultExplanation]:
        """Those of the windows (B, T, C), by index, that fit without the channels that the faults of each name."""
        without, sensible = windows.copy(), []
        for b, its in enumerate(faults):
            columns = [self.names.index(name) for fault in its for name in fault.channel.split("|")]
            if self._can_lose(np.array(columns)):
                without[b][:, columns] = np.nan
                sensible.append(b)
        explained = self._by_steps(without[sensible], [faults[b] for b in sensible])
        return {sensible[i]: e for i, e in explained.items()}

    def _or_as_they_are(
        self,
        windows: FloatArray,
        faults: Sequence[tuple[MeasurementFault, ...]],
        explained: dict[int, FaultExplanation],
    ) -> list[FaultExplanation]:
        """Explanations of windows (B, T, C), by index; for those without one, what is wrong though it is not
        corrected."""
        left = [b for b in range(len(windows)) if b not in explained]
        point = np.zeros((len(left), len(self.corrections.deviations)))
        refined = self._refined(windows[left], point, np.zeros(len(left), dtype=bool))
        as_they_are = {
            b: FaultExplanation(one, at, faults[b], False) for b, one, at in zip(left, refined, point, strict=True)
        }
        return [explained.get(b) or as_they_are[b] for b in range(len(windows))]

    def _turned(self, window: FloatArray) -> FaultExplanation | None:
        """One window (T, C) with a reversed or two exchanged channels put right."""
        for restored, fault in self._reversed(window):
            explained = self._by_steps(restored[None], [(fault,)])
            if 0 in explained:
                return explained[0]
        return None

    def _late(self, window: FloatArray, *, far: bool) -> FaultExplanation | None:
        """One window (T, C) with a channel, or all of a clock, that is late or early by many samples put right.

        far: clocks by very many, too.
        """
        C = self.channels
        found = self._late_by(window, self.steps.directions[self.steps.directions[:, C : 2 * C].any(axis=1)], _LATE)
        return found if found is not None or not far else self._late_by(window, self.steps.late_clocks, self._far)

    @property
    def _far(self) -> tuple[float, ...]:
        """Delays, s, of a clock that was set anew: beyond those that electronics and filters have."""
        later = np.arange(max(_LATE) + _APART, self.corrections.longest, _APART)
        return (*-later[::-1], *later)

    def _late_by(self, window: FloatArray, rows: FloatArray, lates: Sequence[float]) -> FaultExplanation | None:
        """One window (T, C) with channels, of `rows` over the deviations, that are late by one of `lates`, s, put
        right."""
        points = np.array([np.zeros(len(self.corrections.deviations)), *(row * late for row in rows for late in lates)])
        edge = int(np.ceil(max(lates, default=0.0) * self.system.sample_rate)) + MARGIN
        if self.samples <= 4 * edge or len(points) == 1:
            return None
        restored = self.corrections.corrected(np.repeat(window[None], len(points), axis=0), points)
        inner = restored[:, edge : self.samples - edge]
        costs = nominal_cost(self.refiner(inner.shape[1]), inner)
        for at in np.argsort(costs[1:])[:_TRIALS] + 1:
            if costs[at] < _BETTER * costs[0]:
                explained = self._by_steps(window[None], [()], points[at])
                if 0 in explained:
                    return explained[0]
        return None

    def _reversed(self, window: FloatArray) -> list[tuple[FloatArray, MeasurementFault]]:
        """Windows with one sign turned or two channels exchanged that fit better at nominal values, the best first."""
        tries = [(one.undone(window), one.fault(self.names)) for one in self._rearrangements]
        restored = np.array([window, *(one for one, _ in tries)])
        costs = nominal_cost(self.refiner(self.samples), restored)
        order = np.argsort(costs[1:])
        return [tries[i] for i in order[:_TRIALS] if costs[1 + i] < _BETTER * costs[0]]

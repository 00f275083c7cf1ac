"""Which measurement is wrong in windows that do not fit.

Redundant channels that contradict each other are looked at first (`contradictions`): springs cannot make them do so,
and an exchange or a reversed sign that ends the contradiction is undone.  Gains, delays and loads are taken back step
by step (`restoring`).  What is too large for a linear step, or an exchange that contradicts nothing, is tried at the
nominal values (`nominal_trials`).  A frozen or saturated sensor shows itself in its samples, a noisy one in their
spectrum (`stuck`), and the window is refined without it.  A window explained this way is as informative about the
springs as any other.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from sprung.model.identification.fault_isolation.contradictions import Contradictions, Rearrangement, rearrangements
from sprung.model.identification.fault_isolation.explanation import FaultExplanation, unexplained
from sprung.model.identification.fault_isolation.nominal_trials import NominalTrials
from sprung.model.identification.fault_isolation.restoring import Faults, Restorer, Step
from sprung.model.identification.fault_isolation.steps import EVIDENT
from sprung.model.identification.fault_isolation.stuck import STUCK, StuckChannels
from sprung.model.identification.measurements.deviations import clock_groups
from sprung.model.signals import FloatArray, IntArray, MeasurementFault

TRIED = 8  # windows of a batch; when none of them can be explained, the others are not tried
_FAR_TRIED = 2  # windows of a batch that very late clocks are tried on, as many as may have something in common
_LATE_TRIED = 3  # the same of other delays; other windows begin with what these have in common
_TOLERATED = 3.0  # of what a data sheet leaves open; channels that are all off by less are none of them wrong
_SLIGHT = 0.1  # of what a data sheet leaves open; less is not taken back


class Explainer:
    """Searches for what is wrong with the measurements of windows of one system and length."""

    def __init__(self, restorer: Restorer) -> None:
        self.restorer, system = restorer, restorer.system
        self.corrections, self.steps = self.restorer.corrections, self.restorer.steps
        self.channels, self.names = len(system.channels), self.restorer.names
        units = [channel.unit for channel in system.channels]
        alike = [(int(group), unit) for group, unit in zip(clock_groups(system), units, strict=True)]
        self.contradictions = Contradictions(restorer.refiner(restorer.samples).calibration, _numbers(units))
        # Tried where nothing contradicts: of one clock, and of inputs, whose supports may be measured but once
        of_one_clock = set(rearrangements(_numbers(alike)))
        tried = [r for r in rearrangements(_numbers(units)) if r in of_one_clock or max(r.columns) < len(system.inputs)]
        self._trials = NominalTrials(self.restorer, tried)
        self.stuck = StuckChannels(system)

    def from_known_faults(self, windows: FloatArray, known: Mapping[int, Faults]) -> dict[int, FaultExplanation]:
        """Explanations of windows of a batch (B, T, C) by the faults that earlier windows of their vehicles had.

        known: these faults, by window.  A window that does not show them, or does not fit with them corrected, is left
        out: what is wrong with it must be looked for anew.
        """
        found: dict[int, FaultExplanation] = {}
        for faults in set(known.values()):
            rows = np.array([b for b, theirs in known.items() if theirs == faults], dtype=np.int64)
            found |= self._from_common_faults(windows, rows, faults)
        return found

    def _from_common_faults(self, windows: FloatArray, rows: IntArray, faults: Faults) -> dict[int, FaultExplanation]:
        """The same for the windows `rows`, of which all are known to have these faults."""
        stuck = {f.channel for f in faults if f.kind in STUCK}
        turned = tuple(f for f in faults if f.kind not in STUCK)
        undone = [Rearrangement.of(f, self.names) for f in turned]
        noisy = any(f.kind == "noisy" for f in faults)
        seen = {int(b): self._visible(windows[b], noisy=noisy) for b in rows}
        rows = rows[[{f.channel for f in seen[b]} == stuck for b in rows.tolist()]]
        if None in undone or not len(rows):  # one of several, which these windows may decide
            return {}
        causes = [(*turned, *seen[b]) for b in rows.tolist()]
        columns = np.array([self.names.index(name) for name in stuck], dtype=np.int64)
        if not self.restorer.can_lose(columns):
            uncorrected = self.restorer.or_uncorrected(windows[rows], causes, {})
            return dict(zip(rows.tolist(), uncorrected, strict=True))
        restored = windows[rows]
        for rearrangement in undone:
            restored = restored if rearrangement is None else rearrangement.undone(restored)
        restored[..., columns] = np.nan
        agree = np.flatnonzero(~self.contradictions.contradicted(restored))
        explained = self.restorer.by_steps(restored[agree], [causes[i] for i in agree])
        return {int(rows[agree[i]]): e for i, e in explained.items()}

    def _visible(self, window: FloatArray, *, noisy: bool) -> Faults:
        """What the samples of a window (T, C) show by themselves; noisy: noise, too."""
        stuck = self.stuck.channels(window)
        if not noisy:
            return stuck
        names = {fault.channel for fault in stuck}
        return stuck + tuple(f for f in self.stuck.noisy(window) if f.channel not in names)

    def from_contradictions(self, windows: FloatArray, bad: IntArray) -> dict[int, FaultExplanation]:
        """Explanations, by index, of those of the windows `bad` of a batch (B, T, C) whose redundant channels
        contradict each other until an exchange, or a reversed sign, is undone."""
        ends = {int(b): self.contradictions.ended_by(windows[b]) for b in bad if not self.stuck.channels(windows[b])}
        left = [b for b, candidates in ends.items() if candidates]
        found: dict[int, FaultExplanation] = {}
        while left:
            ((most, _),) = Counter(c for b in left for c in ends[b]).most_common(1)
            alike = [b for b in left if most in ends[b]]
            candidates = [c for c in ends[alike[0]] if all(c in ends[b] for b in alike)]
            explained = self._with_best_undone(windows[alike], candidates)
            found |= dict(zip(alike, explained, strict=True))
            left = [b for b in left if b not in alike]
        return found

    def _with_best_undone(self, windows: FloatArray, candidates: Sequence[Rearrangement]) -> list[FaultExplanation]:
        """Windows (B, T, C) with the candidate undone with which they fit best.

        Where several fit equally well, one fault of all their channels, and the windows are refined without these.
        """
        some = windows[:TRIED]
        restored = np.concatenate([candidate.undone(some) for candidate in candidates])
        costs = self.restorer.cost(restored).reshape(len(candidates), -1).sum(axis=1)
        likely = [c for c, cost in zip(candidates, costs, strict=True) if cost < costs.min() + 2 * EVIDENT]
        faults = [c.fault(self.names) for c in likely]
        if len(likely) > 1:
            channels = dict.fromkeys(channel for fault in faults for channel in fault.channel.split("|"))
            together = MeasurementFault("|".join(channels), faults[0].kind, faults[0].value)
            return self._without(windows, [(together,)] * len(windows))
        restored, known = likely[0].undone(windows), [tuple(faults)] * len(windows)
        return self.restorer.or_uncorrected(restored, known, self.restorer.by_steps(restored, known))

    def _without(self, windows: FloatArray, faults: Sequence[Faults]) -> list[FaultExplanation]:
        """Windows (B, T, C) without the channels that the faults of each name."""
        return self.restorer.or_uncorrected(windows, faults, self.restorer.without(windows, faults))

    def explain(self, windows: FloatArray, bad: IntArray) -> dict[int, FaultExplanation]:
        """Explanations of the windows `bad` of a batch (B, T, C), by index; those without one are left out."""
        found = self._explain(windows[bad[:TRIED]], bad[:TRIED])
        common = self._most_common(found)
        if common is not None:  # what most of them have is tried first with the others
            others = np.array([b for b in bad if b not in found or self._key(found[b].point) != self._key(common)])
            found |= self._by_steps(windows, others, common)
        together = self._estimated_together(found)
        if together is not None:
            found |= self._by_steps(windows, unexplained(bad, found), together)
        if found:
            rest = unexplained(bad[TRIED:], found)
            found |= self._explain(windows[rest], rest)
        return found

    def _by_steps(
        self, windows: FloatArray, rows: IntArray, start: FloatArray | None = None, *, step: Step | None = None
    ) -> dict[int, FaultExplanation]:
        """Explanations, by index, of the windows `rows` of a batch (B, T, C), see `Restorer.by_steps`."""
        if not len(rows):
            return {}
        explained = self.restorer.by_steps(windows[rows], [()] * len(rows), start, step=step)
        return {int(rows[i]): e for i, e in explained.items()}

    def _key(self, point: FloatArray) -> tuple[int, ...]:
        """Which gains and delays among deviations (H,) are not 0."""
        return tuple(int(h) for h in np.flatnonzero(point[: 2 * self.channels]))

    def _most_common(self, found: dict[int, FaultExplanation]) -> FloatArray | None:
        """The deviations that most of the explained windows have in common, at their median; None: there are none."""
        plain = [e.point for e in found.values() if self._key(e.point)]
        keys = [self._key(point) for point in plain]
        most = max(keys, key=keys.count, default=())
        if keys.count(most) < 2:
            return None
        return np.asarray(np.median([p for p, key in zip(plain, keys, strict=True) if key == most], axis=0))

    def _estimated_together(self, found: dict[int, FaultExplanation]) -> FloatArray | None:
        """Gains and delays as the explained windows of a batch determine them together; None: fewer than two do."""
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
        """Explanations of windows (B, T, C) without those of others, by their `names` (B,)."""
        stuck = [self.stuck.channels(window) for window in windows]
        noisy = {i: its for i, faults in enumerate(stuck) if not faults and (its := self.stuck.noisy(windows[i]))}
        at = list(noisy)
        found = {at[k]: e for k, e in self.restorer.without(windows[at], list(noisy.values())).items()}
        plain = np.array([i for i, faults in enumerate(stuck) if not faults], dtype=np.int64)
        found |= self._by_deviations(windows, unexplained(plain, found))
        still = [i for i, faults in enumerate(stuck) if faults]
        found |= dict(zip(still, self._without(windows[still], [stuck[i] for i in still]), strict=True))
        late = 0
        for i, window in enumerate(windows):
            if i not in found:
                strong = self._trials.rearranged(window)
                if strong is None and late < _LATE_TRIED:
                    strong, late = self._trials.late(window, far=late < _FAR_TRIED), late + 1
                if strong is not None:
                    found[i] = strong
        return {int(names[i]): explained for i, explained in found.items()}

    def _by_deviations(self, windows: FloatArray, rows: IntArray) -> dict[int, FaultExplanation]:
        """Explanations, by index, of the windows `rows` of a batch (B, T, C): by single deviations, else by the delays
        of all clocks, else by all gains and delays."""
        found = self._by_steps(windows, rows)
        if len(self.steps.clocks) > 1:
            found |= self._by_steps(windows, unexplained(rows, found), step=self.steps.of_clocks)
        by_all = self._by_steps(windows, unexplained(rows, found), step=self.steps.of_all)
        return found | {i: self._within_tolerance(e) for i, e in by_all.items()}

    def _within_tolerance(self, cause: FaultExplanation) -> FaultExplanation:
        """An explanation by all gains and delays together; only what no data sheet leaves open is a fault."""
        far = self.corrections.measured & (np.abs(cause.point) > _TOLERATED * self.steps.std)
        return replace(cause, faults=self.corrections.named(np.where(far, cause.point, 0.0)))

    def with_earlier(self, before: FloatArray, cause: FaultExplanation) -> FaultExplanation:
        """The explanation of a window from which the deviations `before` (H,) had been taken back already."""
        if not before.any():
            return cause
        C, point, before = self.channels, cause.point.copy(), before.copy()
        for fault in cause.faults:
            columns = [self.names.index(name) for name in fault.channel.split("|")]
            if fault.kind == "swapped" and len(columns) == 2:  # columns were corrected, then exchanged
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


def _numbers(things: Sequence[object]) -> IntArray:
    """A number for each that only equal ones share."""
    return np.array([things.index(thing) for thing in things], dtype=np.int64)

"""Windows in, estimates out: the trained estimator gives the start, the simulator refines it."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np

from sprung.model.ambient.foreseen import foreseen
from sprung.model.ambient.identify import AmbientIdentifier, OutputOnlyIdentifier
from sprung.model.identification.amortised.estimator import Estimator, bundled_estimator, load_estimator
from sprung.model.identification.estimates import EXCITED, estimates, not_identified
from sprung.model.identification.excitation import simulate_runs
from sprung.model.identification.fault_isolation.explainer import Explainer
from sprung.model.identification.fault_isolation.explanation import FaultExplanation, fits, unexplained
from sprung.model.identification.fault_isolation.restoring import Restorer
from sprung.model.identification.likelihood.linearise import PRIOR_STD, prior_std
from sprung.model.identification.measurements.deviations import deviations
from sprung.model.identification.model_uncertainty import ModelUncertainty, model_uncertainty
from sprung.model.identification.nonlinear.with_laws import LawRefiner, acting_laws
from sprung.model.identification.refinement.any_inputs import RefinerOfAnyInputs
from sprung.model.identification.refinement.refine import Refined, Refiner, Refines, in_order
from sprung.model.identification.window_deviations import deviating_of
from sprung.model.identifier import Identifies, StageTimes, UnusableWindow, checked_windows
from sprung.model.signals import BoolArray, Estimate, FloatArray, IntArray, MeasurementFault
from sprung.model.simulate.drives import ORDERS, drives_of
from sprung.model.system import System
from sprung.model.text import some
from sprung.model.work import WorkBudget

SOUGHT = ("frozen", "saturated", "noisy", "inverted", "swapped")  # known faults that windows are looked at for first
MANY = 24  # windows of a batch without start values, from which on some are refined first to start the others
PILOTS = 6  # of these; their median is near, since batches are of one vehicle for the most part
NOT_EXPLAINED = "whether a measurement is wrong was not looked into to the end: it takes longer than "


def _no_limit() -> WorkBudget:
    return WorkBudget(clock=time.thread_time)


@dataclass(slots=True)
class Identifier:
    """Identifies windows of one system.  Stateless but for `times`, cached workspaces and the work of the present
    batch; use one per thread.

    workers: threads that share a batch of windows (see `Refiner`).  seconds: of processor time of this thread that a
    window of a system with laws may take, on average over a batch; only for one worker.
    """

    system: System
    estimator: Estimator | None = None
    workers: int = 1
    seconds: float = math.inf
    times: StageTimes = field(default_factory=StageTimes)
    _refiners: dict[int, RefinerOfAnyInputs] = field(default_factory=dict)
    _explainers: dict[int, Explainer] = field(default_factory=dict)
    _model_uncertainty: ModelUncertainty | None = None
    _work: WorkBudget = field(default_factory=_no_limit)

    @property
    def digest(self) -> str:
        """Names the model that made an estimate: system, and weights where an estimator is used."""
        return self.system.digest + (f"-{self.estimator.digest}" if self.estimator is not None else "")

    def identify(
        self,
        windows: FloatArray,
        start: FloatArray | None = None,
        *,
        states: bool = False,
        loads: bool = False,
        weigh: BoolArray | None = None,
    ) -> list[Estimate]:
        """One `Estimate` per window.

        windows: (B, T, C) in the order of `system.channels`, NaN columns for channels that are absent.
        start: log-ratios (B, P) to refine from, such as the tracker's; the estimator's where left out.
        states: estimates hold the simulated outputs.
        loads: what the vehicle carries is refined along even where the file does not declare it, so that outputs are
        those of the loaded vehicle.
        weigh: windows (B,) whose evidence on gains, delays and loads is wanted, see `Estimate.deviating`.
        A window that lacks all sensors, or inputs without which nothing can be said (`System.needed`), is not
        identified, with the reason.  Errors: `UnusableWindow` for a wrong shape or infinite values.
        """
        windows = checked_windows(self.system, windows)
        usable = self._usable(windows)
        if not usable.all():
            given, wanted = None if start is None else start[usable], None if weigh is None else weigh[usable]
            return self._unusable_among(
                windows, self.identify(windows[usable], given, states=states, loads=loads, weigh=wanted)
            )
        if len(windows) == 0:
            return []
        windows = self.system.undistorted(windows)
        self._allow(windows)
        loads = bool(self.system.loads) and (loads or any(load.declared for load in self.system.loads))
        begin = time.perf_counter()
        start = self._start(windows, start, loads=loads)
        between = time.perf_counter()
        refined = self._refiner(windows.shape[1]).refine(windows, start, states=states, loads=loads, weigh=weigh)
        found = [self._with_model_uncertainty(estimate) for estimate in self._estimates(refined, states)]
        self.times = StageTimes(between - begin, time.perf_counter() - between)
        return found

    def examine(
        self,
        windows: FloatArray,
        weigh: BoolArray,
        known: Sequence[tuple[MeasurementFault, ...]] = (),
        start: FloatArray | None = None,
    ) -> list[Estimate]:
        """As a tracker wants it: loads are refined along, the windows `weigh` (B,) say what they know of gains and
        delays, and a wrong measurement is looked for where windows do not fit (`fault_isolation.explainer`).

        known: frozen, reversed and exchanged channels that earlier windows of the vehicle had, for each window: where
        a window has them again, nothing else is tried; and gains and delays, which are taken back first, so that what
        a window says of measurements is linear in what is left of them.  windows, start: see `identify`.
        """
        windows = checked_windows(self.system, windows)
        usable = self._usable(windows)
        if not usable.all():
            of_usable = [its for its, good in zip(known, usable, strict=True) if good] if known else ()
            given = None if start is None else start[usable]
            return self._unusable_among(windows, self.examine(windows[usable], weigh[usable], of_usable, given))
        if len(windows) == 0:
            return []
        windows = self.system.undistorted(windows)
        begin = time.perf_counter()
        self._allow(windows)
        faults = [tuple(f for f in its if f.kind in SOUGHT) for its in known] or [()] * len(windows)
        explainer, whole = self._explainer(windows.shape[1]), np.empty(len(windows), dtype=object)
        corrections = explainer.corrections
        points, estimating = corrections.points(known, len(windows)), 0.0
        for edge in np.unique(corrections.margin(points)):
            rows = np.flatnonzero(corrections.margin(points) == edge)
            right = corrections.corrected(windows[rows], points[rows]) if points[rows].any() else windows[rows]
            started = time.perf_counter()
            its_start = self._start(right, None if start is None else start[rows], loads=bool(self.system.loads))
            estimating += time.perf_counter() - started
            inner = right[:, edge : windows.shape[1] - edge]
            whole[rows] = self._examined(
                inner, weigh[rows], [faults[b] for b in rows.tolist()], its_start, points[rows]
            )
        self.times = StageTimes(estimating, time.perf_counter() - begin - estimating)
        return list(whole)

    def _examined(
        self,
        windows: FloatArray,
        weigh: BoolArray,
        known: Sequence[tuple[MeasurementFault, ...]],
        start: FloatArray | None,
        points: FloatArray,
    ) -> list[Estimate]:
        """Windows (B, T, C) from which the deviations `points` (B, H) have been taken back; known: hard faults."""
        explainer = self._explainer(windows.shape[1])
        moved = self._refiner(windows.shape[1]).model.excitation(windows) > EXCITED
        explained, contradicted = self._explained_beforehand(windows, known, explainer, moved)
        plain = unexplained(np.arange(len(windows)), explained)
        its_start = None if start is None else start[plain]
        found = self._plainly(windows[plain], weigh[plain], its_start, points[plain], moved[plain])
        asks = contradicted[plain] | np.array([e.informative and self._asks(e, explainer) for e in found], dtype=bool)
        explained |= explainer.explain(windows, plain[asks])
        whole = dict(zip(plain.tolist(), found, strict=True))
        whole |= {b: self._restored(explainer.with_earlier(points[b], e)) for b, e in explained.items()}
        for b in unexplained(plain, explained).tolist():
            if not whole[b].informative:
                whole[b] = replace(whole[b], faults=explainer.stuck.all_inputs(windows[b]))
        for b in np.flatnonzero(np.isnan(windows).any(axis=(1, 2))).tolist():
            whole[b] = replace(whole[b], faults=(*whole[b].faults, *explainer.stuck.silent(windows[b])))
        if self._work.ended:
            whole |= {b: self._as_far_as_looked_into(whole[b]) for b in [*explained, *plain[asks].tolist()]}
        return [whole[b] for b in range(len(windows))]

    def _explained_beforehand(
        self,
        windows: FloatArray,
        known: Sequence[tuple[MeasurementFault, ...]],
        explainer: Explainer,
        moved: BoolArray,
    ) -> tuple[dict[int, FaultExplanation], BoolArray]:
        """Windows, by index, with the faults that their vehicle had before or with redundant channels that contradict
        each other, corrected; and which windows contain such a contradiction, (B,).  moved: by their inputs, (B,)."""
        explained = explainer.from_known_faults(windows, {b: its for b, its in enumerate(known) if its and moved[b]})
        contradicted = moved & explainer.contradictions.contradicted(windows)
        explained |= explainer.from_contradictions(windows, unexplained(np.flatnonzero(contradicted), explained))
        return explained, contradicted

    def _as_far_as_looked_into(self, estimate: Estimate) -> Estimate:
        """An estimate for which no more faults are tried, since the time is over."""
        if estimate.identified and not estimate.adequate:
            return replace(estimate, reason=NOT_EXPLAINED + self._limit)
        return estimate

    def _plainly(
        self, windows: FloatArray, weigh: BoolArray, start: FloatArray | None, points: FloatArray, moved: BoolArray
    ) -> list[Estimate]:
        """Windows (B, T, C) as a tracker wants them, taken for right once `points` (B, H) have been taken back.

        moved: whose inputs move, (B,).  The others carry no information, however long they are refined.
        """
        if len(windows) == 0:
            return []
        loads, built = bool(self.system.loads), bool(self.system.built)
        parts: list[tuple[IntArray, Refined]] = []

        def refine(rows: IntArray, begin: FloatArray | None, along: partial[Refined]) -> Refined:
            parts.append((rows, along(windows[rows], begin, weigh=weigh[rows] & moved[rows])))
            return parts[-1][1]

        linear = not self._with_laws
        fully = partial(self._refiner(windows.shape[1]).refine, loads=loads, built=built)
        stands = np.flatnonzero(~moved) if linear else np.zeros(0, dtype=np.int64)
        rides = np.setdiff1d(np.arange(len(windows)), stands)
        if len(stands):
            refine(stands, None if start is None else start[stands], partial(fully, iterations=1))
        if start is None and linear and len(rides) >= MANY:
            pilots = rides[np.linspace(0, len(rides) - 1, PILOTS).astype(np.int64)]
            first, rides = refine(pilots, None, fully), np.setdiff1d(rides, pilots)
            good = fits(first)
            median = np.median(first.log_ratio[good], axis=0) if good.any() else np.zeros(first.log_ratio.shape[1])
            refine(rides, np.tile(median, (len(rides), 1)), fully)
        elif len(rides):
            refine(rides, None if start is None else start[rides], fully)
        refined = in_order([part for _, part in parts], np.concatenate([rows for rows, _ in parts]))
        return self._estimates(refined, False, points)

    def _restored(self, cause: FaultExplanation) -> Estimate:
        """The estimate of a window whose measurements were corrected."""
        (restored,) = self._estimates(cause.refined, False, cause.point[None])
        fitting, known = restored.adequate and cause.corrected, restored.identified or bool(cause.faults)
        return replace(self._averaged(restored), faults=cause.faults, adequate=fitting, identified=known)

    def _allow(self, windows: FloatArray) -> None:
        """Begin to count the work for some windows."""
        self._work.until = time.thread_time() + self.seconds * len(windows)

    def _start(self, windows: FloatArray, start: FloatArray | None, *, loads: bool) -> FloatArray | None:
        """Log-ratios (B, P) to refine from: those given, or the estimator's where there is one."""
        if start is not None or self.estimator is None or windows.shape[1] != self.estimator.samples:
            return start
        return self._begin(windows, self.workers, loads)

    def _begin(self, windows: FloatArray, workers: int, loads: bool) -> FloatArray | None:
        """The estimator's start; nominal values for windows that lack inputs, None where all of them do."""
        if self.estimator is None:
            return None
        whole = ~self._refiner(windows.shape[1]).lacks(windows).any(axis=1)
        if not whole.any():
            return None
        found = self.estimator.start(windows[whole], workers, loads=loads)
        if whole.all():
            return found
        start = np.zeros((len(windows), found.shape[1]))
        start[whole] = found
        return start

    def _estimates(self, refined: Refined, states: bool, points: FloatArray | None = None) -> list[Estimate]:
        """points: deviations (B, H) that were taken back from the samples before."""
        P = len(self.system.tracked)
        spread = prior_std(self.system)[len(self.system.parameters) :]
        channels = len(self.system.channels)
        point = [None if points is None or not points[b].any() else points[b] for b in range(len(refined.log_ratio))]
        deviating = [deviating_of(refined, b, P, channels, spread, at) for b, at in enumerate(point)]
        return estimates(refined, P, states, deviating, self._limit)

    @property
    def _limit(self) -> str:
        return f"{self.seconds:g} s of processor time"

    def _with_model_uncertainty(self, estimate: Estimate) -> Estimate:
        """With what masses that are not quite those of the file, and laws between samples, leave open."""
        if self._model_uncertainty is None:
            self._model_uncertainty = model_uncertainty(
                self.system, loads=any(load.declared for load in self.system.loads)
            )
        if self._model_uncertainty.none:
            return estimate
        identifiable = np.outer(estimate.identifiable, estimate.identifiable)
        return replace(
            estimate, covariance=estimate.covariance + np.where(identifiable, self._model_uncertainty.parameters, 0.0)
        )

    def _asks(self, estimate: Estimate, explainer: Explainer) -> bool:
        """Whether a window should be explained: it does not fit, or fits better elsewhere by far."""
        found = estimate.deviating
        if estimate.adequate and found is not None and found.whole:
            return explainer.steps.apart(found.score, found.information)
        return not estimate.adequate

    def _averaged(self, estimate: Estimate) -> Estimate:
        """A corrected window with what is left open of its deviations in the values and their covariance."""
        found = estimate.deviating
        if found is None:
            return estimate
        prior = np.array([d.std for d in deviations(self.system)])
        spread = np.linalg.inv(found.information + np.diag(1 / prior**2))
        shift = spread @ found.score
        moved = np.where(estimate.identifiable, found.cross @ shift, 0.0)
        return replace(
            estimate,
            log_ratio=estimate.log_ratio + moved,
            covariance=estimate.covariance + found.cross @ spread @ found.cross.T,
            deviating=replace(found, point=found.point + shift, score=found.score - found.information @ shift),
        )

    def _explainer(self, samples: int) -> Explainer:
        if samples not in self._explainers:
            estimator = self.estimator
            fitting = estimator is not None and estimator.samples == samples
            start = partial(self._begin, workers=1, loads=bool(self.system.loads)) if fitting else _nothing
            self._explainers[samples] = Explainer(Restorer(self.system, samples, self._refiner, start))
        return self._explainers[samples]

    def _refiner(self, samples: int) -> RefinerOfAnyInputs:
        if samples not in self._refiners:
            self._refiners[samples] = RefinerOfAnyInputs(self.system, partial(self._new_refiner, samples=samples))
        return self._refiners[samples]

    def _new_refiner(self, system: System, samples: int) -> Refines:
        """Of this system or of it while channels are lost."""
        if self._with_laws:
            return LawRefiner(system, samples, self.workers, self._work)
        return Refiner(system.whole_system, samples, self.workers)

    @property
    def _with_laws(self) -> bool:
        """Whether laws act that make the system non-linear."""
        return bool(acting_laws(self.system))

    def _needed(self) -> list[tuple[str, list[int]]]:
        """Sets of columns, of each of which a window must contain one at least: what it lacks without, and which."""
        at = {channel.name: column for column, channel in enumerate(self.system.channels)}
        found = []
        for what, names in (*(("input", one) for one in self.system.needed), ("sensor", set(self.system.sensors))):
            found.append((f"missing {what} {some(sorted(names), 1)}", [at[name] for name in names]))
        return found

    def _lacks(self, windows: FloatArray) -> BoolArray:
        """Of which sets of `_needed` windows (B, T, C) have no channel, (B, sets)."""
        absent: BoolArray = np.asarray(np.isnan(windows).any(axis=1))
        return np.stack([absent[:, columns].all(axis=1) for _, columns in self._needed()], axis=1)

    def _usable(self, windows: FloatArray) -> BoolArray:
        """Which windows (B, T, C) have enough inputs and a sensor, (B,)."""
        return np.asarray(~self._lacks(windows).any(axis=1))

    def _unusable_among(self, windows: FloatArray, found: list[Estimate]) -> list[Estimate]:
        """One estimate for each of windows (B, T, C): those `found`, and none, with the reason, for the unusable."""
        left, P, S = iter(found), len(self.system.tracked), len(self.system.sensors)
        needed = self._needed()
        return [
            not_identified(P, S, needed[int(np.argmax(lacks))][0]) if lacks.any() else next(left)
            for lacks in self._lacks(windows)
        ]


def _nothing(windows: FloatArray) -> None:
    """No start for windows (B, T, C)."""


def load_identifier(
    system: System, model: str | Path | None = None, workers: int = 1, seconds: float = math.inf
) -> Identifies:
    """The system's identifier with trained weights from `model` (a directory), or the bundled ones if they fit.

    seconds: of processor time that a window may take where the system has laws, see `Identifier`.

    Without weights for the system the refinement starts from the nominal values.  Systems on a track, or without any
    input, are identified from the spectra of their sensors (`model.ambient`), for which there is nothing to train.
    """
    if system.laws:
        return _with_laws(system, workers, seconds)
    if system.on_track:
        return AmbientIdentifier(system)
    if not system.file.inputs:
        return OutputOnlyIdentifier(system)
    estimator = load_estimator(model, system) if model is not None else bundled_estimator(system)
    return Identifier(system, estimator, workers)


def without_weights(system: System) -> str:
    """Why no weights are used for a system's windows, in words; empty where they are."""
    if system.laws:
        return f"{system.name} has laws, and windows with laws begin at the values of the system file"
    if system.on_track or not system.file.inputs:
        return f"{system.name} has no measured inputs, and is identified from spectra"
    return ""


def _with_laws(system: System, workers: int, seconds: float) -> Identifies:
    """The identifier of a system file with laws.  Errors: `UnusableWindow` for a law that windows cannot hold."""
    if system.on_track or not system.file.inputs:
        raise UnusableWindow(f"{system.name}: laws can be tracked where the inputs are measured; leave them out")
    if acting_laws(system) and any(drive.integrated == ORDERS["acceleration"] for drive in drives_of(system)):
        raise UnusableWindow(
            f"{system.name}: laws act along deflections, which accelerations alone leave open; "
            "measure the supports' displacement or velocity as well, or leave the laws out"
        )
    return Identifier(system, None, workers, seconds)


def identifiability(system: System, seed: int = 0) -> FloatArray:
    """Standard deviation of each log-ratio that one simulated window gives at the nominal values, shape (P,).

    Loads that the file names are as unknown as they are to `Identifier.identify`.
    The median over 16 windows of running on an average track; `PRIOR_STD` where a window is uninformative.  Without
    measured inputs what the spectra of an unmeasured track, or of ambient forces, determine.
    """
    if not system.parameters:
        return np.zeros(0)
    if system.on_track or not system.file.inputs:
        return foreseen(system)
    truth = np.zeros((16, len(system.parameters)))
    runs = simulate_runs(system, truth, system.window, np.random.default_rng(seed))
    loads = any(load.declared for load in system.loads)
    refined = Refiner(system).refine(runs.values, truth, loads=loads)
    std = np.sqrt(np.diagonal(refined.covariance, axis1=1, axis2=2))[:, : truth.shape[1]]
    found: FloatArray = np.minimum(np.median(std, axis=0), PRIOR_STD)
    return found

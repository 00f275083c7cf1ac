"""Tracker: window estimates in, a posterior, drift, alarms and health of every parameter out.

Pure: no clock, no files; `update` returns a new state and touches nothing else.  docs/tracking.md derives what runs.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from scipy.linalg.lapack import dpotrf

from sprung.model.signals import BoolArray, Estimate, FloatArray
from sprung.model.tracking import changes as change_test
from sprung.model.tracking import coverage, misfit, scatter, surprise
from sprung.model.tracking import filter as kalman
from sprung.model.tracking.settings import TrackerSettings, TrackerSettingsError
from sprung.model.tracking.state import Alarm, Health, Severity, TrackerState, TrackerStateError

__all__ = [
    "Alarm",
    "Health",
    "ParameterReport",
    "Tracker",
    "TrackerSettings",
    "TrackerSettingsError",
    "TrackerState",
    "TrackerStateError",
]

OUTLYING = 4.0  # standard deviations of a window about its prediction that a baseline is learned from
KNOWN = 0.5  # a posterior narrower than this share of the prior counts as identified


class ParameterLike(Protocol):
    """What the tracker needs to know about a parameter."""

    @property
    def name(self) -> str: ...
    @property
    def unit(self) -> str: ...
    @property
    def nominal(self) -> float: ...


@dataclass(frozen=True, slots=True)
class ParameterReport:
    """Where one parameter stands."""

    name: str
    unit: str
    nominal: float  # `unit`
    value: float  # posterior, `unit`
    std: float
    ratio: float  # value / nominal
    log_ratio: float  # posterior mean of log(value / nominal)
    log_std: float
    identifiable: bool  # False: what is reported is the prior
    baseline: float | None  # the vehicle's own healthy value, `unit`; None while it is learned
    baseline_std: float | None
    drift: float | None  # value / baseline - 1
    drift_std: float | None


class Tracker:
    """Fuses window estimates of `parameters` (P of them, in the order of the estimates)."""

    def __init__(self, parameters: Sequence[ParameterLike], settings: TrackerSettings | None = None) -> None:
        if not parameters:
            raise TrackerSettingsError("a tracker needs at least one parameter to estimate")
        self.parameters = tuple(parameters)
        self.names = tuple(parameter.name for parameter in self.parameters)
        self.settings = settings or TrackerSettings()

    def initial_state(self) -> TrackerState:
        """Nothing seen yet."""
        size = len(self.names)
        return TrackerState(
            names=self.names,
            time=None,
            last=None,
            used=0,
            rejected=0,
            idle=0,
            outliers=0,
            belief=kalman.prior(size, self.settings.prior, self.settings.process),
            scatter=scatter.start((size,)),
            surprise=surprise.start(size),
            changes=change_test.start((size,)),
            fit=misfit.Fit(),
            alarms=(),
        )

    def update(self, state: TrackerState, estimate: Estimate, time_ns: int) -> TrackerState:
        """State after the window that starts at `time_ns`; a window not later than the last is ignored.

        One without excitation speaks neither for nor against anything: it only passes the time.
        """
        self._check(state, estimate)
        if state.time is not None and time_ns <= state.time:
            return state
        seen = coverage.update(state.coverage, usable=True)
        if not estimate.informative:
            return replace(state, time=time_ns, idle=state.idle + 1, coverage=seen)
        centre = time_ns + _ns(self.settings.window / 2)
        usable = estimate.adequate and estimate.converged
        mask = estimate.identifiable & np.isfinite(estimate.log_ratio)
        new = replace(state, rejected=state.rejected + 1)
        if usable and mask.any() and _proper(estimate.covariance[np.ix_(mask, mask)]):
            new = self._fuse(state, estimate, mask, time_ns, centre)
        fit = misfit.update(
            state.fit,
            estimate.chi_square,
            adequate=estimate.adequate,
            inflation=float(new.scatter.inflation.max()),
            time=centre,
        )
        new = replace(new, time=time_ns, fit=fit, coverage=seen)
        return replace(new, alarms=self._alarms(new, centre))

    def missed(self, state: TrackerState) -> TrackerState:
        """State after a window that was of no use (samples lost, a gap): nobody watched the vehicle meanwhile."""
        return replace(state, coverage=coverage.update(state.coverage, usable=False))

    def rebase(self, state: TrackerState, time_ns: int) -> TrackerState:
        """State before a window that starts at `time_ns`, though the last one was stamped later: a clock was wrong.

        What is under way (anchors, onsets that are not alarms yet) moves along, as if one window followed the other;
        what was stated with its time stays as it was stated.
        """
        if state.time is None or time_ns > state.time:
            return state
        shift = time_ns - _ns(self.settings.hop) - state.time
        changes, fit = state.changes, state.fit
        return replace(
            state,
            time=state.time + shift,
            last=None if state.last is None else state.last + shift,
            scatter=replace(state.scatter, anchored=state.scatter.anchored + shift),
            changes=replace(changes, up_since=changes.up_since + shift, down_since=changes.down_since + shift),
            fit=replace(
                fit,
                rising_since=fit.rising_since + shift,
                misfit_since=None if fit.misfit_since is None else fit.misfit_since + shift,
            ),
        )

    def update_many(self, state: TrackerState, windows: Iterable[tuple[Estimate, int]]) -> TrackerState:
        """`update` over windows in their order."""
        for estimate, time_ns in windows:
            state = self.update(state, estimate, time_ns)
        return state

    def relearn(self, state: TrackerState, names: Iterable[str] | None = None) -> TrackerState:
        """Forgets baselines (all, or those of `names`) after a repair; the next windows fix new ones."""
        chosen = set(self.names if names is None else names)
        unknown = sorted(chosen - set(self.names))
        if unknown:
            raise TrackerStateError(f"no parameter {unknown[0]!r} to relearn; known are {', '.join(self.names)}")
        rows = np.array([name in chosen for name in self.names])
        new = replace(state, changes=change_test.relearn(state.changes, rows))
        return replace(new, alarms=self._alarms(new, state.time or 0))

    def posterior(self, state: TrackerState) -> tuple[FloatArray, FloatArray]:
        """Mean and standard deviation of the log-ratios to nominal, each of shape (P,)."""
        return state.belief.level.copy(), np.sqrt(state.belief.level_variance)

    def report(self, state: TrackerState) -> tuple[ParameterReport, ...]:
        """Every parameter in physical units, against nominal and against the vehicle's own baseline."""
        level, std = self.posterior(state)
        drift, drift_std = self._drift(state)
        base, base_std = state.changes.baseline, np.sqrt(state.changes.baseline_variance)
        learned = state.changes.learned >= self.settings.learning
        reports = []
        for i, parameter in enumerate(self.parameters):
            value, own = parameter.nominal * float(np.exp(level[i])), bool(learned[i])
            healthy = parameter.nominal * float(np.exp(base[i])) if own else None
            reports.append(
                ParameterReport(
                    name=parameter.name,
                    unit=parameter.unit,
                    nominal=parameter.nominal,
                    value=value,
                    std=value * float(std[i]),
                    ratio=value / parameter.nominal,
                    log_ratio=float(level[i]),
                    log_std=float(std[i]),
                    identifiable=bool(std[i] < KNOWN * self.settings.prior),
                    baseline=healthy,
                    baseline_std=None if healthy is None else healthy * float(base_std[i]),
                    drift=float(drift[i]) if own else None,
                    drift_std=float(drift_std[i]) if own else None,
                )
            )
        return tuple(reports)

    def health(self, state: TrackerState) -> Health:
        """NAMUR NE 107: the worst of what is active, in the recommendation's order F, C, S, M.

        A vehicle of which nothing came, or too little lately that could be used, is not monitored: check function.
        """
        peak = max((abs(alarm.change or 0.0) for alarm in state.active), default=0.0)
        severities = {(alarm.kind, alarm.severity) for alarm in state.active}
        if peak >= self.settings.failure_change:
            return "failure"
        if any(kind == "misfit" for kind, _ in severities) or not state.coverage.monitored:
            return "check_function"
        if ("change", "alarm") in severities:
            return "out_of_specification"
        return "maintenance_required" if severities else "ok"

    def _check(self, state: TrackerState, estimate: Estimate) -> None:
        if state.names != self.names:
            raise TrackerStateError(
                f"the tracker's state holds {len(state.names)} parameters ({state.names[0]} ...), "
                f"the system has {len(self.names)} ({self.names[0]} ...); start a new state"
            )
        if estimate.log_ratio.shape != (len(self.names),):
            raise TrackerStateError(
                f"an estimate of {estimate.log_ratio.shape} parameters came; the tracker has {len(self.names)}"
            )

    def _fuse(
        self, state: TrackerState, estimate: Estimate, mask: BoolArray, time_ns: int, centre: int
    ) -> TrackerState:
        """Filter, scatter and change tests after a usable window."""
        settings, process = self.settings, self.settings.process
        elapsed = np.inf if state.last is None else (time_ns - state.last) * 1e-9
        share = min(1.0, elapsed / settings.window)
        value = np.where(mask, estimate.log_ratio, 0.0)
        variance = np.where(mask, np.diag(estimate.covariance), 1.0)

        measured = scatter.update(state.scatter, value, variance, mask, time=time_ns, window=_ns(settings.window))
        wide = np.sqrt(measured.inflation)
        covariance = estimate.covariance * np.outer(wide, wide)
        fresh = variance * measured.inflation / share

        belief = state.belief
        if state.last is not None:
            belief = kalman.predict(belief, elapsed, process, settings.prior)
        known = belief.level_variance < (KNOWN * settings.prior) ** 2
        reach = OUTLYING * np.sqrt(belief.level_variance + variance * measured.inflation)
        plausible = np.clip(value, belief.level - reach, belief.level + reach)
        watch, jumped = surprise.update(
            state.surprise, value - belief.level, belief.level_variance + fresh, mask & known
        )
        if jumped.any():
            belief = kalman.reopen(belief, jumped, process)
        belief, innovation = kalman.correct(belief, value, covariance, mask, share=share, bound=settings.outlier)
        tested = change_test.update(
            state.changes,
            value,
            fresh,
            mask,
            seconds=share * settings.window,
            time=centre,
            settings=settings,
            plausible=plausible,
        )
        return replace(
            state,
            last=time_ns,
            used=state.used + 1,
            outliers=state.outliers + int(innovation.bounded),
            belief=belief,
            scatter=measured,
            surprise=watch,
            changes=tested,
        )

    def _drift(self, state: TrackerState) -> tuple[FloatArray, FloatArray]:
        """value / baseline - 1 and its standard deviation, each of shape (P,); NaN before any window."""
        level, std = self.posterior(state)
        ratio = np.exp(level - state.changes.baseline)
        return ratio - 1.0, ratio * np.sqrt(std**2 + state.changes.baseline_variance)

    def _alarms(self, state: TrackerState, now: int) -> tuple[Alarm, ...]:
        """Alarms after this window: opened, followed, closed."""
        if not state.active and state.misfit_since is None and not state.changes.active.any():
            return state.alarms
        drift, drift_std = self._drift(state)
        active = dict(zip(self.names, state.changes.active, strict=True))
        alarms: list[Alarm] = []
        for alarm in state.alarms:
            if alarm.closed is not None:
                alarms.append(alarm)
            elif alarm.kind == "misfit":
                alarms.append(alarm if state.misfit_since is not None else _closed(alarm, now))
            elif active[alarm.parameter or ""] == 0:
                alarms.append(_closed(alarm, now))
            else:
                i = self.names.index(alarm.parameter or "")
                alarms.append(self._followed(alarm, float(drift[i]), float(drift_std[i])))
        alarmed = {alarm.parameter for alarm in alarms if alarm.closed is None and alarm.kind == "change"}
        for i in range(len(self.names)):
            if state.changes.active[i] != 0 and self.names[i] not in alarmed:
                since = state.changes.up_since if state.changes.active[i] > 0 else state.changes.down_since
                alarm = Alarm("change", self.names[i], int(since[i]), now, "warning", 0.0, 0.0, 0.0)
                alarms.append(self._followed(alarm, float(drift[i]), float(drift_std[i])))
        if state.misfit_since is not None and not any(
            alarm.kind == "misfit" and alarm.closed is None for alarm in alarms
        ):
            alarms.append(Alarm("misfit", None, state.misfit_since, now, "warning"))
        return self._kept(alarms)

    def _followed(self, alarm: Alarm, change: float, std: float) -> Alarm:
        """An active alarm with its change as it is now; severity falls only with hysteresis."""
        limit = self.settings.alarm_change
        if alarm.severity == "alarm":
            limit *= self.settings.hysteresis
        severity: Severity = "alarm" if abs(change) >= limit else "warning"
        peak = change if abs(change) >= abs(alarm.peak or 0.0) else alarm.peak
        return replace(alarm, change=change, std=std, severity=severity, peak=peak)

    def _kept(self, alarms: list[Alarm]) -> tuple[Alarm, ...]:
        """All active alarms and the latest closed ones."""
        closed = [alarm for alarm in alarms if alarm.closed is not None]
        surplus = {alarm.key for alarm in closed[: max(0, len(closed) - self.settings.kept_alarms)]}
        return tuple(alarm for alarm in alarms if alarm.closed is None or alarm.key not in surplus)


def _closed(alarm: Alarm, now: int) -> Alarm:
    """Closed now, or when it was opened if a clock that was wrong then says that this is later."""
    return replace(alarm, closed=max(now, alarm.opened))


def _proper(covariance: FloatArray) -> bool:
    """Whether a window's covariance is one: finite and positive definite."""
    return bool(np.all(np.isfinite(covariance))) and dpotrf(covariance, lower=1)[1] == 0


def _ns(seconds: float) -> int:
    return round(seconds * 1e9)

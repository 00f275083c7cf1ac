"""Tracker: window estimates in, a posterior, drift, alarms and health of every parameter out.

Pure: no clock, no files; `update` returns a new state and touches nothing else.  docs/tracking.md derives what runs.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Protocol

import numpy as np
from scipy.linalg.lapack import dpotrf

from sprung.model.identification.deviations import Deviation, named
from sprung.model.signals import BoolArray, Conditions, Deviating, Estimate, FloatArray, MeasurementFault
from sprung.model.tracking import cargo as cargos
from sprung.model.tracking import changes as change_test
from sprung.model.tracking import coverage, misfit, scatter, surprise
from sprung.model.tracking import deviations as dev
from sprung.model.tracking import filter as kalman
from sprung.model.tracking import weather as weathers
from sprung.model.tracking.alarms import HARD, WINDOWS, Attribution, Drift, LoadLimit, counted
from sprung.model.tracking.cargo import Cargo
from sprung.model.tracking.deviations import Jump
from sprung.model.tracking.settings import TrackerSettings, TrackerSettingsError
from sprung.model.tracking.state import Alarm, Health, TrackerState, TrackerStateError
from sprung.model.tracking.weather import WeatherModel

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
BENT = 4.0  # standard deviations of a window that deviations may move it by without being weighed itself
STILL = 5.0  # log-likelihood ratio of a change above which a parameter teaches no slopes
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
    """Fuses window estimates of `parameters` (P of them, in the order of the estimates).

    deviations: gains, delays and loads that estimates may speak of (H of them, see `Estimate.deviating`); with none,
    what the system file says is taken as it stands.
    """

    def __init__(
        self,
        parameters: Sequence[ParameterLike],
        settings: TrackerSettings | None = None,
        deviations: Sequence[Deviation] = (),
        weather: WeatherModel | None = None,
        limits: Mapping[str, LoadLimit] = MappingProxyType({}),
    ) -> None:
        """weather: what conditions do to parameters, by their names unless given; limits: of loads, by body."""
        if not parameters:
            raise TrackerSettingsError("a tracker needs at least one parameter to estimate")
        self.parameters = tuple(parameters)
        self.names = tuple(parameter.name for parameter in self.parameters)
        self.settings = settings or TrackerSettings()
        self.deviations = tuple(deviations)
        self.model = dev.model_of(self.deviations)
        nominal = [parameter.nominal for parameter in self.parameters]
        self.weather = weather or weathers.model_of(self.names, nominal)
        self._attribution = Attribution(
            self.names, self.settings, self.deviations, self.model, self.weather, dict(limits)
        )
        self._limit = np.sqrt(np.diag(self.model.prior))

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
            belief=kalman.prior(size, self.settings.prior, self.settings.process, self.model.prior),
            scatter=scatter.start((size,)),
            surprise=surprise.start(size),
            changes=change_test.start((size,)),
            fit=misfit.MisfitFloor(),
            calibration=dev.start(size, self.model),
            stuck=(),
            alarms=(),
            weather=weathers.start(self.weather),
            cargo=cargos.start(np.diag(self.model.prior)[self.model.loads]),
        )

    def newcomer(self, others: Iterable[TrackerState]) -> TrackerState:
        """Nothing seen yet, but what other vehicles of the system have learned of weather, load and speed."""
        known = [s.weather for s in others if s.weather is not None and s.names == self.names]
        whole = [w for w in known if len(w.common) == self.weather.groups]
        return replace(self.initial_state(), weather=weathers.start(weathers.pooled(self.weather, whole)))

    def update(
        self, state: TrackerState, estimate: Estimate, time_ns: int, conditions: Conditions | None = None
    ) -> TrackerState:
        """State after the window that starts at `time_ns`; a window not later than the last is ignored.

        One without excitation speaks neither for nor against anything: it only passes the time.  One that does not
        fit in a curve is passed over likewise, where curves are measured.
        """
        self._check(state, estimate)
        state = self._whole(state)
        if state.time is not None and time_ns <= state.time:
            return state
        seen = coverage.update(state.coverage, usable=True)
        if not estimate.informative:
            return replace(state, time=time_ns, idle=state.idle + 1, coverage=seen)
        centre = time_ns + _ns(self.settings.window / 2)
        if conditions is not None and conditions.curving and not estimate.adequate:
            return replace(state, time=time_ns, idle=state.idle + 1, coverage=seen)
        stuck = counted(state.stuck, [(f.channel, f.kind, f.value) for f in estimate.faults], centre)
        usable = estimate.adequate and estimate.converged
        mask = estimate.identifiable & np.isfinite(estimate.log_ratio)
        new, jump = replace(state, rejected=state.rejected + 1), None
        if (
            usable
            and mask.any()
            and not self._bent(state, estimate)
            and _proper(estimate.covariance if mask.all() else estimate.covariance[mask][:, mask])
        ):
            new, jump = self._fuse(state, estimate, mask, time_ns, centre, conditions)
        if usable or not estimate.faults:  # a window whose fault is named is not a riddle
            fit = misfit.update(
                state.fit,
                self._chi_square(new, estimate),
                adequate=estimate.adequate,
                inflation=float(new.scatter.inflation.max()),
                time=centre,
            )
            new = replace(new, fit=fit)
        new = replace(new, time=time_ns, stuck=stuck, coverage=seen)
        told = jump if jump is not None and self._armed(state) else None
        return replace(new, alarms=self._attribution.after(new, self._drift(new), told, centre))

    def _whole(self, state: TrackerState) -> TrackerState:
        """A state of an older format, or of a pooled prior that is gone, knows nothing of weather and pressures."""
        known = state.weather is not None and len(state.weather.common) == self.weather.groups
        loads = int(self.model.loads.sum())
        if known and state.cargo is not None and len(state.cargo.constant) == loads:
            return state
        fresh = self.initial_state()
        return replace(
            state,
            weather=state.weather if known else fresh.weather,
            cargo=state.cargo if state.cargo is not None and len(state.cargo.constant) == loads else fresh.cargo,
        )

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
        changes, fit, calibration = state.changes, state.fit, state.calibration
        weighed = calibration.recent != 0
        weather = state.weather
        if weather is not None:
            weather = replace(weather, began=np.where(weather.began != 0, weather.began + shift, 0))
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
            calibration=replace(
                calibration,
                since=calibration.since + shift,
                recent=np.where(weighed, calibration.recent + shift, 0),
            ),
            stuck=tuple(replace(s, since=s.since + shift) for s in state.stuck),
            weather=weather,
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
        if new.weather is not None:
            new = replace(new, weather=weathers.forgotten(new.weather, self.weather, rows))
        return replace(new, alarms=self._attribution.after(new, self._drift(new), None, state.time or 0))

    def posterior(self, state: TrackerState) -> tuple[FloatArray, FloatArray]:
        """Mean and standard deviation of the log-ratios to nominal, each of shape (P,)."""
        return state.belief.level.copy(), np.sqrt(state.belief.level_variance)

    def report(self, state: TrackerState) -> tuple[ParameterReport, ...]:
        """Every parameter in physical units, against nominal and against the vehicle's own baseline."""
        level, std = self.posterior(state)
        drift = self._drift(state)
        base, base_std = self._baseline(state), np.sqrt(state.changes.baseline_variance)
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
                    drift=float(drift.whole[i]) if own else None,
                    drift_std=float(drift.std[i]) if own else None,
                )
            )
        return tuple(reports)

    def health(self, state: TrackerState) -> Health:
        """NAMUR NE 107: the worst of what is active, in the recommendation's order F, C, S, M.

        A vehicle of which nothing came, or too little lately that could be used, is not monitored: check function.
        """
        changes = [abs(alarm.change or 0.0) for alarm in state.active if alarm.kind == "change"]
        severities = {(alarm.kind, alarm.severity) for alarm in state.active}
        if max(changes, default=0.0) >= self.settings.failure_change:
            return "failure"
        broken = any(a.kind == "sensor" and (a.parameter or "").endswith(HARD) for a in state.active)
        if broken or any(kind == "misfit" for kind, _ in severities) or not state.coverage.monitored:
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

    def sensors(self, state: TrackerState) -> tuple[MeasurementFault, ...]:
        """What is wrong with measurements: stuck channels, and gains and delays that differ from the system file."""
        stuck = [MeasurementFault(s.channel, s.kind, s.value) for s in state.stuck if s.count >= WINDOWS]
        H = self.model.size
        if H == 0 or state.calibration.recent[-1] == 0:
            return tuple(stuck)
        value, std = state.belief.mean[-H:], np.sqrt(np.diag(state.belief.covariance)[-H:])
        least = np.array([dev.NAMED.get(kind, np.inf) for kind in self.model.kinds])
        off = value - self.model.common(value)
        chosen = (np.abs(off) > least) & (np.abs(off) > 3 * std)
        return (*stuck, *named(self.deviations, off, std, chosen))

    def loads(self, state: TrackerState) -> dict[str, tuple[float, float]]:
        """Log-ratio of every known loaded mass to the empty one, with its standard deviation, by body."""
        H = self.model.size
        found = {}
        for h in np.flatnonzero(self.model.loads):
            value, std = state.belief.mean[-H:][h], float(np.sqrt(np.diag(state.belief.covariance)[-H:][h]))
            if std < KNOWN * self._limit[h]:
                found[self.deviations[h].name] = (float(value), std)
        return found

    def _fuse(
        self,
        state: TrackerState,
        estimate: Estimate,
        mask: BoolArray,
        time_ns: int,
        centre: int,
        conditions: Conditions | None,
    ) -> tuple[TrackerState, Jump | None]:
        """Filter, scatter and change tests after a usable window; a deviation that is found to have jumped."""
        settings, model, H = self.settings, self.model, self.model.size
        elapsed = np.inf if state.last is None else (time_ns - state.last) * 1e-9
        share = min(1.0, elapsed / settings.window)
        belief, calibration, jump = state.belief, state.calibration, None
        if state.last is not None:
            belief = kalman.predict(belief, elapsed, settings.process, settings.prior, model.walk, self._limit)
        found = estimate.deviating if H else None
        belief, cargo = self._loaded(state, belief, elapsed, found, conditions)
        if found is not None and not found.whole:
            belief = dev.loaded(belief, model, found, share)
            gains = np.where(model.loads, found.cross, calibration.cross)
            found = replace(found, cross=gains, point=np.where(model.loads, found.point, 0.0))
        elif found is not None:
            apart = (time_ns - int(calibration.recent[-1])) * 1e-9
            calibration, belief, jump, agrees = dev.weigh(
                calibration, model, belief, found, min(1.0, apart / settings.window), time_ns
            )
            if estimate.faults and not agrees:  # mended by what is not believed yet: its values are of neither
                undecided = replace(state, last=time_ns, rejected=state.rejected + 1)
                return replace(undecided, belief=belief, calibration=calibration), None
            if jump is not None and self._armed(state):
                calibration = replace(calibration, moved=np.maximum(calibration.moved, jump.direction != 0))
                state = replace(state, changes=change_test.restarted(state.changes))
        value, covariance, cross = self._at_belief(estimate, found, calibration, belief, mask)
        variance = np.where(mask, covariance.diagonal(), 1.0)
        open_ = self._open(calibration, belief, cross)

        measured = scatter.update(
            state.scatter, value, variance + open_, mask, time=time_ns, window=_ns(settings.window)
        )
        wide = np.sqrt(measured.inflation)
        covariance = covariance * np.outer(wide, wide)
        fresh = (variance + open_) * measured.inflation / share

        known = belief.level_variance < (KNOWN * settings.prior) ** 2
        reach = OUTLYING * np.sqrt(belief.level_variance + variance * measured.inflation)
        plausible = np.clip(value, belief.level - reach, belief.level + reach)
        watch, jumped = surprise.update(
            state.surprise, value - belief.level, belief.level_variance + fresh, mask & known
        )
        if jumped.any():
            belief = kalman.reopen(belief, jumped, settings.process)
            if H:
                belief = dev.unsure(belief, model)
        belief, innovation = kalman.correct(
            belief, value, covariance, mask, share=share, bound=settings.outlier, cross=cross if H else None
        )
        off = self._of_baseline(state, calibration, cross, belief)
        at = weathers.features(conditions, self._load(belief))
        usable = mask & (state.changes.learned >= settings.learning)
        assert state.weather is not None
        weather = weathers.foreseen(state.weather, self.weather, at, learning=not self._armed(state))
        left = np.where(usable, value - off - np.where(usable, state.changes.baseline, 0.0), 0.0)
        weather = weathers.together(weather, self.weather, left, fresh, usable, centre)
        effect = np.where(usable, weather.effect + weathers.shared(weather, self.weather), 0.0)
        doubt = np.where(usable, weather.doubt, 0.0)
        tested = change_test.update(
            state.changes,
            value - off - effect,
            fresh,
            mask,
            seconds=share * settings.window,
            time=centre,
            settings=settings,
            plausible=plausible - off - effect,
            doubt=doubt,
        )
        still = usable & (tested.active == 0) & (np.maximum(tested.up, tested.down) < STILL)
        weather = weathers.learned(weather, self.weather, left, fresh, still, at, centre, share * settings.window)
        new = replace(
            state,
            last=time_ns,
            used=state.used + 1,
            outliers=state.outliers + int(innovation.bounded),
            belief=belief,
            scatter=measured,
            surprise=watch,
            changes=tested,
            calibration=self._learned(state, tested, calibration, cross, belief),
            weather=weather,
            cargo=cargo,
        )
        return new, jump

    def _loaded(
        self,
        state: TrackerState,
        belief: kalman.Belief,
        elapsed: float,
        found: Deviating | None,
        conditions: Conditions | None,
    ) -> tuple[kalman.Belief, Cargo | None]:
        """Loads are open again after a stop, and where a window shows another one; pressures say what they are."""
        model, cargo = self.model, state.cargo
        if not self.model.size or cargo is None or not model.loads.any():
            return belief, cargo
        rows = np.flatnonzero(model.loads) + len(belief.mean) - model.size
        pressure = np.full(len(rows), np.nan)
        if conditions is not None and len(conditions.pressure) == len(rows):
            pressure = np.array(conditions.pressure)
        departs = elapsed - self.settings.window > dev.STOPPED
        changed = found is not None and state.last is not None and not departs and dev.moved(belief, model, found)
        if not (departs or changed):
            return belief, cargos.felt(cargo, pressure)
        if state.last is not None and departs:
            cargo = cargos.arrived(cargo, belief.mean[rows], np.diag(belief.covariance)[rows])
        cargo = cargos.departed(cargo, pressure, np.diag(model.prior)[model.loads])
        return dev.boarded(belief, model, cargo.prior, cargo.prior_variance), cargo

    def _load(self, belief: kalman.Belief) -> float | None:
        """Logarithm of the loaded mass over the empty one, of the first load; None where it is not known."""
        at = np.flatnonzero(self.model.loads)
        if not len(at):
            return None
        row = len(belief.mean) - self.model.size + int(at[0])
        known = belief.covariance[row, row] < (KNOWN * self._limit[at[0]]) ** 2
        return float(belief.mean[row]) if known else None

    def _bent(self, state: TrackerState, estimate: Estimate) -> bool:
        """Whether known deviations move this window so far that mean sensitivities are not good enough for it."""
        if not self.model.size or (estimate.deviating is not None and estimate.deviating.whole):
            return False
        moved = state.calibration.cross @ np.where(self.model.loads, 0, state.belief.mean[-self.model.size :])
        return bool(np.any(np.abs(moved) > BENT * np.sqrt(estimate.covariance.diagonal())))

    def _armed(self, state: TrackerState) -> bool:
        """Whether the vehicle's baseline is known: before, a deviation is found, but has not jumped."""
        return bool(np.any(state.changes.learned >= self.settings.learning))

    def _chi_square(self, state: TrackerState, estimate: Estimate) -> float:
        """That of a window, less what known deviations of the measurements account for."""
        if not self.model.size or estimate.faults:
            return estimate.chi_square
        found = estimate.deviating
        known = (
            float(state.calibration.excess[0])
            if found is None or not found.whole
            else dev.explained(state.belief, found)
        )
        return max(estimate.chi_square - known, 0.1 * estimate.chi_square)

    def _at_belief(
        self,
        estimate: Estimate,
        found: Deviating | None,
        calibration: dev.DeviationRecord,
        belief: kalman.Belief,
        mask: BoolArray,
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Log-ratios (P,) as they are if the deviations are as believed, their covariance, sensitivities (P, H)."""
        value = np.where(mask, estimate.log_ratio, 0.0)
        if not self.model.size:
            return value, estimate.covariance, np.zeros((len(value), 0))
        here = belief.mean[-self.model.size :]
        if found is None:
            return value + np.where(mask, calibration.cross @ here, 0.0), estimate.covariance, calibration.cross
        return value + np.where(mask, found.cross @ (here - found.point), 0.0), found.given, found.cross

    def _open(self, calibration: dev.DeviationRecord, belief: kalman.Belief, cross: FloatArray) -> FloatArray:
        """Variance (P,) that deviations bring in which were otherwise in the windows of the baseline."""
        H = self.model.size
        other = (calibration.moved > 0) | self.model.loads
        if H == 0 or not other.any():
            return np.zeros(len(cross))
        at = np.flatnonzero(other)
        own = belief.covariance[-H:, -H:][at][:, at]
        return np.asarray(((cross[:, at] @ own) * cross[:, at]).sum(axis=1))

    def _of_baseline(
        self, state: TrackerState, calibration: dev.DeviationRecord, cross: FloatArray, belief: kalman.Belief
    ) -> FloatArray:
        """What the deviations of the baseline's windows contribute, (P,); loads are taken out window by window.

        A baseline is learned as if gains and delays were as stated, and compared at those that it was learned with.
        """
        if not self.model.size:
            return np.zeros(len(cross))
        stays = ~self.model.loads
        learned = state.changes.learned >= self.settings.learning
        here = np.where(stays, belief.mean[-self.model.size :], 0.0)
        reference = np.where(stays, calibration.reference, 0.0)
        return np.where(learned, calibration.base_cross @ reference, cross @ here)

    def _learned(
        self,
        state: TrackerState,
        tested: change_test.Changes,
        calibration: dev.DeviationRecord,
        cross: FloatArray,
        belief: kalman.Belief,
    ) -> dev.DeviationRecord:
        """Sensitivities of the baseline's windows, and the deviations that it was learned with."""
        if not self.model.size:
            return calibration
        first = state.changes.learned < self.settings.learning  # what refines a baseline later is taken out before
        more = (tested.weight - state.changes.weight) / np.maximum(tested.weight, 1e-300)
        gained = np.where(first & (tested.weight > 0), more, 0.0)
        base = calibration.base_cross + gained[:, None] * (cross - calibration.base_cross)
        reference = calibration.reference
        if (state.used + 1) * self.settings.hop < dev.SETTLED:
            here, moved = belief.mean[-self.model.size :], calibration.moved > 0
            # What all channels share cannot be known: where it wanders, the reference of one that jumped goes along.
            reference = np.where(moved, reference + self.model.common(here - reference, ~moved), here)
        return replace(calibration, base_cross=base, reference=reference)

    def _baseline(self, state: TrackerState) -> FloatArray:
        """Log-ratio to nominal of the vehicle's own healthy state, shape (P,); NaN before any window."""
        calibration = state.calibration
        base = state.changes.baseline
        if state.weather is not None:
            base = base + state.weather.effect + weathers.usual(state.weather, self.weather)
        if not self.model.size:
            return np.asarray(base)
        reference = np.where(self.model.loads, 0.0, calibration.reference)
        return np.asarray(base + calibration.base_cross @ reference)

    def _drift(self, state: TrackerState) -> Drift:
        """value / baseline - 1 and its standard deviation; NaN before any window."""
        level, std = self.posterior(state)
        whole = level - self._baseline(state)
        own = whole
        if state.weather is not None:
            own = whole - weathers.shared(state.weather, self.weather) + weathers.usual(state.weather, self.weather)
        spread = np.sqrt(std**2 + state.changes.baseline_variance)
        return Drift(np.expm1(own), np.exp(own) * spread, np.expm1(whole))


def _proper(covariance: FloatArray) -> bool:
    """Whether a window's covariance is one: finite and positive definite."""
    return bool(np.all(np.isfinite(covariance))) and dpotrf(covariance, lower=1)[1] == 0


def _ns(seconds: float) -> int:
    return round(seconds * 1e9)

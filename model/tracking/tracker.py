"""Tracker: window estimates in, a posterior, drift, alarms and health of every parameter out.

Pure: no clock, no files; `update` returns a new state and touches nothing else.  docs/tracking.md derives what runs.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType

import numpy as np

from sprung.model.identification.deviations import OWN, Deviation, named
from sprung.model.signals import BuiltOtherwise, Conditions, Estimate, FloatArray, MeasurementFault
from sprung.model.tracking import cargo as cargos
from sprung.model.tracking import changes as change_test
from sprung.model.tracking import coverage, inflation, innovation, misfit
from sprung.model.tracking import deviations as dev
from sprung.model.tracking import filter as kalman
from sprung.model.tracking import weather as weathers
from sprung.model.tracking.alarms import WINDOWS, Attribution, LoadLimit, counted
from sprung.model.tracking.fusion import KNOWN, Fusion, nanoseconds, proper
from sprung.model.tracking.reports import ParameterLike, ParameterReport, health_of, reported
from sprung.model.tracking.settings import TrackerSettings, TrackerSettingsError
from sprung.model.tracking.state import Alarm, Health, Stuck, TrackerState, TrackerStateError
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

MOVING = 10.0  # m/s, from which on wheels move on any track: inputs that are still are not measured
CRAWLING = 5.0  # m/s, below which a vehicle need not be watched either: nothing shakes it


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
        doubt: tuple[FloatArray, FloatArray] | None = None,
        masses: Mapping[str, tuple[str, ...]] = MappingProxyType({}),
    ) -> None:
        """weather: what conditions do to parameters, by their names unless given; limits: of loads, by body.

        doubt: variance of the log-ratios (P,), and covariance of the deviations (H, H), that no window will ever take
        away, since all have it alike: masses that are not quite those of the file.  It is part of what is stated, not
        of changes.  masses: bodies whose mass is the scale of what is estimated, and the elements at them.
        """
        if not parameters:
            raise TrackerSettingsError("a tracker needs at least one parameter to estimate")
        self.parameters = tuple(parameters)
        self.names = tuple(parameter.name for parameter in self.parameters)
        self.settings = settings or TrackerSettings()
        self.deviations = tuple(deviations)
        self.model = dev.model_of(self.deviations)
        nominal = [parameter.nominal for parameter in self.parameters]
        self.weather = weather or weathers.model_of(self.names, nominal)
        self._doubt = doubt or (np.zeros(len(self.names)), np.zeros((self.model.size, self.model.size)))
        self._attribution = Attribution(
            self.names, self.settings, self.deviations, self.model, self.weather, dict(limits), dict(masses)
        )
        self._fusion = Fusion(self.settings, self.model, self.weather)

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
            inflation=inflation.start((size,)),
            innovation=innovation.start(size),
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
        state = self.whole(state)
        if state.time is not None and time_ns <= state.time:
            return state
        centre = time_ns + nanoseconds(self.settings.window / 2)
        curving = conditions is not None and conditions.curving and not estimate.adequate
        if curving or not estimate.informative:
            return self._passed_over(state, estimate, time_ns, centre, conditions)
        stuck = _stuck(state, estimate, centre)
        usable = estimate.adequate and estimate.converged
        mask = estimate.identifiable & np.isfinite(estimate.log_ratio)
        new, jump = replace(state, rejected=state.rejected + 1), None
        if (
            usable
            and mask.any()
            and not self._fusion.bent(state, estimate)
            and proper(estimate.covariance if mask.all() else estimate.covariance[mask][:, mask])
        ):
            new, jump = self._fusion.fuse(state, estimate, mask, time_ns, centre, conditions)
        if usable or not estimate.faults:  # a window whose fault is named is not a riddle
            fit = misfit.update(
                state.fit,
                self._fusion.chi_square(new, estimate),
                adequate=estimate.adequate,
                inflation=float(new.inflation.factor.max()),
                time=centre,
            )
            new = replace(new, fit=fit)
        seen = coverage.update(state.coverage, usable=new.used > state.used)
        new = replace(new, time=time_ns, stuck=stuck, coverage=seen)
        told = jump if jump is not None and self._fusion.armed(state) else None
        return replace(new, alarms=self._attribution.after(new, self._fusion.drift(new), told, centre))

    def _passed_over(
        self, state: TrackerState, estimate: Estimate, time_ns: int, centre: int, conditions: Conditions | None
    ) -> TrackerState:
        """State after a window that speaks neither for nor against anything.

        Nobody can watch a vehicle that stands.  One that runs is not watched meanwhile: where inputs are still though
        it is fast, or frozen, and where a window does not fit in a curve; a yaw rate whose zero is off makes every
        window one.  Where it runs too slowly to tell anything, what was told last holds for a while.
        """
        speed = np.nan if conditions is None else conditions.speed
        runs = estimate.informative or speed > MOVING or bool(estimate.faults)
        known = state.last is not None and (time_ns - state.last) * 1e-9 < self.settings.holding
        seen = coverage.update(state.coverage, usable=not runs and (known or not estimate.running or speed < CRAWLING))
        new = replace(state, time=time_ns, idle=state.idle + 1, coverage=seen)
        if estimate.informative or not estimate.faults:
            return new
        new = replace(new, stuck=_stuck(state, estimate, centre))
        return replace(new, alarms=self._attribution.after(new, self._fusion.drift(new), None, centre))

    def whole(self, state: TrackerState) -> TrackerState:
        """One of an older format, or of a pooled prior that is gone, knows nothing of weather, pressures, centres.

        Errors: `TrackerStateError` for one that knows of more than this tracker.
        """
        if state.belief.deviations > self.model.size:
            raise TrackerStateError("stored tracker state is of a version that followed more; start a new state")
        calibration, belief = dev.grown(state.calibration, state.belief, self.model)
        if calibration is not state.calibration:
            state = replace(state, calibration=calibration, belief=belief)
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
        shift = time_ns - nanoseconds(self.settings.hop) - state.time
        changes, fit, calibration = state.changes, state.fit, state.calibration
        weighed = calibration.recent != 0
        weather = state.weather
        if weather is not None:
            weather = replace(weather, began=np.where(weather.began != 0, weather.began + shift, 0))
        return replace(
            state,
            time=state.time + shift,
            last=None if state.last is None else state.last + shift,
            inflation=replace(state.inflation, anchored=state.inflation.anchored + shift),
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
        return replace(new, alarms=self._attribution.after(new, self._fusion.drift(new), None, state.time or 0))

    def posterior(self, state: TrackerState) -> tuple[FloatArray, FloatArray]:
        """Mean and standard deviation of the log-ratios to nominal, each of shape (P,)."""
        return state.belief.level.copy(), np.sqrt(state.belief.level_variance + self._doubt[0])

    def report(self, state: TrackerState) -> tuple[ParameterReport, ...]:
        """Every parameter in physical units, against nominal and against the vehicle's own baseline."""
        base = self._fusion.baseline(state)
        drift = self._fusion.drift(state, base)
        return reported(self.parameters, state, self.settings, base, drift, self._doubt[0])

    def health(self, state: TrackerState) -> Health:
        """NAMUR NE 107: the worst of what is active, in the recommendation's order F, C, S, M."""
        return health_of(state, self.settings)

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
        value = state.belief.mean[-H:]
        off = value - self.model.common(value)
        far = np.abs(off) > self.model.named
        if not far.any():
            return tuple(stuck)
        std = self.model.relative_std(state.belief.covariance[-H:, -H:] + self._doubt[1])
        bent = np.where(self.model.gains, dev.bending(off), 0.0)
        std = np.sqrt(std**2 + dev.pending(state.calibration, self.model) + bent**2)
        chosen = far & (np.abs(off) > 3 * std)
        return (*stuck, *named(self.deviations, off, std, chosen))

    def built(self, state: TrackerState) -> tuple[BuiltOtherwise, ...]:
        """What windows tell of how bodies are built otherwise than the system file says."""
        H = self.model.size
        found = []
        for h in np.flatnonzero(self.model.own).tolist():
            value = float(state.belief.mean[-H:][h])
            std = float(np.sqrt(state.belief.covariance[-H:, -H:][h, h] + self._doubt[1][h, h]))
            if abs(value) > max(dev.BUILT, 3 * std):
                deviation = self.deviations[h]
                found.append(BuiltOtherwise(deviation.name, OWN[deviation.kind], float(np.expm1(value)), std))
        return tuple(found)

    def loads(self, state: TrackerState) -> dict[str, tuple[float, float]]:
        """Log-ratio of every known loaded mass to the empty one, with its standard deviation, by body."""
        H = self.model.size
        found = {}
        for h in self.model.loads_at:
            value, variance = state.belief.mean[-H:][h], float(state.belief.covariance.diagonal()[-H:][h])
            if np.sqrt(variance) < KNOWN * self._fusion.limit[h]:
                found[self.deviations[h].name] = (float(value), float(np.sqrt(variance + self._doubt[1][h, h])))
        return found

    def loads_as_of(self, state: TrackerState) -> int | None:
        """Start of the last window that told of the loads, ns, where any other is possible by now: people board while a
        vehicle stands.  None: what `loads` says holds."""
        if state.last is None or state.time is None:
            return None
        idle = (state.time - state.last) * 1e-9 - self.settings.window
        return state.last if idle > dev.STOPPED else None


def _stuck(state: TrackerState, estimate: Estimate, centre: int) -> tuple[Stuck, ...]:
    return counted(state.stuck, [(f.channel, f.kind, f.value) for f in estimate.faults], centre)

"""Tracker: window estimates in, a posterior, drift, alarms and health of every parameter out.

Pure: no clock, no files; `update` returns a new state and touches nothing else.  docs/tracking.md derives what runs.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType

import numpy as np

from sprung.model.identification.measurements.deviations import OWN, Deviation, named
from sprung.model.signals import BuiltOtherwise, Conditions, Estimate, FloatArray, IntArray, MeasurementFault
from sprung.model.tracking import cargo as cargos
from sprung.model.tracking import changes as change_test
from sprung.model.tracking import coverage, deviation_record, inflation, innovation, misfit
from sprung.model.tracking import deviations as dev
from sprung.model.tracking import filter as kalman
from sprung.model.tracking import weather as weathers
from sprung.model.tracking.alarms import VehicleAlarms
from sprung.model.tracking.deviation_model import model_of as deviation_model
from sprung.model.tracking.fusion import KNOWN, Fusion, nanoseconds
from sprung.model.tracking.jumps import Jump
from sprung.model.tracking.load_alarms import LoadLimit
from sprung.model.tracking.loads import STOPPED
from sprung.model.tracking.reports import ParameterLike, ParameterReport, health_of, reported
from sprung.model.tracking.sensor_alarms import counted
from sprung.model.tracking.settings import TrackerSettings, TrackerSettingsError
from sprung.model.tracking.state import Alarm, Health, Stuck, TrackerState, TrackerStateError
from sprung.model.tracking.weather import WeatherModel
from sprung.model.tracking.window import is_covariance

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

MOVING = 10.0  # m/s, above which wheels move on any track: inputs without motion are not measured
CRAWLING = 5.0  # m/s, below which a vehicle need not be monitored: there is no excitation


class Tracker:
    """Fuses window estimates of `parameters` (P of them, in the order of the estimates).

    deviations: gains, delays and loads that estimates may contain (H of them, see `Estimate.deviating`); without them
    the values of the system file are taken as exact.
    """

    def __init__(
        self,
        parameters: Sequence[ParameterLike],
        settings: TrackerSettings | None = None,
        deviations: Sequence[Deviation] = (),
        weather: WeatherModel | None = None,
        limits: Mapping[str, LoadLimit] = MappingProxyType({}),
        model_uncertainty: tuple[FloatArray, FloatArray] | None = None,
        masses: Mapping[str, tuple[str, ...]] = MappingProxyType({}),
    ) -> None:
        """weather: effects of conditions on parameters, by default from their names; limits: of loads, by body.

        model_uncertainty: variance of the log-ratios (P,), and covariance of the deviations (H, H), of an error that is
        the same in all windows, as that of the masses in the system file: part of the stated uncertainty, not of that
        of changes.
        masses: bodies whose mass scales what is estimated, and the elements at them.
        """
        if not parameters:
            raise TrackerSettingsError("a tracker needs at least one parameter to estimate")
        self.parameters = tuple(parameters)
        self.names = tuple(parameter.name for parameter in self.parameters)
        self.settings = settings or TrackerSettings()
        self.deviations = tuple(deviations)
        self.model = deviation_model(self.deviations, self.settings.rules.jumps)
        nominal = [parameter.nominal for parameter in self.parameters]
        self.weather = weather or weathers.model_of(self.names, nominal, rules=self.settings.rules.weather)
        self._model_uncertainty = model_uncertainty or (
            np.zeros(len(self.names)),
            np.zeros((self.model.size, self.model.size)),
        )
        self._alarms = VehicleAlarms(
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
            calibration=deviation_record.start(size, self.model),
            stuck=(),
            alarms=(),
            weather=weathers.start(self.weather),
            cargo=cargos.start(np.diag(self.model.prior)[self.model.loads]),
        )

    def initial_state_from(self, others: Iterable[TrackerState]) -> TrackerState:
        """Initial state with the effects of weather, load and speed that other vehicles of the system have learned."""
        known = [s.weather for s in others if s.weather is not None and s.names == self.names]
        whole = [w for w in known if len(w.common) == self.weather.groups]
        return replace(self.initial_state(), weather=weathers.start(weathers.pooled(self.weather, whole)))

    def update(
        self, state: TrackerState, estimate: Estimate, time_ns: int, conditions: Conditions | None = None
    ) -> TrackerState:
        """State after the window that starts at `time_ns`; a window not later than the last is ignored.

        A window without excitation carries no information: only the time advances.  The same holds for one that does
        not fit in a curve, where curves are measured.
        """
        self._check(state, estimate)
        state = self.upgraded(state)
        if state.time is not None and time_ns <= state.time:
            return state
        centre = time_ns + nanoseconds(self.settings.window / 2)
        curving = conditions is not None and conditions.curving and not estimate.adequate
        if curving or not estimate.informative:
            return self._skipped(state, estimate, time_ns, centre, conditions)
        new, jump = self._fused(state, estimate, time_ns, centre, conditions)
        new = self._with_misfit(new, estimate, centre)
        seen = coverage.update(state.coverage, usable=new.used > state.used)
        new = replace(new, time=time_ns, stuck=self._stuck(state, estimate, centre), coverage=seen)
        jump = jump if self._fusion.armed(state) else None
        return replace(new, alarms=self._alarms.updated(new, self._fusion.drift(new), jump, centre))

    def _fused(
        self, state: TrackerState, estimate: Estimate, time_ns: int, centre: int, conditions: Conditions | None
    ) -> tuple[TrackerState, Jump | None]:
        """State with a window, and a deviation that has jumped; the window is counted as rejected if it is unusable."""
        mask = estimate.identifiable & np.isfinite(estimate.log_ratio)
        usable = (
            _is_usable(estimate)
            and mask.any()
            and not self._fusion.effects.too_large(state, estimate)
            and is_covariance(estimate.covariance if mask.all() else estimate.covariance[mask][:, mask])
        )
        if not usable:
            return replace(state, rejected=state.rejected + 1), None
        return self._fusion.fuse(state, estimate, mask, time_ns, centre, conditions)

    def _with_misfit(self, state: TrackerState, estimate: Estimate, centre: int) -> TrackerState:
        """State with the misfit of a window, unless the window is unusable because of an identified sensor fault."""
        if estimate.faults and not _is_usable(estimate):
            return state
        fit = misfit.update(
            state.fit,
            self._fusion.effects.chi_square(state, estimate),
            adequate=estimate.adequate,
            inflation=float(state.inflation.factor.max()),
            time=centre,
            rules=self.settings.rules.misfit,
        )
        return replace(state, fit=fit)

    def _skipped(
        self, state: TrackerState, estimate: Estimate, time_ns: int, centre: int, conditions: Conditions | None
    ) -> TrackerState:
        """State after a window that carries no information.

        A vehicle at standstill counts as monitored.  A running one does not where its inputs show no motion or are
        frozen, or where windows do not fit in a curve (with a zero error of the yaw rate every window is a curve).
        Where it runs too slowly for an estimate, the last one stays valid for a while.  A silent channel is no evidence
        of whether it runs; while so many are silent that no window was informative, it is not monitored.
        """
        speed = np.nan if conditions is None else conditions.speed
        frozen = not estimate.running and any(fault.kind != "silent" for fault in estimate.faults)
        runs = estimate.informative or speed > MOVING or frozen
        known = state.last is not None and (time_ns - state.last) * 1e-9 < self.settings.holding
        blind = len(self.lost(state)) == len(self.names)  # not too slow, but without its channels
        still = known or not estimate.running or speed < CRAWLING
        seen = coverage.update(state.coverage, usable=still and not (runs or blind))
        new = replace(state, time=time_ns, idle=state.idle + 1, coverage=seen)
        if estimate.informative or not estimate.faults:
            return new
        new = replace(new, stuck=self._stuck(state, estimate, centre))
        return replace(new, alarms=self._alarms.updated(new, self._fusion.drift(new), None, centre))

    def upgraded(self, state: TrackerState) -> TrackerState:
        """The state with everything that this tracker follows: older formats lack weather, pressures, body constants.

        Errors: `TrackerStateError` for a state with more deviations than this tracker has.
        """
        if state.belief.deviations > self.model.size:
            raise TrackerStateError("stored tracker state is of a version that followed more; start a new state")
        calibration, belief = deviation_record.extended(state.calibration, state.belief, self.model)
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
        """State after a window that could not be used (lost samples, a gap): the vehicle was not monitored."""
        return replace(state, coverage=coverage.update(state.coverage, usable=False))

    def rebase(self, state: TrackerState, time_ns: int) -> TrackerState:
        """State before a window that starts at `time_ns`, though the last one was stamped later: a clock was wrong.

        Times of pending evidence (anchors, onsets without an alarm yet) are shifted, as if the windows followed each
        other; alarms keep the times with which they were reported.
        """
        if state.time is None or time_ns > state.time:
            return state
        return state.shifted(time_ns - nanoseconds(self.settings.hop) - state.time)

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
            new = replace(new, weather=weathers.reset_offsets(new.weather, self.weather, rows))
        return replace(new, alarms=self._alarms.updated(new, self._fusion.drift(new), None, state.time or 0))

    def posterior(self, state: TrackerState) -> tuple[FloatArray, FloatArray]:
        """Mean and standard deviation of the log-ratios to nominal, each of shape (P,)."""
        variance = state.belief.level_variance + self._fusion.pending_variance(state)
        return state.belief.level.copy(), np.sqrt(variance + self._model_uncertainty[0])

    def report(self, state: TrackerState) -> tuple[ParameterReport, ...]:
        """Every parameter in physical units, against nominal and against the vehicle's own baseline."""
        base = self._fusion.baseline(state)
        drift = self._fusion.drift(state, base)
        doubt = self._model_uncertainty[0] + self._fusion.pending_variance(state)
        return reported(self.parameters, state, self.settings, base, drift, doubt, self.lost(state))

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

    def _stuck(self, state: TrackerState, estimate: Estimate, centre: int) -> tuple[Stuck, ...]:
        found = [(f.channel, f.kind, f.value) for f in estimate.faults]
        unseen = tuple(name for name, known in zip(self.names, estimate.identifiable, strict=True) if not known)
        used = unseen if _is_usable(estimate) else None
        return counted(state.stuck, found, centre, 2 * self.settings.rules.alarms.hard, used)

    def lost(self, state: TrackerState) -> dict[str, str]:
        """Channels, joined by |, without which a parameter is not identified, by its name; while they are stuck."""
        found: dict[str, list[str]] = {}
        for s in state.stuck:
            if s.count >= self.settings.rules.alarms.hard:
                for name in s.unseen:
                    found.setdefault(name, []).append(s.channel)
        return {name: "|".join(channels) for name, channels in found.items()}

    def hard_faults(self, state: TrackerState) -> tuple[MeasurementFault, ...]:
        """Frozen, saturated, silent, noisy, reversed and exchanged channels."""
        reported = (s for s in state.stuck if s.count >= self.settings.rules.alarms.hard)
        return tuple(MeasurementFault(s.channel, s.kind, s.value) for s in reported)

    def known_faults(self, state: TrackerState) -> tuple[MeasurementFault, ...]:
        """What identification should correct before it looks at a window: hard faults, gains and large delays.

        The evidence of windows is linear in gains and delays near those that were taken back; far from them it must be
        refined once more, which costs several times as much.
        """
        hard, H = self.hard_faults(state), self.model.size
        exchanged = any(fault.kind == "swapped" for fault in hard)  # of which channel a gain is, is another question
        if H == 0 or state.calibration.recent[-1] == 0 or exchanged:
            return hard
        value = state.belief.mean[-H:]
        off = value - self.model.common_value(value)
        far = np.abs(off) > self.model.put_right
        chosen = np.zeros(H, dtype=bool)
        for at in self.model.groups:  # all or none: differences between channels are what windows determine
            chosen[at] = far[at].any()
        return (*hard, *named(self.deviations, off, np.zeros(H), chosen)) if chosen.any() else hard

    def sensors(self, state: TrackerState) -> tuple[MeasurementFault, ...]:
        """Sensor faults: stuck channels, and gains and delays that differ from the system file."""
        stuck = self.hard_faults(state)
        H = self.model.size
        if H == 0 or state.calibration.recent[-1] == 0:
            return stuck
        value, covariance = dev.without_data_sheets(state.calibration, self.model, state.belief)
        off = value - self.model.common_value(value)
        far = np.abs(off) > self.model.report_limit
        if not far.any():
            return stuck
        std = self.model.relative_std(covariance + self._model_uncertainty[1])
        linear = np.where(self.model.gains, dev.linearisation_std(off), 0.0)
        # what the belief seems to lack is, as far as it goes, what the data sheet has held back
        held = np.abs(value - state.belief.mean[-H:])
        lacking = (np.sqrt(dev.pending_variance(state.calibration, self.model)) - held).clip(0.0)
        std = np.sqrt(std**2 + lacking**2 + linear**2)
        chosen = far & (np.abs(off) > 3 * std)
        return (*stuck, *named(self.deviations, off, std, chosen))

    def body_constants(self, state: TrackerState) -> tuple[BuiltOtherwise, ...]:
        """Constants of bodies (inertias over mass, sensor distances) that differ from the system file."""
        if not self.model.constant.any():
            return ()
        found, (values, covariance) = [], dev.without_data_sheets(state.calibration, self.model, state.belief)
        for h in np.flatnonzero(self.model.constant).tolist():
            value, std = float(values[h]), float(np.sqrt(covariance[h, h] + self._model_uncertainty[1][h, h]))
            if abs(value) > max(self.model.rules.constants, 3 * std):
                deviation = self.deviations[h]
                found.append(BuiltOtherwise(deviation.name, OWN[deviation.kind], float(np.expm1(value)), std))
        return tuple(found)

    def loads(self, state: TrackerState) -> dict[str, tuple[float, float]]:
        """Log-ratio of every loaded mass to the empty one, with its standard deviation, by body.

        Where the present run does not determine it yet, that of the last one; see `loads_as_of`.
        """
        H, earlier = self.model.size, self._loads_of_earlier(state)
        found = {}
        for i, h in enumerate(self.model.loads_at):
            value, variance = state.belief.mean[-H:][h], float(state.belief.covariance.diagonal()[-H:][h])
            if earlier[i] and state.cargo is not None:
                value, variance = state.cargo.past[i], float(state.cargo.past_variance[i])
            if earlier[i] or np.sqrt(variance) < KNOWN * self._fusion.limit[h]:
                found[self.deviations[h].name] = (
                    float(value),
                    float(np.sqrt(variance + self._model_uncertainty[1][h, h])),
                )
        return found

    def loads_of_window(self, estimate: Estimate) -> dict[str, tuple[float, float]]:
        """The same of one window alone, where it determines them."""
        found, at = estimate.deviating, self.model.cargo_at
        if found is None or not len(self.model.loads_at) or not estimate.adequate:
            return {}
        covariance = np.linalg.inv(found.information[at][:, at] + np.linalg.inv(self.model.prior[at][:, at]))
        std = np.sqrt(covariance.diagonal() + self._model_uncertainty[1].diagonal()[at])
        values = {h: (float(found.point[h]), float(s)) for h, s in zip(at.tolist(), std, strict=True)}
        known = [h for h in self.model.loads_at.tolist() if values[h][1] < KNOWN * self._fusion.limit[h]]
        return {self.deviations[h].name: values[h] for h in known}

    def _loads_of_earlier(self, state: TrackerState) -> IntArray:
        """Of each load, the last window of an earlier run that determined it, ns; 0 where this run does."""
        at = self.model.loads_at
        if state.cargo is None or not len(at):
            return np.zeros(len(at), dtype=np.int64)
        known = np.sqrt(state.belief.covariance.diagonal()[-self.model.size :][at]) < KNOWN * self._fusion.limit[at]
        return np.where(known, 0, state.cargo.past_at)

    def loads_as_of(self, state: TrackerState) -> int | None:
        """Start of the last window that determined the loads, ns, if they may have changed; None: `loads` holds."""
        earlier = self._loads_of_earlier(state)
        if earlier.any():
            return int(earlier[earlier > 0].min())
        if state.last is None or state.time is None:
            return None
        idle = (state.time - state.last) * 1e-9 - self.settings.window
        return state.last if idle > STOPPED else None


def _is_usable(estimate: Estimate) -> bool:
    return estimate.adequate and estimate.converged

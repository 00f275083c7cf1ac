"""Update of a vehicle's state by one usable window: filter, variance inflation, change tests, weather, deviations.

The tracker decides which windows are usable.  docs/tracking.md derives the steps.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from sprung.model.signals import BoolArray, Conditions, Deviating, Estimate, FloatArray, IntArray
from sprung.model.tracking import cargo as cargos
from sprung.model.tracking import changes as change_test
from sprung.model.tracking import deviations as dev
from sprung.model.tracking import filter as kalman
from sprung.model.tracking import inflation, innovation
from sprung.model.tracking import loads as loading
from sprung.model.tracking import weather as weathers
from sprung.model.tracking.cargo import Cargo
from sprung.model.tracking.deviation_effects import DeviationEffects
from sprung.model.tracking.deviation_model import DeviationModel
from sprung.model.tracking.deviation_record import DeviationRecord
from sprung.model.tracking.drift import Drift
from sprung.model.tracking.jumps import Jump
from sprung.model.tracking.settings import TrackerSettings
from sprung.model.tracking.state import TrackerState
from sprung.model.tracking.weather import WeatherModel
from sprung.model.tracking.window import TrackedWindow, in_linear_scale, noise_weight

PLAUSIBLE = 4.0  # standard deviations about its prediction that a window may move the baseline by
HARMLESS = 0.3  # standard deviations of shift by gains and delays at which an uncorrected window's load has half weight
QUIET = 5.0  # log-likelihood ratio of a change above which a parameter's windows are not used to learn slopes
INFORMATIVE = 0.5  # weight of a window below which its scatter comes from noise, not from unmodelled dynamics
SETTLING = 20.0  # s after a jump of a deviation: until then the belief may have shared it out among channels
DISPUTED = 1.5  # window lengths for which windows contradict the believed loads before there is another load: a force
# of a moment is part of two windows, or of three where it takes half of one
KNOWN = 0.5  # a posterior narrower than this share of the prior counts as identified


@dataclass(frozen=True)
class _Filtered:
    """Result of the filter step."""

    belief: kalman.Belief
    inflation: inflation.VarianceInflation
    innovation: innovation.InnovationCusum
    variance: FloatArray  # of the window's new information, inflated, (P,)
    plausible: FloatArray  # log-ratios, clipped to PLAUSIBLE about the prediction, (P,)
    bounded: bool


@dataclass(frozen=True)
class Fusion:
    """Constants of one tracker that the fusion of its windows needs."""

    settings: TrackerSettings
    model: DeviationModel
    weather: WeatherModel

    @cached_property
    def limit(self) -> FloatArray:
        """Standard deviations (H,) of deviations before any window."""
        return np.sqrt(np.diag(self.model.prior))

    @cached_property
    def effects(self) -> DeviationEffects:
        """Effects of deviations on windows and baseline."""
        return DeviationEffects(self.settings, self.model)

    def fuse(
        self,
        state: TrackerState,
        estimate: Estimate,
        mask: BoolArray,
        time_ns: int,
        centre: int,
        conditions: Conditions | None,
    ) -> tuple[TrackerState, Jump | None]:
        """State after a usable window, and a deviation that has jumped."""
        belief, elapsed = self._predicted(state, time_ns)
        found = estimate.deviating if self.model.size else None
        disputed, state = self._disputed(state, belief, elapsed, found, time_ns)
        if disputed:
            return replace(state, last=time_ns, rejected=state.rejected + 1, belief=belief), None
        belief, cargo = self._with_loads(state, belief, elapsed, conditions)
        share, weight = min(1.0, elapsed / self.settings.window), noise_weight(estimate.noise)
        faded = self._faded(state, elapsed)
        belief, calibration, found, jump, agrees = self._with_deviations(faded, belief, found, time_ns, (share, weight))
        if not self.armed(state):  # deviations are found, which the first windows had as well
            calibration = replace(calibration, following=faded.following)
        if estimate.faults and not agrees:  # the window was corrected by a fault that the belief does not support yet
            undecided = replace(state, last=time_ns, rejected=state.rejected + 1)
            return replace(undecided, belief=belief, calibration=calibration), None
        if jump is not None and self.armed(state):
            calibration = replace(calibration, moved=np.maximum(calibration.moved, jump.direction != 0))
            state = replace(state, changes=change_test.restarted(state.changes, jump.since, state.accused))
        own_cross = found is not None and found.whole
        values = self.effects.corrected(estimate, found, calibration, belief, mask)
        window = TrackedWindow(mask, time_ns, centre, share, weight, *values, own_cross)
        window = in_linear_scale(window, belief)
        filtered = self._filtered(state, belief, calibration, window)
        settled = jump is None and _is_settled(state, calibration, self.model, centre)
        calibration = self._followed(state, calibration, filtered.belief, settled=settled)
        weather, tested = self._tested(state, calibration, conditions, window, filtered)
        new = replace(
            state,
            last=time_ns,
            used=state.used + 1,
            outliers=state.outliers + int(filtered.bounded),
            belief=filtered.belief,
            inflation=filtered.inflation,
            innovation=filtered.innovation,
            changes=tested,
            calibration=self.effects.learned(state, tested, calibration, window.cross),
            weather=weather,
            cargo=cargo,
        )
        return new, jump

    def _predicted(self, state: TrackerState, time_ns: int) -> tuple[kalman.Belief, float]:
        """Belief before a window, and the seconds since the last one; infinite before any."""
        if state.last is None:
            return state.belief, np.inf
        elapsed, settings = (time_ns - state.last) * 1e-9, self.settings
        predicted = kalman.predict(state.belief, elapsed, settings.process, settings.prior, self.model.walk, self.limit)
        return predicted, elapsed

    def _faded(self, state: TrackerState, elapsed: float) -> DeviationRecord:
        """Record of the deviations `elapsed` seconds after the last window."""
        if not self.model.size or state.last is None:
            return state.calibration
        return dev.faded(state.calibration, self.model, state.belief, self.model.relative_walk * elapsed)

    def _followed(
        self, state: TrackerState, calibration: DeviationRecord, belief: kalman.Belief, *, settled: bool
    ) -> DeviationRecord:
        """Record whose reference has followed the belief after a window."""
        H = self.model.size
        if not H:
            return calibration
        before = self.model.relative_variance(state.belief.covariance[-H:, -H:])
        return dev.update_reference(calibration, self.model, belief, before, armed=self.armed(state), settled=settled)

    def _with_deviations(
        self,
        calibration: DeviationRecord,
        belief: kalman.Belief,
        found: Deviating | None,
        time_ns: int,
        counts: tuple[float, float],
    ) -> tuple[kalman.Belief, DeviationRecord, Deviating | None, Jump | None, bool]:
        """Belief and record after a window's deviations; sensitivities in use, a jump, whether window and belief agree.

        counts: share of the window that is new, and its weight.
        """
        model, (share, weight) = self.model, counts
        if found is None:
            return belief, calibration, None, None, True
        if not found.whole:
            shift = self.effects.channel_shift(calibration.cross, belief, found.point)
            doubt = 1 + float((shift**4 / found.given.diagonal() ** 2).max()) / HARMLESS**4
            # its load was estimated with gains and delays as the system file states them
            belief = loading.update(belief, model, found, share * weight / doubt)
            cross = np.where(model.refined, found.cross, calibration.cross)
            found = replace(found, cross=cross)
            return belief, calibration, found, None, True
        elapsed = (time_ns - int(calibration.recent[-1])) * 1e-9
        part = min(1.0, elapsed / self.settings.window) * weight
        calibration, belief, jump, agrees = dev.update(calibration, model, belief, found, part, time_ns)
        return belief, calibration, found, jump, agrees

    def _filtered(
        self, state: TrackerState, belief: kalman.Belief, calibration: DeviationRecord, window: TrackedWindow
    ) -> _Filtered:
        """The belief corrected by a window with inflated variance; levels that the filter has lost are reopened."""
        settings, effects, mask, value = self.settings, self.effects, window.mask, window.value
        variance = np.where(mask, window.covariance.diagonal(), 1.0)
        unshared = effects.unshared_variance(calibration, belief, window.cross)
        # Uncertain gains and delays shift windows differently: that is scatter, but no contradiction between windows.
        scatter = variance + effects.variance(belief, window.cross, ~self.model.constant)
        informative = mask & (window.weight > INFORMATIVE)
        inflated = inflation.update(
            state.inflation, value, scatter, informative, time=window.time_ns, window=nanoseconds(settings.window)
        )
        wide = np.sqrt(inflated.factor)
        covariance = window.covariance * np.outer(wide, wide)
        new = (variance + unshared) * inflated.factor / (window.share * window.weight)

        known = belief.level_variance < (KNOWN * settings.prior) ** 2
        predicted = dev.level_variance(belief, self.model, window.cross)
        reach = PLAUSIBLE * np.sqrt(predicted + variance * inflated.factor)
        plausible = np.clip(value, belief.level - reach, belief.level + reach)
        watch, lost = innovation.update(state.innovation, value - belief.level, predicted + new, mask & known)
        if lost.any():
            belief = kalman.reopen(belief, lost, settings.process)
            if self.model.size:
                belief = dev.reopen(belief, self.model)
        cross = window.cross if self.model.size else None
        belief, step = kalman.correct(
            belief, value, covariance, mask, share=window.share * window.weight, bound=settings.outlier, cross=cross,
            considered=None if window.own_cross or cross is None else ~self.model.refined,
        )  # fmt: skip
        return _Filtered(belief, inflated, watch, new, plausible, step.bounded)

    def _tested(
        self,
        state: TrackerState,
        calibration: DeviationRecord,
        conditions: Conditions | None,
        window: TrackedWindow,
        filtered: _Filtered,
    ) -> tuple[weathers.Weather, change_test.Changes]:
        """Weather and change tests after a window, corrected for the effects of deviations and weather."""
        settings, belief, variance, mask = self.settings, filtered.belief, filtered.variance, window.mask
        shift = self.effects.baseline_shift(state, calibration, window.cross)
        assert state.weather is not None
        at = weathers.features(state.weather, conditions, self.load(belief))
        usable = mask & (state.changes.learned >= settings.learning)
        learning, elapsed = not self.armed(state), 0.0 if state.last is None else (window.time_ns - state.last) * 1e-9
        departs = elapsed - settings.window > loading.STOPPED
        weather = weathers.ridden(state.weather, elapsed, learning=learning, departs=departs)
        weather = weathers.at_conditions(weather, self.weather, at, learning=learning)
        residual = np.where(usable, window.value - shift - np.where(usable, state.changes.baseline, 0.0), 0.0)
        weather = weathers.update_common(weather, self.weather, residual, variance, usable, window.centre)
        effect = np.where(usable, weather.effect + weathers.common_effect(weather, self.weather), 0.0)
        doubt = np.where(usable, weather.doubt, 0.0)
        seconds = window.share * settings.window
        tested = change_test.update(
            state.changes,
            window.value - shift - effect,
            variance,
            mask,
            seconds=seconds,
            time=window.centre,
            settings=settings,
            plausible=filtered.plausible - shift - effect,
            doubt=doubt,
        )
        quiet = usable & (tested.active == 0) & (np.maximum(tested.up, tested.down) < QUIET)
        weather = weathers.update_slopes(weather, self.weather, residual, variance, quiet, at, window.centre, seconds)
        return weather, tested

    def _disputed(
        self, state: TrackerState, belief: kalman.Belief, elapsed: float, found: Deviating | None, time_ns: int
    ) -> tuple[bool, TrackerState]:
        """Whether a window contradicts the believed loads and is passed over, and the state with that noted.

        What lasts for a moment is no load but an unmeasured force, as where a curve begins or ends.
        """
        cargo = state.cargo
        if cargo is None or not len(self.model.loads_at):
            return False, state
        rides = state.last is not None and elapsed - self.settings.window <= loading.STOPPED
        contradicting = rides and found is not None and loading.contradicted(belief, self.model, found)
        cargo = cargos.disputed(cargo, time_ns, contradicting=contradicting)
        lasts = (time_ns - int(cargo.disputed[0])) * 1e-9 >= DISPUTED * self.settings.window
        return contradicting and not lasts, replace(state, cargo=cargo)

    def _with_loads(
        self,
        state: TrackerState,
        belief: kalman.Belief,
        elapsed: float,
        conditions: Conditions | None,
    ) -> tuple[kalman.Belief, Cargo | None]:
        """Loads return to their prior after a stop or where windows contradict them; pressures, if any, refine it."""
        model, cargo = self.model, state.cargo
        if not model.size or cargo is None or not len(model.loads_at):
            return belief, cargo
        rows = model.loads_at + len(belief.mean) - model.size
        believed = belief.mean[rows], np.diag(belief.covariance)[rows]
        prior, pressure = np.diag(model.prior)[model.loads], _pressure(conditions, len(rows))
        departs = elapsed - self.settings.window > loading.STOPPED
        changed = bool(cargo.disputed[0])
        contradicted = not (departs or changed) and cargos.contradicted(cargo, *believed, prior)
        if not (departs or changed or contradicted):
            return belief, cargos.during_ride(cargo, pressure)
        if contradicted:
            pressure = np.full(len(rows), np.nan)
        elif state.last is not None:
            cargo = self._remembered(state, cargo, rows, state.last)
            cargo = cargos.after_ride(cargo, *believed) if departs else cargo
        cargo = cargos.before_ride(cargo, pressure, prior)
        return loading.reset(belief, model, cargo.prior, cargo.prior_variance), cargo

    def _remembered(self, state: TrackerState, cargo: Cargo, rows: IntArray, last: int) -> Cargo:
        """The loads of a state, at `rows` of its belief, kept as those until its last window, ns."""
        mean, variance = state.belief.mean[rows], np.diag(state.belief.covariance)[rows]
        known = variance < (KNOWN * self.limit[self.model.loads_at]) ** 2
        return cargos.remembered(cargo, mean, variance, known, last)

    def load(self, belief: kalman.Belief) -> float | None:
        """Logarithm of the loaded mass over the empty one, of the first load; None where it is not known."""
        at = self.model.loads_at
        if not len(at):
            return None
        row = len(belief.mean) - self.model.size + int(at[0])
        known = belief.covariance[row, row] < (KNOWN * self.limit[at[0]]) ** 2
        return float(belief.mean[row]) if known else None

    def pending_variance(self, state: TrackerState) -> FloatArray:
        """Variance (P,) of levels for jumps that are suspected, but not found yet."""
        return state.innovation.pending_variance(self.weather.group)

    def armed(self, state: TrackerState) -> bool:
        """Whether the vehicle has a baseline; before, deviations are found but cannot have jumped."""
        return bool(np.any(state.changes.learned >= self.settings.learning))

    def baseline(self, state: TrackerState) -> FloatArray:
        """Log-ratio to nominal of the vehicle's own healthy state, shape (P,); NaN before any window."""
        calibration = state.calibration
        base = state.changes.baseline
        if state.weather is not None:
            base = base + state.weather.effect + weathers.settled_effect(state.weather, self.weather)
        if not self.model.size:
            return np.asarray(base)
        reference = np.where(self.model.cargo, 0.0, calibration.reference)
        return np.asarray(base + calibration.base_cross @ reference)

    def drift(self, state: TrackerState, baseline: FloatArray | None = None) -> Drift:
        """value / baseline - 1 and its standard deviation; NaN before any window.

        baseline: that of the state, (P,), where the caller knows it.
        """
        level = state.belief.level
        whole = level - (self.baseline(state) if baseline is None else baseline)
        own = whole
        if state.weather is not None:
            own = (
                whole
                - weathers.common_effect(state.weather, self.weather)
                + weathers.settled_effect(state.weather, self.weather)
            )
        variance = dev.level_variance(state.belief, self.model, state.calibration.base_cross)
        variance = variance + self.pending_variance(state)
        spread = np.sqrt(variance + state.changes.baseline_variance)
        return Drift(np.expm1(own), np.exp(own) * spread, np.expm1(whole))


def _is_settled(state: TrackerState, calibration: DeviationRecord, model: DeviationModel, now: int) -> bool:
    """Whether no deviation is suspected to have jumped, nor has jumped a short time ago."""
    lately = any(a.kind == "sensor" and (now - a.opened) * 1e-9 < SETTLING for a in state.alarms)
    return not lately and calibration.ratio.max(initial=0.0) < model.rules.suspected


def _pressure(conditions: Conditions | None, loads: int) -> FloatArray:
    """Pressures of the air springs, Pa, one for each load, (L,); NaN where they are not measured."""
    if conditions is None or len(conditions.pressure) != loads:
        return np.full(loads, np.nan)
    return np.array(conditions.pressure)


def nanoseconds(seconds: float) -> int:
    """Rounded."""
    return round(seconds * 1e9)

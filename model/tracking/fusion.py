"""What one window does to what is known of a vehicle: filter, variance inflation, change tests, weather, deviations.

The tracker decides whether a window may speak; this is what it then says.  docs/tracking.md derives the steps.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.linalg.lapack import dpotrf

from sprung.model.signals import BoolArray, Conditions, Deviating, Estimate, FloatArray
from sprung.model.tracking import cargo as cargos
from sprung.model.tracking import changes as change_test
from sprung.model.tracking import deviations as dev
from sprung.model.tracking import filter as kalman
from sprung.model.tracking import inflation, innovation
from sprung.model.tracking import weather as weathers
from sprung.model.tracking.alarms import Drift
from sprung.model.tracking.cargo import Cargo
from sprung.model.tracking.deviations import DeviationModel, Jump
from sprung.model.tracking.settings import TrackerSettings
from sprung.model.tracking.state import TrackerState
from sprung.model.tracking.weather import WeatherModel

OUTLYING = 4.0  # standard deviations of a window about its prediction that a baseline is learned from
BENT = 4.0  # standard deviations of a window that deviations may move it by without being weighed itself
DOUBTED = 0.5  # what mean sensitivities move a window by, per standard deviation of doubt about it: they err by less
# than all of it, but alike in many windows, and that does not average out
HARMLESS = (
    0.3  # standard deviations by which gains and delays move a window whose load counts half: nothing corrects it
)
VAGUE = 0.2  # standard deviation of a log-ratio that teaches nothing of a parameter that is known: estimates are not
# given beyond 0.3 as they state it themselves, which leaves out more low values than high ones
SKEW = 0.03  # standard deviation of a log-ratio below which it is as good as linear: it errs by 0.1 %
FURTHEST = 1.0  # log-ratio from the belief up to which a window is taken as linear in the values themselves
STILL = 5.0  # log-likelihood ratio of a change above which a parameter teaches no slopes
COMMON = 0.45  # deviations by which windows err alike that noise of the inputs makes up for the most part; simulated,
NOISY = 0.08  # 5 to 24 m/s: half of that at this share of noise; 0.07 at a share of 0.035, nothing seen below 0.02
MANY = 500.0  # such windows whose mean is as uncertain as what they have in common: a ride of some minutes
STEADY = 0.5  # weight of a window below which its scatter is that of noise, and no sign of a law that the model lacks
KNOWN = 0.5  # a posterior narrower than this share of the prior counts as identified


@dataclass(frozen=True)
class _Window:
    """A usable window at the deviations that are believed."""

    mask: BoolArray  # parameters that it tells, (P,)
    time_ns: int
    centre: int  # ns
    share: float  # of a window that is new
    weight: float  # what the window counts as, of a window without noise in its inputs
    value: FloatArray  # log-ratios (P,)
    covariance: FloatArray  # (P, P)
    cross: FloatArray  # sensitivities to deviations (P, H)
    weighed: bool  # whether these are its own


@dataclass(frozen=True)
class _Filtered:
    """What the filter makes of a window."""

    belief: kalman.Belief
    measured: inflation.VarianceInflation
    watch: innovation.InnovationCusum
    fresh: FloatArray  # variance of what is new in it, (P,)
    plausible: FloatArray  # its values, no further from what was believed than OUTLYING, (P,)
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

    def fuse(
        self,
        state: TrackerState,
        estimate: Estimate,
        mask: BoolArray,
        time_ns: int,
        centre: int,
        conditions: Conditions | None,
    ) -> tuple[TrackerState, Jump | None]:
        """Filter, variance inflation and change tests after a usable window, and a deviation that has jumped."""
        settings, model = self.settings, self.model
        elapsed = np.inf if state.last is None else (time_ns - state.last) * 1e-9
        share, belief = min(1.0, elapsed / settings.window), state.belief
        if state.last is not None:
            belief = kalman.predict(belief, elapsed, settings.process, settings.prior, model.walk, self.limit)
        found = estimate.deviating if model.size else None
        belief, cargo = self._loaded(state, belief, elapsed, found, conditions)
        weight = weight_of(estimate.noise)
        belief, calibration, found, jump, agrees = self._weighed(
            state.calibration, belief, found, time_ns, (share, weight)
        )
        if estimate.faults and not agrees:  # corrected by what is not believed yet: its values are of neither
            undecided = replace(state, last=time_ns, rejected=state.rejected + 1)
            return replace(undecided, belief=belief, calibration=calibration), None
        if jump is not None and self.armed(state):
            calibration = replace(calibration, moved=np.maximum(calibration.moved, jump.direction != 0))
            state = replace(state, changes=change_test.restarted(state.changes, jump.since))
        weighed = found is not None and found.whole
        values = self._at_belief(estimate, found, calibration, belief, mask)
        window = _Window(mask, time_ns, centre, share, weight, *values, weighed)
        window = _linear(window, belief)
        filtered = self._filtered(state, belief, calibration, window)
        weather, tested = self._tested(state, calibration, conditions, window, filtered)
        new = replace(
            state,
            last=time_ns,
            used=state.used + 1,
            outliers=state.outliers + int(filtered.bounded),
            belief=filtered.belief,
            inflation=filtered.measured,
            innovation=filtered.watch,
            changes=tested,
            calibration=self._learned(state, tested, calibration, window.cross, filtered.belief),
            weather=weather,
            cargo=cargo,
        )
        return new, jump

    def _weighed(
        self,
        calibration: dev.DeviationRecord,
        belief: kalman.Belief,
        found: Deviating | None,
        time_ns: int,
        counts: tuple[float, float],
    ) -> tuple[kalman.Belief, dev.DeviationRecord, Deviating | None, Jump | None, bool]:
        """Deviations after a window; it as they take it, a jump, and whether it agrees with what is believed.

        counts: share of the window that is new, and its weight.
        """
        model, (share, weight) = self.model, counts
        if found is None:
            return belief, calibration, None, None, True
        if not found.whole:
            moved = self._moved(calibration.cross, belief)
            doubt = 1 + float((moved**4 / found.given.diagonal() ** 2).max()) / HARMLESS**4
            belief = dev.loaded(
                belief, model, found, share * weight / doubt
            )  # its load is that of gains and delays as stated
            gains = np.where(model.along, found.cross, calibration.cross)
            found = replace(found, cross=gains, point=np.where(model.along, found.point, 0.0))
            return belief, calibration, found, None, True
        apart = (time_ns - int(calibration.recent[-1])) * 1e-9
        part = min(1.0, apart / self.settings.window) * weight
        calibration, belief, jump, agrees = dev.weigh(calibration, model, belief, found, part, time_ns)
        return belief, calibration, found, jump, agrees

    def _filtered(
        self, state: TrackerState, belief: kalman.Belief, calibration: dev.DeviationRecord, window: _Window
    ) -> _Filtered:
        """The belief corrected by a window as uncertain as windows have turned out to be; reopened where it lags."""
        settings, mask, value = self.settings, window.mask, window.value
        variance = np.where(mask, window.covariance.diagonal(), 1.0)
        open_ = self._open(calibration, belief, window.cross)
        # What is not known of gains and delays moves windows unlike each other: that is no contradiction.
        told = variance + self._carried(belief, window.cross, ~self.model.own)
        steady = mask & (window.weight > STEADY)
        measured = inflation.update(
            state.inflation, value, told, steady, time=window.time_ns, window=nanoseconds(settings.window)
        )
        wide = np.sqrt(measured.factor)
        covariance = window.covariance * np.outer(wide, wide)
        fresh = (variance + open_) * measured.factor / (window.share * window.weight)

        known = belief.level_variance < (KNOWN * settings.prior) ** 2
        foreseen = dev.level_variance(belief, self.model, window.cross)
        reach = OUTLYING * np.sqrt(foreseen + variance * measured.factor)
        plausible = np.clip(value, belief.level - reach, belief.level + reach)
        watch, jumped = innovation.update(state.innovation, value - belief.level, foreseen + fresh, mask & known)
        if jumped.any():
            belief = kalman.reopen(belief, jumped, settings.process)
            if self.model.size:
                belief = dev.unsure(belief, self.model)
        cross = window.cross if self.model.size else None
        belief, step = kalman.correct(
            belief, value, covariance, mask, share=window.share * window.weight, bound=settings.outlier, cross=cross,
            silent=None if window.weighed or cross is None else ~self.model.along,
        )  # fmt: skip
        return _Filtered(belief, measured, watch, fresh, plausible, step.bounded)

    def _tested(
        self,
        state: TrackerState,
        calibration: dev.DeviationRecord,
        conditions: Conditions | None,
        window: _Window,
        filtered: _Filtered,
    ) -> tuple[weathers.Weather, change_test.Changes]:
        """Weather and change tests after a window, less what deviations and weather account for."""
        settings, belief, fresh, mask = self.settings, filtered.belief, filtered.fresh, window.mask
        off = self._of_baseline(state, calibration, window.cross, belief)
        assert state.weather is not None
        at = weathers.features(state.weather, conditions, self.load(belief))
        usable = mask & (state.changes.learned >= settings.learning)
        weather = weathers.foreseen(state.weather, self.weather, at, learning=not self.armed(state))
        left = np.where(usable, window.value - off - np.where(usable, state.changes.baseline, 0.0), 0.0)
        weather = weathers.together(weather, self.weather, left, fresh, usable, window.centre)
        effect = np.where(usable, weather.effect + weathers.shared(weather, self.weather), 0.0)
        doubt = np.where(usable, weather.doubt, 0.0)
        seconds = window.share * settings.window
        tested = change_test.update(
            state.changes,
            window.value - off - effect,
            fresh,
            mask,
            seconds=seconds,
            time=window.centre,
            settings=settings,
            plausible=filtered.plausible - off - effect,
            doubt=doubt,
        )
        still = usable & (tested.active == 0) & (np.maximum(tested.up, tested.down) < STILL)
        weather = weathers.learned(weather, self.weather, left, fresh, still, at, window.centre, seconds)
        return weather, tested

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
        if not self.model.size or cargo is None or not len(model.loads_at):
            return belief, cargo
        rows = model.loads_at + len(belief.mean) - model.size
        pressure = np.full(len(rows), np.nan)
        if conditions is not None and len(conditions.pressure) == len(rows):
            pressure = np.array(conditions.pressure)
        departs = elapsed - self.settings.window > dev.STOPPED
        changed = found is not None and state.last is not None and not departs and dev.moved(belief, model, found)
        believed = belief.mean[rows], np.diag(belief.covariance)[rows]
        nothing = np.diag(model.prior)[model.loads]
        belied = not (departs or changed) and cargos.contradicted(cargo, *believed, nothing)
        if not (departs or changed or belied):
            return belief, cargos.felt(cargo, pressure)
        if state.last is not None and departs:
            cargo = cargos.arrived(cargo, *believed)
        cargo = cargos.departed(cargo, pressure * np.nan if belied else pressure, nothing)
        return dev.boarded(belief, model, cargo.prior, cargo.prior_variance), cargo

    def load(self, belief: kalman.Belief) -> float | None:
        """Logarithm of the loaded mass over the empty one, of the first load; None where it is not known."""
        at = self.model.loads_at
        if not len(at):
            return None
        row = len(belief.mean) - self.model.size + int(at[0])
        known = belief.covariance[row, row] < (KNOWN * self.limit[at[0]]) ** 2
        return float(belief.mean[row]) if known else None

    def bent(self, state: TrackerState, estimate: Estimate) -> bool:
        """Whether known deviations move this window so far that mean sensitivities are not good enough for it."""
        if not self.model.size or (estimate.deviating is not None and estimate.deviating.whole):
            return False
        moved = state.calibration.cross @ np.where(self.model.along, 0, state.belief.mean[-self.model.size :])
        return bool(np.any(np.abs(moved) > BENT * np.sqrt(estimate.covariance.diagonal())))

    def armed(self, state: TrackerState) -> bool:
        """Whether the vehicle's baseline is known: before, a deviation is found, but has not jumped."""
        return bool(np.any(state.changes.learned >= self.settings.learning))

    def chi_square(self, state: TrackerState, estimate: Estimate) -> float:
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
        if found is None:  # loads were refined along, but not what the window says of them: its covariance holds that
            cross = np.where(self.model.along, 0.0, calibration.cross)
            found_at, covariance = np.zeros(len(here)), estimate.covariance
        else:
            found_at, cross, covariance = found.point, found.cross, found.given
        if found is None or not found.whole:
            covariance = _doubted(covariance, self._moved(cross, belief))
        return value + np.where(mask, cross @ (here - found_at), 0.0), covariance, cross

    def _moved(self, cross: FloatArray, belief: kalman.Belief) -> FloatArray:
        """What gains and delays, as believed, move log-ratios by, (P,)."""
        return np.asarray(cross @ np.where(self.model.along, 0.0, belief.mean[-self.model.size :]))

    def _open(self, calibration: dev.DeviationRecord, belief: kalman.Belief, cross: FloatArray) -> FloatArray:
        """Variance (P,) that deviations bring in which were otherwise in the windows of the baseline."""
        return self._carried(belief, cross, (calibration.moved > 0) | self.model.cargo)

    def _carried(self, belief: kalman.Belief, cross: FloatArray, chosen: BoolArray) -> FloatArray:
        """Variance (P,) of a window's values by what is not known of some deviations (H,)."""
        H = self.model.size
        if H == 0 or not chosen.any():
            return np.zeros(len(cross))
        at = np.flatnonzero(chosen)
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
        stays = ~self.model.cargo
        learned = state.changes.learned >= self.settings.learning
        reference = np.where(stays, calibration.reference, 0.0)
        # One that is learned anew is counted from the deviations that are known for the others by now.
        here = np.where(stays, belief.mean[-self.model.size :], 0.0) if self._refining(state) else reference
        return np.where(learned, calibration.base_cross @ reference, cross @ here)

    def _refining(self, state: TrackerState) -> bool:
        """Whether the deviations that the baseline was learned with are still being made out."""
        return (state.used + 1) * self.settings.hop < dev.SETTLED

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
        calibration = replace(calibration, base_cross=base)
        learned = ~self.model.cargo & self.armed(state)
        if self._refining(state):
            return dev.followed(calibration, self.model, belief, learned)
        # How bodies are built never changes: baselines were learned with what is known of it by now.
        built = np.where(self.model.own, belief.mean[-self.model.size :], calibration.reference)
        return replace(calibration, reference=built)

    def baseline(self, state: TrackerState) -> FloatArray:
        """Log-ratio to nominal of the vehicle's own healthy state, shape (P,); NaN before any window."""
        calibration = state.calibration
        base = state.changes.baseline
        if state.weather is not None:
            base = base + state.weather.effect + weathers.usual(state.weather, self.weather)
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
            own = whole - weathers.shared(state.weather, self.weather) + weathers.usual(state.weather, self.weather)
        variance = dev.level_variance(state.belief, self.model, state.calibration.base_cross)
        spread = np.sqrt(variance + state.changes.baseline_variance)
        return Drift(np.expm1(own), np.exp(own) * spread, np.expm1(whole))


def _doubted(covariance: FloatArray, moved: FloatArray) -> FloatArray:
    """Covariance (P, P) of a window that was not weighed, which deviations move by about `moved` (P,).

    Its own sensitivities are not those of the windows before it, and those of windows that tell much differ from
    the mean of all: what deviations move little may speak, the rest is left to windows that were weighed.
    """
    wide = np.sqrt(1 + (moved / DOUBTED) ** 2 / covariance.diagonal())
    return np.asarray(covariance * np.outer(wide, wide))


def _linear(window: _Window, belief: kalman.Belief) -> _Window:
    """The window as stiffnesses and dampings themselves, in which it is linear, say it about what is believed.

    Its logarithms are skew: a damper that noise makes too large is stated more surely, by as much, than one that noise
    makes too small, and a mean weighed so is too large by 1.5 times the variance of one window.
    """
    known = belief.level_variance
    own = np.where(window.mask, window.covariance.diagonal(), 1.0)
    away = own / (own + known) * (window.value - belief.level)  # from where the belief will be
    away = np.where(window.mask & (own > SKEW**2), np.clip(away, -FURTHEST, FURTHEST), 0.0)
    if not away.any():
        return window
    scale = np.exp(away)
    vague = (np.sqrt(own) * scale > VAGUE) & (known < VAGUE**2 / 4)
    return replace(
        window,
        mask=window.mask & ~vague,
        value=window.value + np.expm1(away) - away,
        covariance=window.covariance * np.outer(scale, scale),
        cross=window.cross * scale[:, None],
    )


def weight_of(noise: float) -> float:
    """What a window counts as whose information on the parameters is noise to this share.

    Noise of the inputs that looks like motion pulls springs, dampers and loads of all such windows the same way, which
    their number does not average out.
    """
    alike = COMMON * noise**2 / (noise**2 + NOISY**2)
    return 1 / (1 + MANY * alike**2)


def proper(covariance: FloatArray) -> bool:
    """Whether a window's covariance is one: finite and positive definite."""
    return bool(np.all(np.isfinite(covariance))) and dpotrf(covariance, lower=1)[1] == 0


def nanoseconds(seconds: float) -> int:
    """Rounded."""
    return round(seconds * 1e9)

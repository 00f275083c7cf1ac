"""`sprung bench drift`: what the tracker is worth, by Monte Carlo with the error statistics of real window estimates.

1. Simulated running records go through the product's refinement; their estimates, covariances and the correlation of
   overlapping windows are kept.
2. Full runs, simulated windows through refinement and tracker: coverage of its intervals on healthy vehicles, a
   failing damper and spring, a 5 % step in each parameter.
3. The change tests alone, thousands of vehicles at once with errors of the measured statistics: delay of a 5 % step
   in each parameter, and false alarms over vehicle-months.  `Fleet` is the tracker's test, batched; a test in
   tests/tracking/test_tracker_pieces.py asserts that it alarms when the tracker does.
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import chi2

from sprung.model.identification.excitation import simulate_runs
from sprung.model.identification.identify import Identifier
from sprung.model.signals import Estimate, FloatArray
from sprung.model.system import System, load_system
from sprung.model.tracking import changes, inflation
from sprung.model.tracking.settings import SECONDS_PER_MONTH
from sprung.model.tracking.tracker import Tracker, TrackerSettings
from sprung.service.errors import UserError

STEP = 0.05
WITHIN = 30.0  # s
SPREAD = 0.1  # of the vehicles about nominal
BUDGETS = {"quick": (6, 4.0, 400), "full": (24, 40.0, 4000)}  # records, vehicle-months, vehicles per step
PER_WINDOW = 2  # windows that begin within the length of one
NOISE_LEVELS = np.array([0.3, 0.4, 0.5, 0.6])  # shares of the threshold at which the tail is read
RECORD_SECONDS = 120


@dataclass(frozen=True, slots=True)
class Statistics:
    """Window estimates of healthy vehicles with known parameters, windows half overlapping."""

    truth: FloatArray  # shape (records, P)
    estimates: list[list[Estimate]]  # records x windows

    @property
    def covariances(self) -> FloatArray:
        """Shape (windows, P, P), records one after the other."""
        return np.array([e.covariance for record in self.estimates for e in record])

    @property
    def scores(self) -> FloatArray:
        """Errors in predicted standard deviations, shape (records, windows, P)."""
        error = np.array([[e.log_ratio for e in record] for record in self.estimates]) - self.truth[:, None]
        std = np.sqrt(np.diagonal(self.covariances, axis1=1, axis2=2))
        return error / std.reshape(error.shape)


def measure(system: System, records: int, rng: np.random.Generator) -> Statistics:
    """Records on the low ERRI B176 track at 40-50 m/s, through the refinement."""
    truth = np.log1p(rng.uniform(-SPREAD, SPREAD, (records, len(system.parameters))))
    size, hop = system.window, system.window // PER_WINDOW
    samples = round(RECORD_SECONDS * system.sample_rate)
    identifier = Identifier(system)
    estimates = []
    for row in truth:
        values = simulate_runs(system, row[None], samples, rng).values[0]
        starts = range(0, samples - size + 1, hop)
        estimates.append(identifier.identify(np.stack([values[i : i + size] for i in starts])))
    return Statistics(truth, estimates)


class CorrelatedErrors:
    """Errors with measured covariances for many vehicles; overlapping windows share what they share."""

    def __init__(self, covariances: FloatArray, vehicles: int, rng: np.random.Generator) -> None:
        self.covariances, self.roots = covariances, np.linalg.cholesky(covariances)
        self.vehicles, self.rng = vehicles, rng
        self.previous = rng.standard_normal((vehicles, covariances.shape[1]))

    def draw(self) -> tuple[FloatArray, FloatArray]:
        """Errors (vehicles, P) of the next window and the covariance (P, P) that it states."""
        index = self.rng.integers(len(self.roots))
        fresh = self.rng.standard_normal(self.previous.shape)
        white, self.previous = (fresh + self.previous) / np.sqrt(2.0), fresh
        return white @ self.roots[index].T, self.covariances[index]


class Fleet:
    """The tracker's change tests for many vehicles at once; every window is usable and measures everything."""

    def __init__(self, vehicles: int, parameters: int, settings: TrackerSettings) -> None:
        self.settings = settings
        self.inflation = inflation.start((vehicles, parameters))
        self.changes = changes.start((vehicles, parameters))
        self.windows = 0

    def update(self, value: FloatArray, covariance: FloatArray) -> None:
        """Next window: values (vehicles, P), and the covariance (P, P) of each."""
        variance = np.broadcast_to(np.diag(covariance), value.shape)
        everything = np.ones(value.shape, dtype=bool)
        self.inflation = inflation.update(
            self.inflation, value, variance, everything, time=self.windows, window=PER_WINDOW
        )
        share = 1.0 if self.windows == 0 else 1.0 / PER_WINDOW
        self.changes = changes.update(
            self.changes,
            value,
            variance * self.inflation.factor / share,
            everything,
            seconds=share * self.settings.window,
            time=self.windows,
            settings=self.settings,
        )
        self.windows += 1


def step_delays(
    covariances: FloatArray, index: int, change: float, vehicles: int, rng: np.random.Generator
) -> tuple[FloatArray, int]:
    """Seconds from a step of parameter `index` to its alarm, (vehicles,), inf where none came; alarms of others."""
    settings = TrackerSettings()
    size = covariances.shape[1]
    fleet, errors = Fleet(vehicles, size, settings), CorrelatedErrors(covariances, vehicles, rng)
    learning = round(2 * settings.learning / settings.hop)
    delay = np.full(vehicles, np.inf)
    for k in range(learning + round(2 * WITHIN / settings.hop)):
        value, covariance = errors.draw()
        after = k - learning
        if after >= 0:  # the window that straddles the step holds half of it
            value[:, index] += np.log1p(change) * min(1.0, (after + 1) * settings.hop / settings.window)
        fleet.update(value, covariance)
        if after >= 0:
            seconds = (after + 1) * settings.hop
            alarmed = fleet.changes.active[:, index] == np.sign(change)
            delay = np.where(alarmed & ~np.isfinite(delay), seconds, delay)
    others = np.delete(fleet.changes.active, index, axis=1)
    return delay, int(np.count_nonzero(others))


@dataclass(frozen=True, slots=True)
class FalseAlarms:
    months: float  # vehicle-months that were run
    alarms: int
    contradictions: int  # windows after which scatter alone would speak of a misfit
    crossings: FloatArray  # per vehicle-month, upward crossings of `NOISE_LEVELS` of the threshold

    @property
    def extrapolated(self) -> float:
        """Alarms per vehicle-month where the exponential tail between the last two read levels reaches 1."""
        near, far = self.crossings[-2:]
        if near <= 0 or far <= 0:
            return 0.0
        slope = np.log(far / near) / (NOISE_LEVELS[-1] - NOISE_LEVELS[-2])
        return float(far * np.exp(slope * (1.0 - NOISE_LEVELS[-1])))

    @property
    def bound(self) -> float:
        """95 % upper bound from the alarms that were counted (Poisson)."""
        return float(chi2.ppf(0.95, 2 * (self.alarms + 1)) / 2 / self.months)


def false_alarms(covariances: FloatArray, months: float, rng: np.random.Generator, vehicles: int = 2000) -> FalseAlarms:
    """Healthy vehicles, each with its own learned baseline, until `months` vehicle-months have run."""
    settings = TrackerSettings()
    size = covariances.shape[1]
    fleet, errors = Fleet(vehicles, size, settings), CorrelatedErrors(covariances, vehicles, rng)
    windows = int(np.ceil(months * SECONDS_PER_MONTH / settings.hop / vehicles))
    alarms, contradictions, crossings = 0, 0, np.zeros(len(NOISE_LEVELS))
    evidence = settings.evidence(size)
    quiet = np.zeros((vehicles, size), dtype=np.int8)
    highest = np.zeros((vehicles, size))
    for _ in range(windows):
        fleet.update(*errors.draw())
        state = fleet.changes
        opened = (state.active != 0) & (quiet == 0)
        alarms += int(np.count_nonzero(opened))
        quiet = state.active
        contradictions += int(
            np.count_nonzero(fleet.inflation.square.max(axis=1) >= settings.rules.misfit.contradiction)
        )
        now = np.maximum(state.up, state.down)
        for i, level in enumerate(NOISE_LEVELS * evidence):
            crossings[i] += np.count_nonzero((now >= level) & (highest < level))
        highest = np.where(now > 0, np.maximum(highest, now), 0.0)  # one crossing per excursion from zero
    run = windows * vehicles * settings.hop / SECONDS_PER_MONTH
    return FalseAlarms(run, alarms, contradictions, crossings / run)


def run(budget: str = "quick", *, seed: int = 1, system: Path | None = None) -> Iterator[dict[str, Any]]:
    """One dict per figure: name, value, unit, target (None: for information), note."""
    if budget not in BUDGETS:
        raise UserError(f"bench drift: no budget {budget!r}; known are {', '.join(BUDGETS)}")
    records, months, vehicles = BUDGETS[budget]
    rng = np.random.default_rng(seed)
    loaded = load_system(system or Path(__file__).parents[1] / "model/systems/manchester.yaml")
    statistics = measure(loaded, records, rng)
    yield from _window_figures(loaded, statistics)
    yield from _posterior_figures(loaded, statistics)
    yield from _drift_figures(loaded, rng)
    yield from _full_step_figures(loaded, rng)
    yield from _step_figures(loaded, statistics.covariances, vehicles, rng)
    yield from _false_alarm_figures(statistics.covariances, months, rng)


def _figure(name: str, value: float, unit: str, target: str | None = None, note: str = "") -> dict[str, Any]:
    return {"name": name, "value": value, "unit": unit, "target": target, "note": note}


def _window_figures(system: System, statistics: Statistics) -> Iterator[dict[str, Any]]:
    std = np.sqrt(np.diagonal(statistics.covariances, axis1=1, axis2=2).mean(axis=0))
    scores = statistics.scores
    for quantity in ("stiffness", "damping"):
        chosen = [i for i, p in enumerate(system.parameters) if p.quantity == quantity]
        if chosen:
            note = f"largest of the {quantity} parameters"
            yield _figure(f"window_std_{quantity}", 100 * float(std[chosen].max()), "%", None, note)
    yield _figure("window_error_over_predicted", float(np.sqrt(np.mean(scores**2))), "1", None, "rms; 1 is honest")
    lag = np.mean(scores[:, 1:] * scores[:, :-1])
    yield _figure("overlap_correlation", float(lag), "1", "<= 0.5", "0.5 is what the tracker counts with")


def _posterior_figures(system: System, statistics: Statistics) -> Iterator[dict[str, Any]]:
    """The tracker on whole simulated records: refinement, correlations and all."""
    tracker = Tracker(system.parameters)
    inside, scores, alarms, seconds, windows = [], [], 0, 0.0, 0
    for truth, record in zip(statistics.truth, statistics.estimates, strict=True):
        state = tracker.initial_state()
        begin = time.process_time()
        state = tracker.update_many(state, ((e, k * 500_000_000) for k, e in enumerate(record)))
        seconds, windows = seconds + time.process_time() - begin, windows + len(record)
        mean, std = tracker.posterior(state)
        scores.append((mean - truth) / std)
        inside.append(np.count_nonzero(np.abs(scores[-1]) < 3))
        alarms += len(state.alarms)
    note = f"{len(inside)} healthy records of {RECORD_SECONDS} s"
    yield _figure("healthy_inside_3_std", float(min(inside)), f"of {len(mean)}", ">= 23", "worst of " + note)
    yield _figure("healthy_error_over_std", float(np.sqrt(np.mean(np.square(scores)))), "1", None, "rms, " + note)
    yield _figure("healthy_alarms", float(alarms), "1", "0", note)
    yield _figure("update_time", 1e3 * seconds / windows, "ms", "< 1", "processor time of one update")


def identified(system: System, log_ratios: FloatArray, rng: np.random.Generator) -> list[Estimate]:
    """One window of each vehicle state (windows, P), every one on its own piece of track, through the refinement."""
    identifier = Identifier(system)
    estimates = []
    for i in range(0, len(log_ratios), 64):
        runs = simulate_runs(system, log_ratios[i : i + 64], system.window, rng)
        estimates += identifier.identify(runs.values)
    return estimates


def _drift_figures(system: System, rng: np.random.Generator) -> Iterator[dict[str, Any]]:
    """Full run of ten minutes: a damping falls by 45 % (time constant 250 s) and a stiffness by 20 % (300 s)."""
    quantities = [p.quantity for p in system.parameters]
    moving = [quantities.index("stiffness"), len(quantities) - 1 - quantities[::-1].index("damping")]
    seconds = np.arange(600) + 0.5  # one window a second
    truth = np.zeros((600, len(quantities)))
    truth[:, moving[0]] = np.log1p(0.2 * np.expm1(-seconds / 300))
    truth[:, moving[1]] = np.log1p(0.45 * np.expm1(-seconds / 250))
    tracker = Tracker(system.parameters)
    state = tracker.initial_state()
    errors, scores = np.zeros((600, 2)), np.zeros((600, 2))
    for k, estimate in enumerate(identified(system, truth, rng)):
        state = tracker.update(state, estimate, k * 1_000_000_000)
        mean, std = tracker.posterior(state)
        errors[k] = np.expm1(mean - truth[k])[moving]
        scores[k] = ((mean - truth[k]) / std)[moving]
    right = {system.parameters[i].name for i in moving}
    found = {alarm.parameter for alarm in state.alarms}
    worst, spread = np.abs(errors[60:]).max(), np.sqrt(np.mean(scores[60:] ** 2))
    yield _figure("drift_error", 100 * float(worst), "%", "<= 3", "largest of both, 60-600 s, full run")
    yield _figure("drift_error_over_std", float(spread), "1", None, "rms, lag included")
    yield _figure("drift_alarms_missed", float(len(right - found)), "1", "0")
    yield _figure("drift_alarms_wrong", float(len(found - right)), "1", "0")


def _full_step_figures(system: System, rng: np.random.Generator) -> Iterator[dict[str, Any]]:
    """Full runs, one for each parameter: 40 s healthy, then 30 s with the step, one window a second."""
    tracker = Tracker(system.parameters)
    size, healthy, changed = len(system.parameters), 40, round(WITHIN)
    delays, strangers = [], 0
    for index, parameter in enumerate(system.parameters):
        truth = np.tile(np.log1p(rng.uniform(-SPREAD, SPREAD, size)), (healthy + changed, 1))
        truth[healthy:, index] += np.log1p(STEP if index % 2 else -STEP)
        state = tracker.update_many(
            tracker.initial_state(),
            ((e, k * 1_000_000_000) for k, e in enumerate(identified(system, truth, rng))),
        )
        opened = [a.opened * 1e-9 + 0.5 - healthy for a in state.alarms if a.parameter == parameter.name]
        delays.append(min(opened, default=np.inf))
        strangers += sum(a.parameter != parameter.name for a in state.alarms)
    note = f"one full run for each of {size} parameters"
    yield _figure("full_step_delay_max", float(max(delays)), "s", "<= 30", note)
    yield _figure("full_step_alarms_of_others", float(strangers), "1", "0", note)


def _step_figures(
    system: System, covariances: FloatArray, vehicles: int, rng: np.random.Generator
) -> Iterator[dict[str, Any]]:
    late, strangers, slowest = 0, 0, ("", 0.0, 0.0)
    for index, parameter in enumerate(system.parameters):
        for change in (-STEP, STEP):
            delay, others = step_delays(covariances, index, change, vehicles // 2, rng)
            late += int(np.count_nonzero(delay > WITHIN))
            strangers += others
            tail = float(np.quantile(delay, 0.99))
            if tail > slowest[1]:
                slowest = (parameter.name, tail, float(np.median(delay)))
    total = vehicles // 2 * 2 * len(system.parameters)
    note = f"{total} steps of {100 * STEP:g} % up and down, all {len(system.parameters)} parameters"
    yield _figure("step_alarmed_in_30_s", 100 * (1 - late / total), "%", ">= 99.9", note)
    yield _figure("step_delay_p99", slowest[1], "s", "<= 30", f"{slowest[0]}, the slowest; its median {slowest[2]:g} s")
    yield _figure("step_alarms_of_others", float(strangers), "1", "0", note)


def _false_alarm_figures(covariances: FloatArray, months: float, rng: np.random.Generator) -> Iterator[dict[str, Any]]:
    result = false_alarms(covariances, months, rng)
    design = TrackerSettings().false_alarms_per_month
    yield _figure("false_alarms_designed", design, "1/vehicle-month", "< 1", "closed form, docs/tracking.md")
    yield _figure("false_alarms_counted", float(result.alarms), "1", "0", f"in {result.months:.1f} vehicle-months")
    yield _figure("false_alarms_bound", result.bound, "1/vehicle-month", "< 1", "95 % upper bound from the count")
    note = f"windows whose scatter alone would count against the fit, in {result.months:.1f} vehicle-months"
    yield _figure("false_contradictions", float(result.contradictions), "1", "0", note)
    read = ", ".join(f"{level:g}: {rate:.3g}" for level, rate in zip(NOISE_LEVELS, result.crossings, strict=True))
    note = f"exponential tail through excursions a month beyond shares of the evidence needed ({read})"
    yield _figure("false_alarms_extrapolated", result.extrapolated, "1/vehicle-month", "< 1", note)


if __name__ == "__main__":
    for figure in run():
        print(json.dumps(figure), flush=True)

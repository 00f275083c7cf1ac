"""`sprung bench day`: months of service through the real tracker, in estimate space, with the errors of real windows.

Windows of simulated working days go through the product's refinement once; what they state (covariances, sensitivities
to gains, delays and loads, information) is kept.  Then vehicles live for weeks: every ride between two stops gives the
tracker one estimate that is as good as `POOLED` such windows, drawn with their errors at the vehicle's true values.
These move with oil and air, wear, gains that drift, clocks that are off, and a load that is another after every stop.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.stats import chi2

from sprung.benchmarks.generator.ride import SYSTEM
from sprung.benchmarks.generator.running import run_day
from sprung.benchmarks.generator.timetable import MONTH, REFERENCE, Service, channel_names, draw_timetable
from sprung.benchmarks.generator.vehicle import read_vehicle
from sprung.model.identification.deviations import deviations
from sprung.model.identification.identify import Identifier
from sprung.model.signals import Conditions, Deviating, Estimate, FloatArray
from sprung.model.system import System, load_system
from sprung.model.tracking.tracker import Tracker, TrackerSettings, TrackerState

POOLED = 40.0  # independent windows of a second that the estimate of one ride is worth
SERVICE_DAY = 16 * 3600.0  # s
DAY = 86400.0
SETTLED_DAYS = 3.0  # before a fault is hidden
FAULTS = {"damping": 0.85, "stiffness": 0.92}


@dataclass(frozen=True, slots=True)
class Life:
    """What happened to one vehicle."""

    days: float
    rides: int
    strangers: list[str]  # alarms of changes and misfits that are none
    sensors: int  # alarms of kind sensor
    found_after: float | None  # s of calendar from the fault to its alarm
    isolated: bool  # the first alarm after the fault names the element


def library(system: System, count: int, seed: int) -> list[Estimate]:
    """Estimates of windows of a working day, with what they say of deviations."""
    vehicle = read_vehicle(SYSTEM)
    timetable = draw_timetable(vehicle, Service(clock=0.0, load=(0.0, 0.0), off_centre=0.0), 600.0, seed)
    values = np.concatenate(list(run_day(vehicle, timetable)))
    values = values[:, [channel_names(vehicle).index(c.name) for c in system.channels]]
    starts = [k for k in range(0, len(values) - 100, 100) if timetable.at(timetable.speed, k / 100) > 8.0]
    chosen = np.random.default_rng(seed).permutation(starts)[:count]
    windows = np.stack([values[k : k + system.window] for k in chosen])
    found = Identifier(system).examine(windows, np.ones(len(windows), dtype=bool))
    return [e for e in found if e.adequate and e.identifiable.all() and e.deviating is not None and not e.faults]


def drawn(rng: np.random.Generator, window: Estimate, truth: FloatArray, off: FloatArray) -> Estimate:
    """An estimate with the errors of `POOLED` windows like `window` at true log-ratios (P,) and deviations (H,)."""
    like = window.deviating
    assert like is not None
    information, given = like.information * POOLED, like.given / POOLED
    values, vectors = np.linalg.eigh(0.5 * (information + information.T))
    score = vectors @ (np.sqrt(values.clip(0)) * rng.standard_normal(len(values)))  # at the true deviations
    point = np.zeros(len(off))
    loads = np.array([len(off) - 1])  # the load of the car is the last
    others = np.setdiff1d(np.arange(len(off)), loads)
    pulled = score[loads] + information[np.ix_(loads, others)] @ off[others]
    point[loads] = off[loads] + np.linalg.solve(information[np.ix_(loads, loads)], pulled)
    error = np.linalg.cholesky(given) @ rng.standard_normal(len(truth))
    found = Deviating(point, given, like.cross, information, score - information @ (point - off), like.freedom)
    spread = np.linalg.inv(information[np.ix_(loads, loads)])
    covariance = given + like.cross[:, loads] @ spread @ like.cross[:, loads].T
    return Estimate(
        truth + like.cross @ (point - off) + error, covariance, np.ones(len(truth), dtype=bool), 0.03,
        window.per_sensor, float(np.exp(0.05 * rng.standard_normal())), True, True, 3, deviating=found,
    )  # fmt: skip


def live(
    system: System, windows: list[Estimate], days: float, seed: int, *, measured: bool, fault: str | None = None
) -> Life:
    """One vehicle for `days`; `measured`: its air temperature is; `fault`: parameter that loses its share at once."""
    rng = np.random.default_rng([seed, 7])
    service, names = Service(), [p.name for p in system.parameters]
    parts = deviations(system)
    tracker = Tracker(system.parameters, TrackerSettings(window=60.0, hop=60.0, learning=600.0), parts)
    state, own = tracker.initial_state(), np.log(rng.uniform(0.9, 1.1, len(names)))
    worn = np.abs(rng.normal(0, service.wear, len(names))) / MONTH
    clocks = rng.uniform(-service.clock, service.clock, 1 + max(part.group for part in parts))
    drift = rng.normal(0, service.gain_drift, len(parts)) / MONTH
    season = rng.uniform(0, 2 * np.pi)
    began = SETTLED_DAYS + rng.uniform(0, 1) if fault else np.inf
    lost = np.zeros(len(names))
    if fault:
        lost[names.index(fault)] = np.log(FAULTS[fault.rpartition(".")[2]])
    slopes = _slopes(names, service, rng)
    clock, ran, rides, front = 0.0, 0.0, 0, 0.0
    while clock < days * DAY:
        front = 0.8 * front + rng.normal(0, 3.0) if ran == 0 else front
        ride = rng.uniform(*service.stop_every)
        air = 10.0 + 15.0 * np.sin(2 * np.pi * clock / (365.25 * DAY) + season) + front
        air += service.daily_swing * np.sin(2 * np.pi * (clock / DAY - 0.375))
        oil = air + service.warm_up * (1 - np.exp(-ran / 1200.0))
        truth = (
            own - worn * clock + slopes[0] * np.minimum(air - REFERENCE, 0) + np.log1p(slopes[1] * (oil - REFERENCE))
        )
        truth = truth + lost * (clock >= began * DAY)
        off = np.array([_off(part, i, clocks, drift, clock) for i, part in enumerate(parts)])
        off[-1] = np.log1p(rng.uniform(*service.load))
        estimate = drawn(rng, windows[rng.integers(len(windows))], truth, off)
        conditions = Conditions(rng.uniform(*service.cruise), air + rng.normal(0, 0.3) if measured else np.nan)
        state = tracker.update(state, estimate, round((clock + 0.5 * ride) * 1e9), conditions)
        clock, ran, rides = clock + ride, ran + ride, rides + 1
        if ran > SERVICE_DAY:
            clock, ran = clock + DAY - SERVICE_DAY, 0.0
    return _judged(state, days, rides, began, fault)


def _slopes(names: list[str], service: Service, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """Per kelvin: of primary stiffnesses below the reference, and of dampings, each element with its own."""
    own = 1 + 0.1 * rng.standard_normal(len(names))
    rubber = np.array([service.rubber_slope * n.startswith("primary") * n.endswith("stiffness") for n in names])
    oil = np.array([service.damper_slope * n.endswith("damping") for n in names])
    return rubber * own, oil * own


def _off(part: Any, index: int, clocks: FloatArray, drift: FloatArray, clock: float) -> float:
    if part.kind == "delay":
        return float(clocks[part.group])
    return float(drift[index] * clock) if part.kind == "gain" else 0.0


def _judged(state: TrackerState, days: float, rides: int, began: float, fault: str | None) -> Life:
    kinds = [a for a in state.alarms if a.kind in ("change", "misfit")]
    after = [a for a in kinds if a.opened * 1e-9 >= began * DAY]
    right = [a for a in after if a.parameter == fault]
    return Life(
        days, rides, [f"{a.kind} {a.parameter}" for a in kinds if a not in right],
        sum(a.kind == "sensor" for a in state.alarms),
        min((a.opened * 1e-9 - began * DAY for a in right), default=None),
        bool(after) and after[0].parameter == fault,
    )  # fmt: skip


def run(months: float = 2.0, faults: int = 6, seed: int = 1, windows: int = 48) -> Iterator[dict[str, Any]]:
    """Healthy vehicles for `months` in all, a month each, every other with its temperature measured; then faults."""
    system = load_system()
    found = library(system, windows, seed)
    begin, lives = time.process_time(), []
    for number in range(max(1, round(months))):
        days = min(1.0, months) * MONTH / DAY
        lives.append(live(system, found, days, 1000 * seed + number, measured=number % 2 == 0))
    run_months = sum(life.days for life in lives) * DAY / MONTH
    strangers = [name for life in lives for name in life.strangers]
    bound = float(chi2.ppf(0.95, 2 * (len(strangers) + 1)) / 2 / run_months)
    yield {"name": "vehicle_months", "value": run_months, "rides": sum(life.rides for life in lives),
           "cpu_seconds": time.process_time() - begin}  # fmt: skip
    yield {"name": "false_alarms", "value": len(strangers) / run_months, "unit": "1/vehicle-month", "target": "< 1",
           "bound_95": bound, "of": strangers[:10]}  # fmt: skip
    yield {
        "name": "sensor_alarms",
        "value": sum(life.sensors for life in lives) / run_months,
        "unit": "1/vehicle-month",
    }
    rng = np.random.default_rng([seed, 9])
    names = [p.name for p in system.parameters]
    hidden = []
    for number in range(faults):
        quantity = ("damping", "stiffness")[number % 2]
        fault = str(rng.choice([n for n in names if n.endswith(quantity)]))
        hidden.append(
            live(system, found, SETTLED_DAYS + 2.0, 2000 * seed + number, measured=number % 4 < 2, fault=fault)
        )
    if hidden:
        soon = sum(life.found_after is not None and life.found_after <= DAY for life in hidden)
        yield {"name": "found_in_a_day", "value": 100 * soon / faults, "unit": "%", "of": faults, "target": ">= 98"}
        isolated = sum(life.isolated for life in hidden)
        yield {"name": "isolated", "value": 100 * isolated / faults, "unit": "%", "of": faults, "target": ">= 98"}

"""`sprung bench day`: months of service through the real tracker, in estimate space, with the errors of real windows.

Windows of simulated working days go through the product's refinement once; what they state (covariances, sensitivities
to gains, delays and loads, information) is kept.  Then vehicles live for weeks: every ride between two stops gives the
tracker one estimate that is as good as `POOLED` such windows, drawn with their errors at the vehicle's true values.
These move with oil and air, wear, gains that drift, clocks that are off, and a load that is another after every stop.
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import chi2

from sprung.benchmarks.generator.ride import SYSTEM
from sprung.benchmarks.generator.running import run_day
from sprung.benchmarks.generator.timetable import MONTH, REFERENCE, Service, draw_timetable
from sprung.benchmarks.generator.vehicle import read_vehicle
from sprung.benchmarks.hours import HOUR, full_hours
from sprung.benchmarks.keeping import keep, kept
from sprung.model.identification.identify import Identifier
from sprung.model.identification.measurements.deviations import CARGO, OWN, deviations
from sprung.model.signals import Conditions, Deviating, Estimate, FloatArray
from sprung.model.system import System, load_system
from sprung.model.tracking.tracker import Tracker, TrackerSettings, TrackerState

ALIKE = 8  # windows of the library, next to each other, that stand for those of one ride
POOLED = 40.0  # independent windows of a second that the estimate of one ride is worth
ASIDE = 0.1  # m, standard deviation of how far a load lies to the side
SERVICE_DAY = 16 * 3600.0  # s
DAY = 86400.0
SETTLED_DAYS = 3.0  # before a fault is hidden
FAULTS = {"damping": 0.85, "stiffness": 0.92}


@dataclass(frozen=True, slots=True)
class VehicleLife:
    """What happened to one vehicle."""

    days: float
    rides: int
    unused: int  # rides without information for the tracker, or while windows were said not to fit
    strangers: list[str]  # alarms of changes and misfits that are none
    sensors: int  # alarms of kind sensor
    found_after: float | None  # s of calendar from the fault to its alarm
    isolated: bool  # the first alarm after the fault names the element


def library(system: System, count: int, seed: int) -> list[Estimate]:
    """Estimates of windows of a working day, with what they say of deviations."""
    vehicle = read_vehicle(SYSTEM)
    timetable = draw_timetable(vehicle, Service(clock=0.0, load=(0.0, 0.0), off_centre=0.0), 600.0, seed)
    values = np.concatenate(list(run_day(vehicle, timetable)))
    values = values[:, [vehicle.channels.index(c.name) for c in system.channels]]
    starts = [k for k in range(0, len(values) - 100, 100) if timetable.at(timetable.speed, k / 100) > 8.0]
    chosen = np.random.default_rng(seed).permutation(starts)[:count]
    windows = np.stack([values[k : k + system.window] for k in chosen])
    found = Identifier(system).examine(windows, np.ones(len(windows), dtype=bool))
    return [e for e in found if e.adequate and e.identifiable.all() and e.deviating is not None and not e.faults]


@dataclass(frozen=True, slots=True)
class Pool:
    """What `POOLED` windows like one of the library say, ready to be drawn from; P parameters, H deviations."""

    window: Estimate
    like: Deviating
    information: FloatArray  # on the deviations, (H, H)
    root: FloatArray  # information = root root'
    error: FloatArray  # Cholesky factor of the parameters' covariance given the deviations, (P, P)
    given: FloatArray
    spread: FloatArray  # covariance of what describes the load and how bodies are built, (X, X)
    covariance: FloatArray  # of the parameters, (P, P)


def pool(some: Sequence[Estimate], prior: FloatArray) -> Pool:
    """`POOLED` windows like `some`, each as often as the others: what a clock that is off by milliseconds does at the
    edges of one window averages out over a ride.

    prior: standard deviations (X,) of the last deviations, which describe the load and how bodies are built.
    """
    cargo = len(prior)
    window, said = some[0], [one.deviating for one in some if one.deviating is not None]
    precision = [np.linalg.inv(of.given) for of in said]
    given: FloatArray = np.linalg.inv(np.mean(precision, axis=0)) / POOLED
    cross = POOLED * given @ np.mean([p @ of.cross for p, of in zip(precision, said, strict=True)], axis=0)
    # What windows differ in with deviations, while the parameters are the same, is evidence on the deviations, too.
    apart = [(of.cross - cross).T @ p @ (of.cross - cross) for p, of in zip(precision, said, strict=True)]
    information_of = np.mean([of.information for of in said], axis=0) + np.mean(apart, axis=0)
    information: FloatArray = POOLED * 0.5 * (information_of + information_of.T)
    like = replace(said[0], cross=cross, given=given, information=information)
    values, vectors = np.linalg.eigh(information)
    root = np.asarray(vectors * np.sqrt(values.clip(0)), dtype=np.float64)
    error = np.asarray(np.linalg.cholesky(given), dtype=np.float64)
    spread = np.asarray(np.linalg.inv(information[-cargo:, -cargo:] + np.diag(prior**-2)), dtype=np.float64)
    of_cargo = like.cross[:, -cargo:]
    return Pool(
        window, like, information, root, error, given, spread, given + of_cargo @ spread @ of_cargo.T,
    )  # fmt: skip


def drawn(rng: np.random.Generator, pool: Pool, truth: FloatArray, off: FloatArray) -> Estimate:
    """An estimate with the errors of those windows at true log-ratios (P,) and deviations (H,)."""
    X = len(pool.spread)
    score = pool.root @ rng.standard_normal(pool.root.shape[1])  # at the true deviations
    point = np.zeros(len(off))
    point[-X:] = off[-X:] + pool.spread @ (score[-X:] + pool.information[-X:, :-X] @ off[:-X])
    away = point - off
    found = replace(
        pool.like, point=point, given=pool.given, information=pool.information, score=score - pool.information @ away
    )
    return Estimate(
        truth + pool.like.cross @ away + pool.error @ rng.standard_normal(len(truth)), pool.covariance,
        np.ones(len(truth), dtype=bool), 0.03, pool.window.per_sensor, float(np.exp(0.05 * rng.standard_normal())),
        True, True, 3, deviating=found,
    )  # fmt: skip


def boarded(rng: np.random.Generator, service: Service, empty: FloatArray) -> FloatArray:
    """A drawn load as deviations, in the order of `CARGO`; `empty`: mass, roll and pitch inertia."""
    load, place, spread = (
        rng.uniform(*service.load),
        rng.normal(0, service.off_centre),
        rng.uniform(*service.load_spread, 2),
    )
    mass, roll, pitch = empty * (1 + load * np.array([1.0, *spread]))
    aside = rng.normal(0, ASIDE)
    pitch += abs(load) * empty[0] * place**2
    roll += abs(load) * empty[0] * aside**2
    grown = np.log([mass, roll, pitch] / empty)
    off = load * empty[0] * np.array([place / np.sqrt(mass * pitch), aside / np.sqrt(mass * roll)])
    return np.array([grown[0], *(grown[1:] - grown[0]), *off])


def live(
    system: System, windows: list[Pool], days: float, seed: int, *, measured: bool, fault: str | None = None
) -> VehicleLife:
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
    built = np.array([part.std for part in parts if part.kind in OWN])
    built *= np.random.default_rng([seed, 9]).standard_normal(len(built))
    lost = np.zeros(len(names))
    if fault:
        lost[names.index(fault)] = np.log(FAULTS[fault.rpartition(".")[2]])
    slopes = _slopes(names, service, rng)
    empty = system.mechanics.mass[:3]
    clock, ran, rides, front, unused, used = 0.0, 0.0, 0, 0.0, 0, 0
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
        off[[part.kind in CARGO for part in parts]] = boarded(rng, service, empty)
        off[[part.kind in OWN for part in parts]] = built
        estimate = drawn(rng, windows[rng.integers(len(windows))], truth, off)
        conditions = Conditions(rng.uniform(*service.cruise), air + rng.normal(0, 0.3) if measured else np.nan)
        state = tracker.update(state, estimate, round((clock + 0.5 * ride) * 1e9), conditions)
        unused += state.used != used + 1 or state.misfit_since is not None
        used = state.used
        clock, ran, rides = clock + ride, ran + ride, rides + 1
        if ran > SERVICE_DAY:
            clock, ran = clock + DAY - SERVICE_DAY, 0.0
    return _judged(state, days, (rides, unused), began, fault)


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


def _judged(state: TrackerState, days: float, rides: tuple[int, int], began: float, fault: str | None) -> VehicleLife:
    kinds = [a for a in state.alarms if a.kind in ("change", "misfit")]
    after = [a for a in kinds if a.opened * 1e-9 >= began * DAY]
    right = [a for a in after if a.parameter == fault]
    return VehicleLife(
        days, *rides, [f"{a.kind} {a.parameter}" for a in kinds if a not in right],
        sum(a.kind == "sensor" for a in state.alarms),
        min((a.opened * 1e-9 - began * DAY for a in right), default=None),
        bool(after) and after[0].parameter == fault,
    )  # fmt: skip


@dataclass(frozen=True)
class VehicleLives:
    """Lives of one run, each taken from `folder` where it has been lived before."""

    system: System
    windows: int  # of the library
    seed: int
    folder: Path | None
    part: tuple[int, int]  # every so-manieth life is ours: (which, of how many)

    @cached_property
    def pools(self) -> list[Pool]:
        prior = np.array([part.std for part in deviations(self.system) if part.kind not in ("gain", "delay")])
        found = library(self.system, self.windows, self.seed)
        return [pool([found[(k + i) % len(found)] for i in range(ALIKE)], prior) for k in range(len(found))]

    def ours(self, number: int) -> bool:
        return number % self.part[1] == self.part[0] - 1

    def life(self, days: float, seed: int, *, measured: bool, fault: str | None = None) -> VehicleLife:
        file = None if self.folder is None else self.folder / f"life-{seed}.json"
        settings = [days, seed, measured, fault, self.windows, self.seed, POOLED, ALIKE, FAULTS, asdict(Service())]
        settings = json.loads(json.dumps(settings))  # as they are read back
        known = kept(file, settings)
        if known is None:
            lived = live(self.system, self.pools, days, seed, measured=measured, fault=fault)
            keep(file, settings, asdict(lived))
            return lived
        return VehicleLife(**known)


def run(
    months: float = 2.0,
    faults: int = 6,
    seed: int = 1,
    windows: int = 48,
    hours: int = 0,
    folder: Path | None = None,
    part: str = "1/1",
    seconds: float = HOUR,
    cruise: str = "20-50",
) -> Iterator[dict[str, Any]]:
    """Healthy vehicles for `months` in all, a month each, every other with its temperature measured; then `faults`
    vehicles with a hidden one each; then `hours` of full simulation, see `benchmarks.hours`.

    folder: where vehicles that are done are kept; the same command goes on with the others (empty it when the code
    changed).  seconds: of a full hour; cruise: m/s between its stops, "9-13" for a train that is never faster.
    part: "2/3": only every third vehicle, the second first, for processes beside each other with one folder.
    """
    system = load_system()
    which, of = (int(x) for x in part.split("/"))
    if months or faults:
        lives = VehicleLives(system, windows, seed, folder, (which, of))
        yield from _healthy(lives, months)
        yield from _hidden(lives, faults)
    if hours:
        slow, fast = (float(x) for x in cruise.split("-"))
        ours = (number for number in range(hours) if number % of == which - 1)
        yield from full_hours(ours, seed, folder, seconds=seconds, cruise=(slow, fast))


def _healthy(some: VehicleLives, months: float) -> Iterator[dict[str, Any]]:
    begin, lives = time.process_time(), []
    for number in filter(some.ours, range(max(1, round(months)) if months else 0)):
        days = min(1.0, months) * MONTH / DAY
        lives.append(some.life(days, 1000 * some.seed + number, measured=number % 2 == 0))
        if lives[-1].strangers:
            yield {"name": "false_alarms_of", "vehicle": number, "of": lives[-1].strangers}
    if not lives:
        return
    run_months, rides = sum(life.days for life in lives) * DAY / MONTH, sum(life.rides for life in lives)
    strangers = sum(len(life.strangers) for life in lives)
    yield {"name": "vehicle_months", "value": run_months, "rides": rides, "cpu_seconds": time.process_time() - begin}
    yield {"name": "false_alarms", "value": strangers / run_months, "unit": "1/vehicle-month", "target": "< 1",
           "count": strangers, "bound_95": float(chi2.ppf(0.95, 2 * (strangers + 1)) / 2 / run_months)}  # fmt: skip
    sensors = sum(life.sensors for life in lives)
    yield {"name": "sensor_alarms", "value": sensors / run_months, "unit": "1/vehicle-month"}
    unused = sum(life.unused for life in lives)
    yield {"name": "unmonitored", "value": 100 * unused / rides, "unit": "% of rides", "target": "< 1"}


def _hidden(some: VehicleLives, faults: int) -> Iterator[dict[str, Any]]:
    rng = np.random.default_rng([some.seed, 9])
    names = [p.name for p in some.system.parameters]
    for quantity in FAULTS if faults else ():
        of_kind = [n for n in names if n.endswith(quantity)]
        drawn_faults = [str(rng.choice(of_kind)) for _ in range(faults // len(FAULTS))]
        lives = []
        for number in filter(some.ours, range(len(drawn_faults))):
            at = 2000 * some.seed + 500 * list(FAULTS).index(quantity) + number
            fault = drawn_faults[number]
            lives.append(some.life(SETTLED_DAYS + 2.0, at, measured=number % 2 == 0, fault=fault))
            if not lives[-1].isolated:
                yield {"name": "not_isolated", "fault": fault, "alarms": lives[-1].strangers}
        if lives:
            yield from _found(lives, {"quantity": quantity, "change": f"{100 * (FAULTS[quantity] - 1):.0f} %"})


def _found(lives: list[VehicleLife], note: dict[str, Any]) -> Iterator[dict[str, Any]]:
    after = [life.found_after for life in lives if life.found_after is not None]
    soon, isolated = sum(a <= DAY for a in after), sum(life.isolated for life in lives)
    note = note | {"of": len(lives)}
    yield {"name": "found_in_a_day", "value": 100 * soon / len(lives), "unit": "%", "target": ">= 98"} | note
    yield {"name": "isolated", "value": 100 * isolated / len(lives), "unit": "%", "target": ">= 98"} | note
    if after:
        yield {
            "name": "hours_to_alarm",
            "value": float(np.median(after)) / 3600,
            "largest": max(after) / 3600,
        } | note

"""`sprung bench nonlinear-tracking`: vehicles with friction, a bump stop or hysteresis in their file, tracked.

Recordings come from the generator (Runge-Kutta at 2 kHz, no code shared with the model).  The system file is the
bundled one with the law in place: its values off by some per cent as a diagnosis leaves them, widths of friction's
corner and Bouc-Wen's shape fixed; springs and dampers stay at the bundled values, up to 18 % away from the vehicle's.

For every law: windows that fit with and without it, coverage of the windows' 95 % intervals, what the service's tracker
believes at the end in deviations from the truth, windows per CPU second beside those of the linear vehicle, and the
alarm after the law's strength has changed from one recording to the next.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from sprung.benchmarks.generator.draw import Case, draw_cases
from sprung.benchmarks.generator.make import make_recordings
from sprung.benchmarks.generator.vehicle import Vehicle, read_vehicle
from sprung.model.address import LawValue
from sprung.model.identification.identify import Identifier, load_identifier
from sprung.model.laws import CATALOGUE
from sprung.model.signals import Estimate, FloatArray
from sprung.model.system import MANCHESTER, System, load_system
from sprung.model.tracking.tracker import Tracker, TrackerState
from sprung.service.monitoring.engine import make_tracker

LAWS = ("coulomb_friction", "bump_stop", "bouc_wen")
FIXED = ("smoothing", "beta", "n")  # what a window cannot tell
STRENGTH = {"coulomb_friction": 0, "bump_stop": 1, "bouc_wen": 0}  # the value that changes
OFF = 0.05  # of the file's values from the truth
START_NS = 1_700_000_000_000_000_000


def run(seed: int = 20261, count: int = 2, seconds: float = 60.0, change: float = 1.4) -> Iterator[dict[str, Any]]:
    """count: vehicles per law; change: factor of the law's strength in the second recording."""
    torch.set_num_threads(1)
    vehicle, rng = read_vehicle(MANCHESTER), np.random.default_rng(seed)
    cases = draw_cases(vehicle, count * len(LAWS), seed, list(LAWS), weak=0.5)
    pairs = [member for case in cases for member in (case, _changed(case, change))]
    made = [recording.values for recording in make_recordings(vehicle, pairs, seconds)]
    covered: list[bool] = []
    for number, case in enumerate(cases):
        system = _system(case, rng)
        order = _order(vehicle, system)
        before, after = (_windows(values[:, order], system) for values in made[2 * number : 2 * number + 2])
        figure, inside = _one(case, system, before, after, change)
        covered += inside
        yield figure
    yield {"what": "all windows", "coverage": round(float(np.mean(covered)), 4), "intervals": len(covered)}


def _one(
    case: Case, system: System, before: FloatArray, after: FloatArray, change: float
) -> tuple[dict[str, Any], list[bool]]:
    identifier = load_identifier(system)
    begin = time.process_time()
    estimates = identifier.identify(before)
    spent = time.process_time() - begin
    begin = time.process_time()
    linear = Identifier(load_system()).identify(before)
    spent_linear = time.process_time() - begin
    truth = _truth(case, system)
    used = [e for e in estimates if e.adequate]
    inside = [bool(x) for e in used for x in _inside(e, truth)]
    tracker = make_tracker(system)
    state = _follow(tracker, tracker.initial_state(), estimates, 0, system)
    level, std = tracker.posterior(state)
    errors = (level - truth) / std
    own = [i for i, p in enumerate(system.tracked) if p.element == case.effects[0][0]]
    followed = _follow(tracker, state, identifier.identify(after), len(estimates), system)
    strength = system.tracked[len(system.parameters) + _free_index(case)].name
    alarms = [a for a in followed.alarms if a.kind == "change" and a.parameter == strength]
    others = sorted({str(a.parameter) for a in followed.alarms if a.kind == "change" and a.parameter != strength})
    figure = {
        "law": case.effects[0][1],
        "at": case.effects[0][0],
        "windows": len(estimates),
        "fit": round(float(np.mean([e.adequate for e in estimates])), 3),
        "fit_linear": round(float(np.mean([e.adequate for e in linear])), 3),
        "coverage": round(float(np.mean(inside)), 4),
        "largest_error_in_std": round(float(np.abs(errors).max()), 2),
        "own": {system.tracked[i].name: [round(float(level[i] - truth[i]), 4), round(float(std[i]), 4)] for i in own},
        "iterations": round(float(np.mean([e.iterations for e in estimates])), 2),
        "windows_per_cpu_second": round(len(estimates) / spent, 1),
        "linear_windows_per_cpu_second": round(len(linear) / spent_linear, 1),
        "changed_by": change,
        "alarmed": None if not alarms else [round(1 + float(alarms[0].change or 0.0), 3), strength],
        "alarmed_after_s": None if not alarms else round((alarms[0].opened - _time(len(estimates), system)) / 1e9, 1),
        "other_change_alarms": others,
    }
    return figure, inside


def _inside(estimate: Estimate, truth: FloatArray) -> np.ndarray:
    """Which identifiable values lie within their 95 % interval."""
    std = np.sqrt(np.diag(estimate.covariance))
    identifiable = estimate.identifiable
    return np.abs(estimate.log_ratio - truth)[identifiable] < 1.96 * std[identifiable]


def _time(window: int, system: System) -> int:
    return START_NS + window * round(system.hop / system.sample_rate * 1e9)


def _follow(
    tracker: Tracker, state: TrackerState, estimates: list[Estimate], first: int, system: System
) -> TrackerState:
    return tracker.update_many(state, ((e, _time(first + i, system)) for i, e in enumerate(estimates)))


def _changed(case: Case, change: float) -> Case:
    """The same vehicle on another stretch, its law stronger or weaker."""
    ((element, law, values),) = case.effects
    moved = list(values)
    moved[STRENGTH[law]] *= change
    return replace(case, seed=case.seed ^ 1, effects=[(element, law, moved)])


def _law(case: Case) -> tuple[str, ...]:
    return next(law.names for law in CATALOGUE if law.name == case.effects[0][1])


def _free_index(case: Case) -> int:
    """Place of the strength among the law's values that are not fixed."""
    free = [i for i, name in enumerate(_law(case)) if name not in FIXED]
    return free.index(STRENGTH[case.effects[0][1]])


def _system(case: Case, rng: np.random.Generator) -> System:
    """The bundled vehicle with the law as a diagnosis would have left it."""
    ((element, effect, values),) = case.effects
    setting: dict[str, float | LawValue | str] = {
        name: LawValue(value=float(value), fixed=True)
        if name in FIXED
        else float(value * np.exp(OFF * rng.standard_normal()))
        for name, value in zip(_law(case), values, strict=True)
    }
    file = load_system().file
    improved = file.elements[element].model_copy(update={"laws": ({effect: setting},)})
    return System(file.model_copy(update={"elements": {**file.elements, element: improved}}))


def _truth(case: Case, system: System) -> FloatArray:
    known = {f"{e}.stiffness": k for e, k in case.stiffness.items()}
    known |= {f"{e}.damping": c for e, c in case.damping.items()}
    ((element, effect, values),) = case.effects
    known |= {f"{element}.{effect}.{name}": float(value) for name, value in zip(_law(case), values, strict=True)}
    return np.array([np.log(known[p.name] / p.nominal) for p in system.tracked])


def _order(vehicle: Vehicle, system: System) -> list[int]:
    """Columns of the generator in the order of the system's channels."""
    made = [f"{w}.{q}" for q in ("displacement", "velocity") for w in vehicle.inputs] + list(vehicle.sensors)
    return [made.index(channel.name) for channel in system.channels]


def _windows(values: FloatArray, system: System) -> FloatArray:
    starts = range(0, len(values) - system.window + 1, system.hop)
    return np.stack([values[i : i + system.window] for i in starts])

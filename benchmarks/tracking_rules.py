"""`sprung bench tracking-rules`: what a tracker says when one of its deciding numbers is another.

Every number of `model.tracking.rules` is set to both ends of its range, one at a time, and vehicles are followed again:
healthy ones, and such whose springs, dampers, gains, clocks, channels, loads or windows change.  Estimates are those of
`sprung bench day`: errors and sensitivities of refined windows, drawn at the vehicle's true values.

One line per vehicle with its alarms and the numbers that change them; then one line per number: on how many vehicles it
was varied, and which alarms others would open, keep or close.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from dataclasses import Field, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from sprung.benchmarks.day import Pool, drawn, library, pool
from sprung.benchmarks.sensitivity import figure, quoted
from sprung.model.identification.measurements.deviations import CARGO, OWN, deviations
from sprung.model.signals import Conditions, Estimate, FloatArray, MeasurementFault
from sprung.model.system import System, load_system
from sprung.model.tracking.load_alarms import LoadLimit
from sprung.model.tracking.rules import TRACKING_RULES, TrackingRules, reason
from sprung.model.tracking.state import TrackerState
from sprung.model.tracking.tracker import Tracker, TrackerSettings

RIDE = 60.0  # s between the estimates
LEARNED, FOLLOWED = 70, 60  # rides before and after the change
WINDOWS = 48  # of the library
TEMPERATURE, SPEED = 10.0, 30.0


@dataclass(frozen=True)
class ChangedVehicle:
    """What changes of a vehicle over the rides after its baseline is known; `share` runs from 0 to 1."""

    name: str
    values: Callable[[list[str], float], FloatArray] = lambda names, share: np.zeros(len(names))  # log-ratios (P,)
    off: Callable[[list[str], float], FloatArray] = lambda names, share: np.zeros(len(names))  # deviations (H,)
    window: Callable[[Estimate, float], Estimate] = lambda estimate, share: estimate


def _set(pattern: str, size: float, *, slowly: bool = False) -> Callable[[list[str], float], FloatArray]:
    """Values whose name begins with one part of a pattern "front*end" and ends with the other."""
    front, _, end = pattern.partition("*")

    def changed(names: list[str], share: float) -> FloatArray:
        here = np.array([name.startswith(front) and name.endswith(end) for name in names], dtype=float)
        return here * size * (share if slowly else float(share > 0))

    return changed


def _frozen(estimate: Estimate, share: float) -> Estimate:
    fault = MeasurementFault("car_1l", "frozen", 0.0)
    return replace(estimate, faults=(fault,)) if share > 0 else estimate


def _noisier(estimate: Estimate, share: float) -> Estimate:
    return replace(estimate, chi_square=estimate.chi_square * (1.35 if share > 0 else 1.0))


def _contradicting(estimate: Estimate, share: float) -> Estimate:
    """Stated deviations of a third, so that windows scatter more than they state."""
    return replace(estimate, covariance=estimate.covariance * (0.12 if share > 0 else 1.0))


FOLLOWINGS = (
    ChangedVehicle("healthy"),
    ChangedVehicle("damper", _set("secondary_1l*.damping", float(np.log(0.85)))),
    ChangedVehicle("weak damper", _set("primary_1*.damping", float(np.log(0.93)))),
    ChangedVehicle("slow spring", _set("primary_11l*.stiffness", float(np.log(1.08)), slowly=True)),
    ChangedVehicle("kind", _set("primary_*.damping", float(np.log(0.85)))),
    ChangedVehicle("warm oil", _set("*.damping", float(np.log(0.93)), slowly=True)),
    ChangedVehicle("gain", off=_set("car_1l*.gain", 0.03)),
    ChangedVehicle("small gain", off=_set("car_1l*.gain", 0.011)),
    ChangedVehicle("gain drift", off=_set("car_2r*.gain", 0.05, slowly=True)),
    ChangedVehicle("late", off=_set("car_1l*.delay", 1.5e-3)),
    ChangedVehicle("frozen", window=_frozen),
    ChangedVehicle("noise", window=_noisier),
    ChangedVehicle("contradiction", window=_contradicting),
    ChangedVehicle("overload", off=_set("car*.load", 0.42)),
)


@dataclass(frozen=True)
class Followed:
    """One vehicle with its estimates."""

    name: str
    system: System
    estimates: tuple[Estimate, ...]

    def alarms(self, rules: TrackingRules) -> tuple[list[tuple[str, str]], int]:
        """Place and kind of all alarms, closed ones told apart, and the ride of the first, -1 without any."""
        settings = TrackerSettings(window=RIDE, hop=RIDE, learning=10 * RIDE, rules=rules)
        limits = {
            "car": LoadLimit(float(self.system.mechanics.mass[0]), None, 0.4 * float(self.system.mechanics.mass[0]))
        }
        tracker = Tracker(self.system.parameters, settings, deviations(self.system), limits=limits)
        state, first = tracker.initial_state(), -1
        for ride, estimate in enumerate(self.estimates):
            state = tracker.update(state, estimate, round(ride * RIDE * 1e9), Conditions(SPEED, TEMPERATURE))
            first = ride if first < 0 and state.alarms else first
        return _told(state), first


def _told(state: TrackerState) -> list[tuple[str, str]]:
    said = ((a.parameter or "all windows", a.kind if a.closed is None else f"{a.kind}, closed") for a in state.alarms)
    return sorted(set(said))


def vehicle(following: ChangedVehicle, system: System, windows: list[Pool], seed: int) -> Followed:
    """Estimates of all its rides."""
    rng, parts = np.random.default_rng(seed), deviations(system)
    names, channels = [p.name for p in system.parameters], [f"{part.name}.{part.kind}" for part in parts]
    built = np.array([part.std if part.kind in OWN else 0.0 for part in parts]) * rng.standard_normal(len(parts))
    estimates = []
    for ride in range(LEARNED + FOLLOWED):
        share = max(0.0, (ride + 1 - LEARNED) / FOLLOWED)
        off = built + following.off(channels, share)
        estimate = drawn(rng, windows[int(rng.integers(len(windows)))], following.values(names, share), off)
        estimates.append(following.window(estimate, share))
    return Followed(following.name, system, tuple(estimates))


def vary(subject: Followed, stage: str, number: Field[Any], usual: tuple[list[tuple[str, str]], int]) -> dict[str, Any]:
    """Set a number to both ends of its range on a vehicle: other alarms, and by how many rides the first one moves."""
    changed, moved = [], 0
    for end in number.metadata["range"]:
        said, first = subject.alarms(TRACKING_RULES.varied(stage, number.name, end))
        if said != usual[0]:
            changed.append({"recording": subject.name, "at": end, "findings": [usual[0], said]})
        elif first >= 0:
            moved = max(moved, abs(first - usual[1]))
    return {"changed": changed, "decades": 0.0, "rides": moved}


def run(
    seed: int = 4711, stage: str = "", vehicles: str = "", windows: int = WINDOWS, write: Path | None = None
) -> Iterator[dict[str, Any]]:
    """Yields one line per vehicle, one per number, and the totals.

    stage: of the rules, or numbers as `stage.name`, separated by commas, if not all are asked for.
    vehicles: parts of their names, separated by commas, if not all are asked for.
    write: file for what was found, which the reasons of the rules quote; what it knows of more vehicles stays.
    """
    asked, names = ([one for one in text.split(",") if one] for text in (stage, vehicles))
    keys = [(n, one) for n, one in TRACKING_RULES.constants() if not asked or n in asked or f"{n}.{one.name}" in asked]
    began, system = time.process_time(), load_system()
    prior = np.array([part.std for part in deviations(system) if part.kind in (*CARGO, *OWN)])
    single = library(system, windows, seed)
    pools = [pool(single[k : k + 8], prior) for k in range(0, len(single) - 7, 8)]
    done: list[dict[str, Any]] = []
    for number, following in enumerate(FOLLOWINGS):
        if names and not any(one in following.name for one in names):
            continue
        subject = vehicle(following, system, pools, seed + 1 + number)
        usual = subject.alarms(TRACKING_RULES)
        varied = {f"{n}.{one.name}": vary(subject, n, one, usual) for n, one in keys}
        done.append({"recording": following.name, "varied": varied})
        changed = {key: one["changed"] for key, one in varied.items() if one["changed"]}
        yield {"vehicle": following.name, "alarms": usual[0], "first_ride": usual[1], "changed": changed}
    lines = [figure(n, one, done) | {"reason": reason(n, one)} for n, one in keys]
    for line in lines:
        moved = (of["varied"][f"{line['stage']}.{line['number']}"]["rides"] for of in done)
        yield line | {"rides": max(moved, default=0)}
    if write is not None:
        before = json.loads(write.read_text(encoding="utf-8")) if write.exists() else {}
        write.write_text(quoted(lines, done, "vehicles", before, TRACKING_RULES), encoding="utf-8")
    yield {
        "numbers": len(lines),
        "that_change_something": sum(bool(line["changed"]) for line in lines),
        "vehicles": len(done),
        "cpu_seconds": round(time.process_time() - began, 1),
    }

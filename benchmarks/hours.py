"""Full hours of a working day: every sample simulated, every window through the product (`sprung bench day --hours N`).

Nothing fails in them: what is alarmed of springs and dampers is false.  Beside alarms they tell how much of the running
time was not monitored, and how the errors of parameters and loads compare with what is stated.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from sprung.benchmarks.generator.ride import SYSTEM
from sprung.benchmarks.generator.timetable import Service, draw_timetable
from sprung.benchmarks.generator.vehicle import Vehicle, read_vehicle
from sprung.benchmarks.keeping import keep, kept
from sprung.benchmarks.through import through
from sprung.service.monitoring.engine import Engine, load_engine
from sprung.service.settings import settings_with

HOUR = 3600.0
RUNNING = 5.0  # m/s
EXCITED = 10.0  # m/s, from which on the track moves more than noise does in most windows
SETTLED = 60.0  # s of the day after which values are held against the truth
SILENT = 3.0  # stated deviations


def full_hours(
    numbers: Iterable[int],
    seed: int,
    folder: Path | None = None,
    *,
    seconds: float = HOUR,
    cruise: tuple[float, float] = Service.cruise,
) -> Iterator[dict[str, Any]]:
    """One vehicle each; a row as each is done, taken from `folder` where it has run before.

    seconds: of each; cruise: m/s, slowest and fastest between stops.
    """
    for number in numbers:
        file = None if folder is None else folder / f"hour-{seed}-{number}.json"
        settings = [seed, number, seconds, list(cruise)]
        known = kept(file, settings)
        if known is None:
            known = _hour(number, seed, seconds, cruise)
            keep(file, settings, known)
        yield known


@cache
def _product() -> tuple[Engine, Vehicle]:
    return load_engine(settings_with({})), read_vehicle(SYSTEM)


def _hour(number: int, seed: int, seconds: float, cruise: tuple[float, float]) -> dict[str, Any]:
    begin = time.process_time()
    engine, vehicle = _product()
    timetable = draw_timetable(vehicle, Service(cruise=cruise), seconds, 10_000 * seed + number, start=6 * HOUR)
    ran, fast, idle, scores, loads, state = 0, 0, 0, [], [], None
    unused = {RUNNING: 0, EXCITED: 0}  # windows of no use at these speeds or more
    for moment in through(engine, vehicle, timetable):
        state = moment.state
        speed = float(timetable.at(timetable.speed, moment.time))
        if speed < RUNNING:
            continue
        ran, fast = ran + 1, fast + (speed >= EXCITED)
        idle += not moment.watched or state.misfit_since is not None
        for least in unused:
            unused[least] += speed >= least and (not moment.used or state.misfit_since is not None)
        if moment.time > SETTLED and ran % 60 == 0:
            mean, std = engine.tracker.posterior(state)
            scores.append((mean - timetable.log_ratio(vehicle, moment.time)) / std)
            of_this_run = engine.tracker.loads_as_of(state) is None  # not what the run before the stop had carried
            for value, deviation in engine.tracker.loads(state).values() if of_this_run else ():
                truth = float(np.log1p(timetable.at(timetable.load, moment.time)))
                loads.append(((value - truth) / deviation, value - truth))
    score, load = np.array(scores), np.array(loads).reshape(-1, 2)
    assert state is not None
    alarms = [f"{a.kind} {a.parameter}" for a in state.alarms]
    return {
        "name": "full_hour", "vehicle": number, "windows_running": ran,
        "unmonitored_%": 100 * idle / ran, "of_no_use_%": 100 * unused[RUNNING] / ran,
        "of_no_use_from_10_m/s_%": 100 * unused[EXCITED] / max(fast, 1),
        "false_alarms": [a for a in alarms if not a.startswith("sensor")],
        "sensor_alarms": [a for a in alarms if a.startswith("sensor")],
        "rms_error_over_std": float(np.sqrt(np.mean(score**2))),
        "beyond_3_%": 100 * float(np.mean(np.abs(score) > SILENT)), "largest": float(np.abs(score).max()),
        "load_rms_error_%": 100 * float(np.sqrt(np.mean(load[:, 1] ** 2))),
        "load_rms_over_std": float(np.sqrt(np.mean(load[:, 0] ** 2))), "cpu_seconds": time.process_time() - begin,
    }  # fmt: skip

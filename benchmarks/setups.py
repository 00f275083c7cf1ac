"""`sprung bench setups [--count 100] [--seed 1]`: wrong set-ups on simulated recordings of the bundled vehicle.

Clean recordings of the independent generator, vehicles drawn anew, are falsified as a workshop does it: a sign, two
channels exchanged, a whole node late, a wrong scale or unit, a sensor elsewhere than the system file says.  A place is
right when the first finding names exactly the channels that were falsified; a spring or damper may never be blamed.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sprung.benchmarks.generator import draw_cases, make_recordings, read_vehicle
from sprung.model.diagnosis.api import Options, diagnose
from sprung.model.schema import MotionSensor
from sprung.model.system import MANCHESTER, System, load_system

Array = NDArray[np.float64]
KINDS = ("sign_reversed", "channels_swapped", "node_delay", "wrong_scale", "wrong_position")
SECONDS, RATE, EACH = 20.0, 100.0, 5  # length of a recording, Hz, set-ups made of one recording
SCALES = (1 / 9.80665, 9.80665, 0.1, 10.0, 1000.0, 0.5, 2.0)


@dataclass(frozen=True)
class Falsified:
    """A recording with a wrong set-up."""

    effect: str
    channels: frozenset[str]
    values: Array
    sample_rate: float = RATE
    lost: int = 0


def run(count: int = 100, seed: int = 1) -> Iterator[dict[str, Any]]:
    """Yields one line per recording, and the rates."""
    system, vehicle = load_system(), read_vehicle(MANCHESTER)
    random = np.random.default_rng(seed)
    cases = draw_cases(vehicle, -(-count // EACH), seed, ["clean"])
    right = named = blamed = done = 0
    for made in make_recordings(vehicle, cases, SECONDS):
        values = in_order(system, made.values)
        for _ in range(min(EACH, count - done)):
            wrong = falsified(system, values, KINDS[done % len(KINDS)], random)
            began = time.process_time()
            report = diagnose(system, wrong, Options(file=f"{wrong.effect}-{done}"))
            first = report.findings[0] if report.findings else None
            place = frozenset((first.location if first else "").split("|"))
            hit = first is not None and place == wrong.channels
            physical = any(f.location.split("|")[0] in system.elements for f in report.findings)
            right, blamed = right + hit, blamed + physical
            named += first is not None and first.effect == wrong.effect
            done += 1
            yield {
                "truth": [wrong.effect, sorted(wrong.channels)],
                "verdict": report.verdict,
                "said": [[f.location, f.effect] for f in report.findings],
                "place": bool(hit),
                "cpu_seconds": round(time.process_time() - began, 1),
            }
    yield {"recordings": done, "place": right / done, "named": named / done, "blamed_on_an_element": blamed}


def in_order(system: System, values: Array) -> Array:
    """The generator's columns (displacements, velocities, sensors) in the order of the system's channels."""
    names = [n for n in system.file.inputs]
    made = [f"{n}.displacement" for n in names] + [f"{n}.velocity" for n in names] + list(system.sensors)
    return values[:, [made.index(channel.name) for channel in system.channels]]


def falsified(system: System, clean: Array, kind: str, random: np.random.Generator) -> Falsified:
    """One wrong set-up of a kind."""
    values = clean.copy()
    names = [channel.name for channel in system.channels]
    sensors = list(system.sensors)
    if kind == "sign_reversed":
        chosen = [str(random.choice(sensors))]
        values[:, names.index(chosen[0])] *= -1
    elif kind == "channels_swapped":
        chosen = [str(n) for n in random.choice(sensors, 2, replace=False)]
        at = [names.index(n) for n in chosen]
        values[:, at] = values[:, at[::-1]]
    elif kind in ("node_delay", "wrong_scale"):
        body = str(random.choice(list(system.bodies)))
        chosen = [n for n, s in system.file.sensors.items() if isinstance(s, MotionSensor) and s.body == body]
        at = [names.index(n) for n in chosen]
        if kind == "node_delay":
            late = int(random.integers(1, 15))  # samples
            values = values[late:]
            values[:, at] = clean[: len(clean) - late, at]
        else:
            values[:, at] *= float(random.choice(SCALES))
    else:
        chosen = [str(random.choice(sensors))]
        values[:, names.index(chosen[0])] = elsewhere(
            system, clean, names, chosen[0], float(random.choice((-1, 1)) * random.uniform(0.5, 2.0))
        )
    return Falsified(kind, frozenset(chosen), values)


def elsewhere(system: System, clean: Array, names: list[str], name: str, offset: float) -> Array:
    """What a sensor would show `offset` metres further along x, from the other sensors of its rigid body."""
    listed = {n: s for n, s in system.file.sensors.items() if isinstance(s, MotionSensor)}
    body = listed[name].body
    others = [n for n in listed if listed[n].body == body]
    positions = np.array([listed[n].position or (0.0, 0.0) for n in others])
    shapes = np.column_stack([np.ones(len(others)), positions])
    motion = clean[:, [names.index(n) for n in others]] @ np.linalg.pinv(shapes).T  # heave, pitch, roll
    return clean[:, names.index(name)] + offset * motion[:, 1]

"""`sprung bench setups [--count 100] [--seed 1]`: wrong set-ups on simulated recordings of the bundled vehicle.

Clean recordings of the independent generator, vehicles drawn anew, are falsified as a workshop does it: a sign, two
channels exchanged, left and right, a whole node upside down or late, a wrong scale or unit, a sensor or an element
elsewhere than the system file says, an element at another body.  A place is right when the first finding names exactly
the channels that were falsified, or the element; a spring or damper may never be found changed otherwise.
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
from sprung.model.diagnosis.investigation.configuration.effects import SETUP_EFFECTS
from sprung.model.schema import MotionSensor
from sprung.model.system import MANCHESTER, System, load_system

Array = NDArray[np.float64]
KINDS = {  # kind: effect
    "sign of a sensor": "sign_reversed",
    "sign of a motion": "sign_reversed",
    "upside down": "sign_reversed",
    "two channels": "channels_swapped",
    "left and right": "channels_swapped",
    "late sensors": "node_delay",
    "late inputs": "node_delay",
    "scale of a node": "wrong_scale",
    "scale of all": "wrong_scale",
    "position of a sensor": "wrong_position",
    "position of an element": "wrong_position",
    "element at another body": "wrong_body",
}
SECONDS, RATE, EACH = 20.0, 100.0, len(KINDS)  # length of a recording, Hz, set-ups made of one recording
SCALES = (1 / 9.80665, 9.80665, 0.1, 10.0, 1000.0, 0.5, 2.0)


@dataclass(frozen=True)
class FalsifiedRecording:
    """A recording with a wrong set-up: wrong channels, or a wrong system file."""

    kind: str
    channels: frozenset[str]  # or the element
    values: Array
    sample_rate: float = RATE
    lost: int = 0
    file: System | None = None  # the wrong one


def run(count: int = 100, seed: int = 1, seconds: float = SECONDS, first: int = 0) -> Iterator[dict[str, Any]]:
    """Yields one line per recording from number `first` on, and the rates."""
    system, vehicle = load_system(), read_vehicle(MANCHESTER)
    cases = draw_cases(vehicle, -(-count // EACH), seed, ["clean"])
    right = named = false_physics = done = 0
    for number, made in enumerate(make_recordings(vehicle, cases, seconds)):
        values = in_order(system, made.values)
        for index, kind in enumerate(KINDS):
            which = number * EACH + index
            if not first <= which < count:
                continue
            wrong = falsified(system, values, kind, np.random.default_rng([seed, which]))
            began = time.process_time()
            report = diagnose(wrong.file or system, wrong, Options(file=f"{kind}-{which}"))
            top = report.findings[0] if report.findings else None
            place = frozenset(top.location.split("|")) if top else frozenset()
            hit = place == wrong.channels
            other = [f for f in report.findings if f.effect not in {effect.name for effect in SETUP_EFFECTS}]
            physical = any(f.location.split("|")[0] in system.elements for f in other)
            right, false_physics, done = right + hit, false_physics + physical, done + 1
            named += top is not None and top.effect == KINDS[kind]
            yield {
                "number": which,
                "truth": [kind, sorted(wrong.channels)],
                "verdict": report.verdict,
                "said": [[f.location, f.effect] for f in report.findings],
                "place": bool(hit),
                "cpu_seconds": round(time.process_time() - began, 1),
            }
    yield {"recordings": done, "place": right / done, "named": named / done, "found_at_an_element": false_physics}


def in_order(system: System, values: Array) -> Array:
    """The generator's columns (displacements, velocities, sensors) in the order of the system's channels."""
    names = [n for n in system.file.inputs]
    made = [f"{n}.displacement" for n in names] + [f"{n}.velocity" for n in names] + list(system.sensors)
    return values[:, [made.index(channel.name) for channel in system.channels]]


def sensors_on(system: System, body: str) -> list[str]:
    """Names of the sensors of a body's motion."""
    return [n for n, s in system.file.sensors.items() if isinstance(s, MotionSensor) and s.body == body]


def falsified(system: System, clean: Array, kind: str, random: np.random.Generator) -> FalsifiedRecording:
    """One wrong set-up of a kind."""
    values = clean.copy()
    names = [channel.name for channel in system.channels]
    sensors, body = list(system.sensors), str(random.choice(list(system.bodies)))
    node = sensors_on(system, body)
    bogie = str(random.choice([b for b in system.bodies if b != "car"]))
    wheels = [e.lower for e in system.file.elements.values() if e.upper == bogie]
    if kind in ("element at another body", "position of an element"):
        wrong, name = _wrong_file(system, kind, random)
        return FalsifiedRecording(kind, frozenset([name]), values, file=wrong)
    if kind == "sign of a motion":
        chosen = [str(random.choice(list(system.file.inputs)))]
        values[:, [i for i, n in enumerate(names) if n.split(".")[0] == chosen[0]]] *= -1
    elif kind in ("sign of a sensor", "upside down"):
        chosen = node if kind == "upside down" else [str(random.choice(sensors))]
        values[:, [names.index(n) for n in chosen]] *= -1
    elif kind in ("two channels", "left and right"):
        chosen = node if kind == "left and right" else [str(n) for n in random.choice(sensors, 2, replace=False)]
        other = [n[:-1] + {"l": "r", "r": "l"}[n[-1]] for n in chosen] if kind == "left and right" else chosen[::-1]
        values[:, [names.index(n) for n in chosen]] = clean[:, [names.index(n) for n in other]]
    elif kind in ("late sensors", "late inputs"):
        chosen = node if kind == "late sensors" else [n for n in names if n.split(".")[0] in wheels]
        late = int(random.integers(1, 15))  # samples
        values = values[late:]
        at = [names.index(n) for n in chosen]
        values[:, at] = clean[: len(clean) - late, at]
    elif kind in ("scale of a node", "scale of all"):
        chosen = node if kind == "scale of a node" else sensors
        values[:, [names.index(n) for n in chosen]] *= float(random.choice(SCALES))
    else:
        chosen = [str(random.choice(sensors))]
        offset = float(random.choice((-1, 1)) * random.uniform(0.5, 2.0))
        values[:, names.index(chosen[0])] = elsewhere(system, clean, names, chosen[0], offset)
    return FalsifiedRecording(kind, frozenset(chosen), values)


def _wrong_file(system: System, kind: str, random: np.random.Generator) -> tuple[System, str]:
    """The system file with an element elsewhere, or with one end at a body where it does not belong."""
    name = str(random.choice(list(system.elements)))
    element = system.file.elements[name]
    if kind == "position of an element":
        position = list(element.position or (0.0, 0.0))
        axis = int(random.integers(2))
        position[axis] += float(random.choice((-1, 1)) * random.uniform(0.4, 1.0) * (1.0, 0.6)[axis])
        changed = element.model_copy(update={"position": (position[0], position[1])})
    else:
        end = "upper" if element.lower in system.file.inputs else "lower"
        there = [b for b in system.bodies if b not in (element.upper, element.lower)]
        changed = element.model_copy(update={end: str(random.choice(there))})
    return System(system.file.model_copy(update={"elements": {**system.file.elements, name: changed}})), name


def elsewhere(system: System, clean: Array, names: list[str], name: str, offset: float) -> Array:
    """What a sensor would show `offset` metres further along x, from the other sensors of its rigid body."""
    listed = {n: s for n, s in system.file.sensors.items() if isinstance(s, MotionSensor)}
    body = listed[name].body
    others = [n for n in listed if listed[n].body == body]
    positions = np.array([listed[n].position or (0.0, 0.0) for n in others])
    shapes = np.column_stack([np.ones(len(others)), positions])
    motion = clean[:, [names.index(n) for n in others]] @ np.linalg.pinv(shapes).T  # heave, pitch, roll
    return clean[:, names.index(name)] + offset * motion[:, 1]

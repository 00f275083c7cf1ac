"""`sprung bench structure [--count 24] [--clean 6] [--seed 1]`: parts that a vehicle has and its file does not state.

The independent generator makes the recordings from a file with the part in it: a spring-damper between two bodies or a
body and a support, a mass that hangs on a body, an element at another place, a spring of rubber, whose stiffness grows
with a power of the frequency.  The diagnosis is given the file without it, with its own values for all elements.  Half
of the recordings are of the bundled vehicle, half of half a lorry.  Counted are the parts whose signal-to-noise ratio,
for a test that knows place and kind, is at least twice its limit.
"""

from __future__ import annotations

import copy
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from sprung.benchmarks.generator.draw import Case
from sprung.benchmarks.generator.exact import exact_response
from sprung.benchmarks.generator.oracle import oracle_snr
from sprung.benchmarks.generator.track import HIGH_TRACK, LOW_TRACK
from sprung.benchmarks.generator.vehicle import Vehicle, vehicle_of
from sprung.model.diagnosis.api import Options, diagnose
from sprung.model.system import MANCHESTER, System, load_system

Array = NDArray[np.float64]
HALF_CAR = Path(__file__).resolve().parent / "systems" / "half_car.yaml"
KINDS = ("missing_connection", "suspended_mass", "wrong_position", "fractional_stiffness")
LIMIT = 4.4  # signal-to-noise ratio at which a test of one place and kind finds half at a chance of 1e-5
VISIBLE = 2.0  # limits, from which on a part counts
HIDDEN = "hidden"


@dataclass(frozen=True)
class ConcealedPart:
    """One concealed part: what the diagnosis should say, and the file with it."""

    effect: str  # "" of a clean recording
    location: str
    parameters: dict[str, float]
    data: dict[str, Any]
    rubber: tuple[str, float, float] | None = None  # as the generator's cases have it


@dataclass(frozen=True)
class MadeSamples:
    """Samples in the order of a system's channels."""

    values: Array
    sample_rate: float = 100.0
    lost: int = 0


def run(
    count: int = 24, clean: int = 6, seed: int = 1, seconds: float = 60.0, only: str = ""
) -> Iterator[dict[str, Any]]:
    """Yields one line per recording and the rates; only: a kind of KINDS or "clean"."""
    right = visible = named = false = clean_false = done = 0
    places = [only] * count if only else [*np.resize(KINDS, count), *["clean"] * clean]
    for number, kind in enumerate(places):
        random = np.random.default_rng([seed, number])
        path = (MANCHESTER, HALF_CAR)[(number + number // len(KINDS)) % 2]  # every kind on both
        part = drawn(yaml.safe_load(path.read_text(encoding="utf-8")), str(kind), random)
        system = load_system(path)
        record, snr = made(part, yaml.safe_load(path.read_text(encoding="utf-8")), system, random, seconds)
        began = time.process_time()
        report = diagnose(system, record, Options(file=f"{kind}-{number}"))
        said = [(f.location, f.effect) for f in report.findings]
        truth = [(part.location, part.effect)] if part.effect else []
        limits = snr / LIMIT
        if not part.effect:
            clean_false += bool(said)
        elif limits >= VISIBLE:
            visible += 1
            right += said == truth
            named += bool(said) and said[0] == truth[0]
            false += any(one not in truth for one in said)
        done += 1
        yield {
            "number": number,
            "system": system.name,
            "truth": [*truth, {name: float(f"{v:.4g}") for name, v in part.parameters.items()}],
            "limits": round(limits, 1),
            "verdict": report.verdict,
            "said": said,
            "right": said == truth,
            "errors": errors(report.findings, part),
            "cpu_seconds": round(time.process_time() - began, 1),
        }
    yield {
        "recordings": done,
        "visible": visible,
        "right": right,
        "first_right": named,
        "with_false_findings": false,
        "clean": len(places) - count if not only else 0,
        "clean_with_findings": clean_false,
    }


def errors(findings: Any, part: ConcealedPart) -> dict[str, list[float]]:
    """Value found and deviations from the truth, of the parameters of the right finding."""
    for finding in findings:
        if (finding.location, finding.effect) == (part.location, part.effect):
            return {
                p.name: [float(f"{p.value:.5g}"), round((p.value - part.parameters[p.name]) / max(p.std, 1e-300), 1)]
                for p in finding.parameters
                if p.name in part.parameters
            }
    return {}


def drawn(data: dict[str, Any], kind: str, random: np.random.Generator) -> ConcealedPart:
    """A vehicle with elements within 15 % of nominal, and with a part of a kind."""
    data = copy.deepcopy(data)
    for element in data["elements"].values():
        for quantity in ("stiffness", "damping"):
            element[quantity] *= float(random.uniform(0.85, 1.15))
    if kind == "missing_connection":
        return _connected(data, random)
    if kind == "suspended_mass":
        return _suspended(data, random)
    if kind == "wrong_position":
        return _moved(data, random)
    if kind == "fractional_stiffness":
        return _of_rubber(data, random)
    return ConcealedPart("", "", {}, data)


def _span(data: dict[str, Any], names: tuple[str, ...], axis: int) -> tuple[float, float]:
    """Where elements hold these bodies along an axis, m."""
    at = [e["position"][axis] for e in data["elements"].values() if {e["upper"], e["lower"]} & {*names}]
    return min(at), max(at)


def _connected(data: dict[str, Any], random: np.random.Generator) -> ConcealedPart:
    bodies, inputs, elements = list(data["bodies"]), list(data["inputs"]), data["elements"]
    joined = {frozenset((e["upper"], e["lower"])) for e in elements.values()}
    pairs = [(a, b) for i, a in enumerate(bodies) for b in bodies[i + 1 :]]
    pairs += [(a, w) for a in bodies for w in inputs if frozenset((a, w)) not in joined][: len(pairs) // 2]
    one, other = pairs[random.integers(len(pairs))]
    size = {q: float(np.median([e[q] for e in elements.values()])) for q in ("stiffness", "damping")}
    values = {q: s * float(np.exp(random.uniform(np.log(0.05), np.log(0.6)))) for q, s in size.items()}
    if other in inputs:
        x, y = next(e["position"] for e in elements.values() if e["lower"] == other)
    else:
        x, y = (float(random.uniform(*_span(data, (one, other), axis))) for axis in (0, 1))
    elements[HIDDEN] = {"upper": one, "lower": other, "position": [x, y], **values}
    place = {name: value for name, value in (("x", x), ("y", y)) if _turns(data, (one, other), name)}
    return ConcealedPart("missing_connection", f"{one}|{other}", values | place, data)


def _turns(data: dict[str, Any], names: tuple[str, ...], axis: str) -> bool:
    key = {"x": "pitch_inertia", "y": "roll_inertia"}[axis]
    return any(key in data["bodies"].get(name, {}) for name in names)


def _suspended(data: dict[str, Any], random: np.random.Generator) -> ConcealedPart:
    body = list(data["bodies"])[0 if random.random() < 0.8 else -1]
    mass = data["bodies"][body]["mass"] * float(np.exp(random.uniform(np.log(0.01), np.log(0.08))))
    frequency, ratio = float(random.uniform(3.0, 12.0)), float(random.uniform(0.02, 0.15))
    x, y = (float(random.uniform(*_span(data, (body,), axis))) for axis in (0, 1))
    omega = 2 * np.pi * frequency
    data["bodies"][HIDDEN] = {"mass": mass, "position": [x, y]}
    spring = {"stiffness": mass * omega**2, "damping": 2 * ratio * omega * mass}
    data["elements"][HIDDEN] = {"upper": body, "lower": HIDDEN, "position": [x, y], **spring}
    place = {name: value for name, value in (("x", x), ("y", y)) if _turns(data, (body,), name)}
    return ConcealedPart(
        "suspended_mass", body, {"mass": mass, "frequency": frequency, "damping_ratio": ratio} | place, data
    )


def _moved(data: dict[str, Any], random: np.random.Generator) -> ConcealedPart:
    """An element is not where the file says: the one that the diagnosis is given is the unmoved one."""
    elements = data["elements"]
    places = [
        (name, axis)
        for name, e in elements.items()
        for axis in ("x", "y")
        if _turns(data, (e["upper"], e["lower"]), axis)
    ]
    name, axis = places[random.integers(len(places))]
    offset = float(random.choice([-1, 1]) * random.uniform(0.12, 0.5))
    position = list(elements[name]["position"])
    position["xy".index(axis)] += offset
    elements[name]["position"] = position
    return ConcealedPart("wrong_position", name, {"offset": offset}, data)


def _of_rubber(data: dict[str, Any], random: np.random.Generator) -> ConcealedPart:
    """A spring with a part K(w) = k (j w / w1)^a, w1 of 1 Hz."""
    name = str(random.choice(list(data["elements"])))
    size = data["elements"][name]["stiffness"] * float(np.exp(random.uniform(np.log(0.03), np.log(0.4))))
    order = float(random.uniform(0.15, 0.6))
    values = {"stiffness": size, "order": order}
    return ConcealedPart("fractional_stiffness", name, values, data, (name, size, order))


def made(
    part: ConcealedPart, stated: dict[str, Any], system: System, random: np.random.Generator, seconds: float
) -> tuple[MadeSamples, float]:
    """The recording of a vehicle, and the signal-to-noise ratio of its part."""
    vehicle, whole = vehicle_of(stated), vehicle_of(part.data)
    case = Case(
        kind=part.effect,
        seed=int(random.integers(2**62)),
        stiffness={name: e["stiffness"] for name, e in part.data["elements"].items()},
        damping={name: e["damping"] for name, e in part.data["elements"].items()},
        speed=float(random.uniform(39, 50)),
        level=float(np.exp(random.uniform(np.log(LOW_TRACK), np.log(HIGH_TRACK)))),
        joints=None,
        rubber=part.rubber,
    )
    clean = exact_response(whole, case, seconds)
    snr = oracle_snr(vehicle, case, clean, clean)
    noise = np.concatenate([vehicle.input_noise.ravel(), vehicle.sensor_noise])
    values = clean + random.standard_normal(clean.shape) * noise
    return MadeSamples(in_order(vehicle, system, values)), float(snr or 0.0)


def in_order(vehicle: Vehicle, system: System, values: Array) -> Array:
    """The generator's columns in the order of the system's channels."""
    names = [f"{w}.displacement" for w in vehicle.inputs] + [f"{w}.velocity" for w in vehicle.inputs]
    columns = [*names, *vehicle.sensors]
    return values[:, [columns.index(channel.name) for channel in system.channels]]

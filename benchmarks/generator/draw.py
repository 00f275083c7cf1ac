"""Which vehicle, track and concealed effect each recording of a set gets, drawn from one seed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from sprung.benchmarks.generator.laws import LAWS
from sprung.benchmarks.generator.track import HIGH_TRACK, LOW_TRACK
from sprung.benchmarks.generator.vehicle import Vehicle

# rms deflection (m) and rate (m/s) of the nominal vehicle's elements on the low track at 45 m/s, from this generator
USUAL = {"primary": (7.2e-4, 0.032), "secondary": (2.5e-3, 0.026)}

FAULTS = ("sensor_gain", "sensor_lag", "sensor_bias", "sensor_noise", "sensor_stuck")
BODY_EFFECTS = ("flexible_mode", "external_force", "mass_change")


@dataclass
class Case:
    """Everything that makes one recording, and so its truth."""

    kind: str  # an effect, "clean", "k_scale", "c_scale" or "two"
    seed: int
    stiffness: dict[str, float]  # N/m
    damping: dict[str, float]  # N s/m
    speed: float  # m/s
    level: float  # b0 of the track
    joints: float | None  # m between dipped joints
    effects: list[tuple[str, str, list[float]]] = field(default_factory=list)  # (element, law, parameters)
    flex: list[float] | None = None  # [Hz, damping ratio, shape at the secondary springs, modal mass kg]
    drive: list[float] | None = None  # [N, Hz, degree of freedom]
    mass_scale: tuple[str, float] | None = None  # body, ratio
    rubber: tuple[str, float, float] | None = None  # element, N/m at 1 Hz, power of the frequency
    fault: tuple[str, str, float] | None = None  # channel, kind, value
    change: dict[str, dict[str, float]] = field(default_factory=dict)  # k_scale, c_scale

    def findings(self) -> list[dict[str, Any]]:
        """The truth as the published labels write it."""
        found: list[dict[str, Any]] = [
            {"location": place, "effect": LAWS[law].known_as or law, "parameters": p} for place, law, p in self.effects
        ]
        if self.flex:
            found.append({"location": "car", "effect": "flexible_mode", "parameters": self.flex[:2]})
        if self.drive:
            body = ("car", "bogie1", "bogie2")[int(self.drive[2]) // 3]
            found.append({"location": body, "effect": "external_force", "parameters": self.drive[:2]})
        if self.mass_scale:
            body, ratio = self.mass_scale
            found.append({"location": body, "effect": "mass_change", "parameters": [ratio]})
        if self.rubber:
            element, *values = self.rubber
            found.append({"location": element, "effect": "fractional_stiffness", "parameters": values})
        if self.fault:
            channel, kind, value = self.fault
            known = [] if kind == "sensor_stuck" else [value]
            found.append({"location": channel, "effect": kind, "parameters": known})
        return found

    def verdict(self) -> str:
        """What a perfect diagnosis would say."""
        if self.fault:
            return "sensor_fault"
        if any(not (LAWS[law].named or LAWS[law].known_as) for _, law, _ in self.effects):
            return "unknown_physics"
        return "missing_physics" if self.findings() else "consistent"


def kinds_of_a_set(rng: np.random.Generator, count: int, kinds: list[str] | None = None) -> list[str]:
    """`count` kinds: whole rounds of all kinds, each round in random order."""
    unnamed = [name for name, law in LAWS.items() if not law.named]
    full = [name for name, law in LAWS.items() if law.named]
    full += [*BODY_EFFECTS, *FAULTS, *unnamed, "two", "two", "clean", "clean", "k_scale", "c_scale"]
    pool = kinds or full
    out: list[str] = []
    while len(out) < count:
        out += [str(kind) for kind in rng.permutation(pool)]
    return out[:count]


def _log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def _values(rng: np.random.Generator, vehicle: Vehicle) -> tuple[dict[str, float], dict[str, float]]:
    """A healthy vehicle: each value within +-6 to +-18 % of nominal, the spread itself drawn per vehicle."""
    spread = rng.uniform(0.06, 0.18)
    factor = rng.uniform(1 - spread, 1 + spread, size=(2, len(vehicle.elements)))
    stiffness = dict(zip(vehicle.elements, (vehicle.stiffness * factor[0]).tolist(), strict=True))
    damping = dict(zip(vehicle.elements, (vehicle.damping * factor[1]).tolist(), strict=True))
    return stiffness, damping


def add_law(case: Case, rng: np.random.Generator, element: str, law: str, weak: float) -> None:
    """Puts a law at an element; weak: as in `draw_cases`."""
    low, high = LAWS[law].strength
    strength = _log_uniform(rng, low**weak * high ** (1 - weak), high if weak <= 1 else low)
    deflection, rate = USUAL["secondary" if element.startswith("secondary") else "primary"]
    roughness = np.sqrt(case.level / LOW_TRACK)
    parameters = LAWS[law].draw(
        rng, strength, case.stiffness[element], case.damping[element], deflection * roughness, rate * roughness
    )
    case.effects.append((element, law, parameters))


def _add_fault(case: Case, rng: np.random.Generator, kind: str, vehicle: Vehicle, small: float) -> None:
    channels = [f"{w}.{q}" for q in ("displacement", "velocity") for w in vehicle.inputs] + list(vehicle.sensors)
    noise = np.concatenate([vehicle.input_noise.ravel(), vehicle.sensor_noise])
    on_sensor = rng.random() < 0.75
    first = 2 * len(vehicle.inputs)
    index = int(rng.integers(first, len(channels)) if on_sensor else rng.integers(0, first))
    draws: dict[str, Callable[[], float]] = {
        "sensor_gain": lambda: 1 + rng.choice([-1, 1]) * small * _log_uniform(rng, 0.01, 0.2),
        "sensor_lag": lambda: small * _log_uniform(rng, 5e-4, 0.012),
        "sensor_bias": lambda: rng.choice([-1, 1]) * noise[index] * small * _log_uniform(rng, 0.3, 30),
        "sensor_noise": lambda: _log_uniform(rng, 1.5, 10),
        "sensor_stuck": lambda: rng.uniform(5, 45),
    }
    value = draws[kind]()
    case.fault = channels[index], kind, float(value)


def _conceal(case: Case, rng: np.random.Generator, vehicle: Vehicle, weak: float) -> None:
    """Puts the effect that `case.kind` names into the case."""
    elements, kind = list(vehicle.elements), case.kind
    small = 0.05 ** max(weak - 1, 0)  # of faults and bodies; laws have ranges of their own
    element = str(rng.choice(elements if rng.random() < 0.6 else elements[8:]))
    if kind in LAWS:
        add_law(case, rng, element, kind, weak)
    elif kind == "two":
        names = [name for name, law in LAWS.items() if law.named]
        places = rng.choice(elements, 2, replace=False)
        for place, law in zip(places, rng.choice(names, 2, replace=False), strict=True):
            add_law(case, rng, str(place), str(law), weak * 0.5)
    elif kind == "flexible_mode":
        case.flex = [rng.uniform(6, 16), rng.uniform(0.01, 0.03), small * _log_uniform(rng, 0.03, 0.5), 8000.0]
    elif kind == "external_force":
        degree = int(rng.choice([0, 0, 0, 1, 2, 3, 6]))
        case.drive = [small * _log_uniform(rng, 20, 400), rng.uniform(1.5, 20), float(degree)]
    elif kind == "mass_change":
        body = str(rng.choice(vehicle.bodies, p=[0.6, 0.2, 0.2]))
        case.mass_scale = body, float(1 + rng.choice([-1, 1, 1]) * small * _log_uniform(rng, 0.01, 0.25))
    elif kind in FAULTS:
        _add_fault(case, rng, kind, vehicle, small)
    elif kind == "k_scale":
        case.change = {"k_scale": {element: rng.uniform(0.6, 0.9)}}
        case.stiffness[element] *= case.change["k_scale"][element]
    elif kind == "c_scale":
        case.change = {"c_scale": {element: rng.uniform(0.3, 0.8)}}
        case.damping[element] *= case.change["c_scale"][element]


def draw_cases(
    vehicle: Vehicle, count: int, seed: int, kinds: list[str] | None = None, weak: float = 1.0
) -> list[Case]:
    """`count` cases of a sealed seed.  `weak` 0 draws only strong laws, 1 down to weak ones, 2 weak to hidden ones."""
    root = np.random.SeedSequence(seed)
    chosen = kinds_of_a_set(np.random.default_rng(root.spawn(1)[0]), count, kinds)
    cases = []
    for kind, branch in zip(chosen, root.spawn(count), strict=True):
        rng = np.random.default_rng(branch)
        stiffness, damping = _values(rng, vehicle)
        joints = float(rng.uniform(18, 36)) if rng.random() < 0.15 else None
        level = _log_uniform(rng, LOW_TRACK, HIGH_TRACK)
        speed = float(rng.uniform(34, 40) if joints else rng.uniform(39, 50))
        case = Case(kind, int(rng.integers(2**62)), stiffness, damping, speed, level, joints)
        _conceal(case, rng, vehicle, weak)
        cases.append(case)
    return cases

"""Geometry and nominal values of a lumped vehicle, read from the YAML system file without `model/`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Vehicle:
    """M z'' = -G' f(d, v) with d = G z - w on the elements that stand on a wheel."""

    bodies: tuple[str, ...]
    inertia: Array  # kg, kg m^2: [mass, roll, pitch] of every body, shape (3 * bodies,)
    elements: tuple[str, ...]
    geometry: Array  # deflection of each element per degree of freedom, shape (E, 3 * bodies)
    stiffness: Array  # N/m, shape (E,)
    damping: Array  # N s/m, shape (E,)
    support: tuple[int, ...]  # wheel under each element, -1 for none, length E
    upper: tuple[str, ...]  # body above each element
    inputs: tuple[str, ...]
    input_position: Array  # m ahead of the origin, shape (inputs,)
    input_side: Array  # +1 left, -1 right, shape (inputs,)
    input_noise: Array  # m and m/s, shape (2, inputs)
    sensors: tuple[str, ...]
    sensor_body: tuple[str, ...]
    pickup: Array  # acceleration of each sensor per degree of freedom, shape (S, 3 * bodies)
    sensor_noise: Array  # m/s^2, shape (S,)
    places: tuple[dict[str, str], ...]  # where a recording keeps each channel: displacements, velocities, sensors

    @property
    def channels(self) -> list[str]:
        """Names in the order of `places`."""
        return [f"{w}.{q}" for q in ("displacement", "velocity") for w in self.inputs] + list(self.sensors)

    def on_body(self, body: str) -> slice:
        """Rows of a body's three degrees of freedom."""
        first = 3 * self.bodies.index(body)
        return slice(first, first + 3)


def _lever(bodies: dict[str, Any], body: str, position: list[float] | None) -> Array:
    """Vertical motion at a point: z + (y - y0) roll + (x - x0) pitch."""
    row = np.zeros(3 * len(bodies))
    first = 3 * list(bodies).index(body)
    centre = bodies[body].get("position", (0.0, 0.0))
    x, y = (0.0, 0.0) if position is None else (position[0] - centre[0], position[1] - centre[1])
    row[first] = 1.0
    row[first + 1] = y if "roll_inertia" in bodies[body] else 0.0
    row[first + 2] = x if "pitch_inertia" in bodies[body] else 0.0
    return row


def _signal(entry: dict[str, Any]) -> dict[str, str]:
    return {key: str(entry[key]) for key in ("mcap", "can", "csv") if key in entry}


def read_vehicle(path: str | Path) -> Vehicle:
    """The vehicle of a system file on supports, whose sensors are accelerometers."""
    return vehicle_of(yaml.safe_load(Path(path).read_text(encoding="utf-8")))


def vehicle_of(data: dict[str, Any]) -> Vehicle:
    """The same of a file's content.  What a body cannot do, roll or pitch, has an inertia of 1 and no lever."""
    bodies, inputs, elements, sensors = data["bodies"], data["inputs"], data["elements"], data["sensors"]
    wheels = list(inputs)
    geometry = np.array([_lever(bodies, e["upper"], e.get("position")) for e in elements.values()])
    support = []
    where: dict[str, Any] = {}
    for row, element in enumerate(elements.values()):
        lower = element["lower"]
        support.append(wheels.index(lower) if lower in inputs else -1)
        if lower in inputs:
            where.setdefault(lower, element.get("position", (0.0, 0.0)))
        elif lower != "ground":
            geometry[row] -= _lever(bodies, lower, element.get("position"))
    return Vehicle(
        bodies=tuple(bodies),
        inertia=np.array(
            [[b["mass"], b.get("roll_inertia", 1.0), b.get("pitch_inertia", 1.0)] for b in bodies.values()], float
        ).ravel(),
        elements=tuple(elements),
        geometry=geometry,
        stiffness=np.array([e["stiffness"] for e in elements.values()], float),
        damping=np.array([e["damping"] for e in elements.values()], float),
        support=tuple(support),
        upper=tuple(e["upper"] for e in elements.values()),
        inputs=tuple(wheels),
        input_position=np.array([where[w][0] for w in wheels], np.float64),
        input_side=np.sign(np.array([where[w][1] for w in wheels], float)),
        input_noise=np.array([[inputs[w][q]["noise"] for w in wheels] for q in ("displacement", "velocity")], float),
        sensors=tuple(sensors),
        sensor_body=tuple(s["body"] for s in sensors.values()),
        pickup=np.array([_lever(bodies, s["body"], s.get("position")) for s in sensors.values()]),
        sensor_noise=np.array([s["noise"] for s in sensors.values()], float),
        places=tuple(
            [_signal(inputs[w][q]) for q in ("displacement", "velocity") for w in wheels]
            + [_signal(s) for s in sensors.values()]
        ),
    )

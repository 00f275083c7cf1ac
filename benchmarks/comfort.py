"""What a failing element costs in comfort: foreseen from the model, and on simulated rides of the generator."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from sprung.benchmarks.generator.ride import draw_ride, record
from sprung.benchmarks.generator.track import LOW_TRACK
from sprung.model.comfort import LEAD, W_B, comfort_sensors, cost, weighted
from sprung.model.system import load_system

REMAINS = {"stiffness": 0.5, "damping": 0.2}  # of a failing element's value
SPEED = 40.0  # m/s


def run(rides: int = 4, seconds: float = 240.0, seed: int = 9300) -> Iterator[dict[str, Any]]:
    """One figure for each kind of element and value."""
    system = load_system()
    sensors, rate = list(comfort_sensors(system)), system.sample_rate
    names = [p.name for p in system.parameters]
    for name in ("primary_11l.stiffness", "primary_11l.damping", "secondary_1l.stiffness", "secondary_1l.damping"):
        failed = np.zeros(len(names))
        failed[names.index(name)] = np.log(REMAINS[name.split(".")[1]])
        changes = []
        for number in range(rides):
            seen = []
            for values in (np.zeros(len(names)), failed):
                rng = np.random.default_rng([seed, number])  # the same track for both
                drawn = draw_ride(rng)
                ride = replace(drawn, log_ratio=values, load=0.0, speed=SPEED, level=LOW_TRACK, coherence=0.5)
                shown = weighted(record(rng, ride, seconds)[:, sensors], rate, W_B)[round(LEAD * rate) :]
                seen.append(np.sqrt((shown**2).mean(axis=0)).mean())
            changes.append(seen[1] / seen[0] - 1)
        yield {
            "figure": "comfort lost",
            "failed": name,
            "remains": REMAINS[name.split(".")[1]],
            "foreseen_percent": 100 * (cost(system, failed, np.zeros(len(names)), SPEED) or 0.0),
            "simulated_percent": float(100 * np.mean(changes)),
            "rides": rides,
        }

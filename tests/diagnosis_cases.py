"""A quarter car, simulated by code of its own: what the diagnosis is tested against."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from sprung.benchmarks.sensitivity_cases import QUARTER_CAR as SYSTEM
from sprung.model.diagnosis.fit.problem import Problem
from sprung.model.diagnosis.record.channels import prepare
from sprung.model.diagnosis.record.signals import declared_noise, transform
from sprung.model.system import System, parse_system

STIFFNESS = {"primary": 2.2e6, "secondary": 4.6e5}
DAMPING = {"primary": 1.1e4, "secondary": 1.8e4}
FINE = 10  # steps per sample
Force = Callable[[float, float], float]  # of deflection, m, and rate, m/s; N


def quarter_car() -> System:
    return parse_system(SYSTEM)


@dataclass
class MadeRecord:
    values: np.ndarray
    sample_rate: float = 100.0
    lost: int = 0
    extra: dict[str, Any] = field(default_factory=dict)


def simulate(
    law: Force | None = None, *, seconds: float = 20.0, seed: int = 0, noise: float = 1.0, level: float = 1.0
) -> MadeRecord:
    """Columns wheel displacement, velocity, four accelerations; `law(d, v)` adds a force to the secondary element.

    Road of random phases from 0.5 to 18 Hz, Runge-Kutta at 1 kHz, every channel low-passed at 42 Hz alike, decimated.
    """
    rng = np.random.default_rng(seed)
    step = 1 / (100.0 * FINE)
    n = int(seconds * 100) * FINE
    road, slope = _road(np.arange(2 * n + 1) * step / 2, rng.uniform(0, 2 * np.pi, 160), level)
    body = _quarter_car(law or (lambda d, v: 0.0), road.tolist(), slope.tolist(), step)
    channels = np.column_stack([road[: 2 * n : 2], slope[: 2 * n : 2], body[:, 0], body[:, 0], body[:, 1], body[:, 1]])
    values = _decimated(channels)
    values += noise * rng.standard_normal(values.shape) * np.array([1e-5, 5e-4, 4e-3, 4e-3, 3e-2, 3e-2])
    return MadeRecord(values)


def _road(time: np.ndarray, phase: np.ndarray, level: float) -> tuple[np.ndarray, np.ndarray]:
    """Height and slope over time (T,): an evenly spaced comb of lines, 1 / f in height."""
    frequency = np.linspace(0.5, 18, len(phase))
    road, slope = np.zeros(len(time)), np.zeros(len(time))
    for a, f, p in zip(level * 6e-4 / frequency, frequency, phase, strict=True):
        angle = 2 * np.pi * f * time + p
        road += a * np.sin(angle)
        slope += 2 * np.pi * f * a * np.cos(angle)
    return road, slope


def _quarter_car(law: Force, w: list[float], dw: list[float], h: float) -> np.ndarray:
    """Accelerations of car and bogie, (T, 2), by Runge-Kutta; w, dw: the road at every half step.

    In plain numbers, one after the other: arrays of two are slower by a factor of ten.
    """
    k1, c1, k2, c2 = STIFFNESS["primary"], DAMPING["primary"], STIFFNESS["secondary"], DAMPING["secondary"]

    def accelerations(z1: float, z2: float, v1: float, v2: float, i: int) -> tuple[float, float]:
        upper = k2 * (z1 - z2) + c2 * (v1 - v2) + law(z1 - z2, v1 - v2)
        return -upper / 8000, (upper - k1 * (z2 - w[i]) - c1 * (v2 - dw[i])) / 1300

    z1 = z2 = v1 = v2 = 0.0
    rows = []
    for i in range(0, len(w) - 1, 2):
        a1, a2 = accelerations(z1, z2, v1, v2, i)
        rows.append((a1, a2))
        p1, p2 = v1 + h / 2 * a1, v2 + h / 2 * a2
        b1, b2 = accelerations(z1 + h / 2 * v1, z2 + h / 2 * v2, p1, p2, i + 1)
        q1, q2 = v1 + h / 2 * b1, v2 + h / 2 * b2
        d1, d2 = accelerations(z1 + h / 2 * p1, z2 + h / 2 * p2, q1, q2, i + 1)
        r1, r2 = v1 + h * d1, v2 + h * d2
        e1, e2 = accelerations(z1 + h * q1, z2 + h * q2, r1, r2, i + 2)
        z1, z2 = z1 + h / 6 * (v1 + 2 * p1 + 2 * q1 + r1), z2 + h / 6 * (v2 + 2 * p2 + 2 * q2 + r2)
        v1, v2 = v1 + h / 6 * (a1 + 2 * b1 + 2 * d1 + e1), v2 + h / 6 * (a2 + 2 * b2 + 2 * d2 + e2)
    return np.array(rows)


def _decimated(channels: np.ndarray) -> np.ndarray:
    from scipy.signal import firwin, oaconvolve

    taps = firwin(40 * FINE + 1, 42.0, fs=100.0 * FINE)
    half = len(taps) // 2
    filtered = oaconvolve(channels, taps[:, None], axes=0)[half:-half]
    margin = 30 * FINE  # the filter's ends
    return filtered[margin:-margin:FINE]


def problem_of(record: MadeRecord, system: System | None = None) -> Problem:
    """A recording of the quarter car as a problem with declared noise."""
    system = system or quarter_car()
    signals = prepare(system, record.values, record.sample_rate).signals
    noise = declared_noise(system, signals)
    return Problem(system, transform(signals, noise), signals.sensor_index, noise)


def true_log_ratios(system: System) -> np.ndarray:
    """The simulated elements' values over nominal, logarithms, (P,)."""
    values = [(STIFFNESS if p.quantity == "stiffness" else DAMPING)[p.element] for p in system.parameters]
    return np.log(np.array(values) / system.nominal)

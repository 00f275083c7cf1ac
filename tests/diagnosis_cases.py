"""A quarter car, simulated by code of its own: what the diagnosis is tested against."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from sprung.benchmarks.sensitivity_cases import QUARTER_CAR as SYSTEM
from sprung.model.diagnosis.fit.problem import Problem
from sprung.model.diagnosis.record.channels import prepare
from sprung.model.diagnosis.record.signals import declared_noise, transform
from sprung.model.system import System, parse_system

STIFFNESS = {"primary": 2.2e6, "secondary": 4.6e5}
DAMPING = {"primary": 1.1e4, "secondary": 1.8e4}
FINE = 10  # steps per sample


def quarter_car() -> System:
    return parse_system(SYSTEM)


@dataclass
class MadeRecord:
    values: np.ndarray
    sample_rate: float = 100.0
    lost: int = 0
    extra: dict = field(default_factory=dict)


def simulate(law=None, *, seconds: float = 30.0, seed: int = 0, noise: float = 1.0, level: float = 1.0) -> MadeRecord:
    """Columns wheel displacement, velocity, four accelerations; `law(d, v)` adds a force to the secondary element.

    Road of random phases from 0.5 to 18 Hz, Runge-Kutta at 1 kHz, every channel low-passed at 42 Hz alike, decimated.
    """
    rng = np.random.default_rng(seed)
    step = 1 / (100.0 * FINE)
    n = int(seconds * 100) * FINE
    frequency = np.linspace(0.5, 18, 160)
    phase = rng.uniform(0, 2 * np.pi, 160)
    size = level * 6e-4 / frequency
    time = np.arange(2 * n + 1) * step / 2
    road, slope = np.zeros(len(time)), np.zeros(len(time))
    for a, f, p in zip(size, frequency, phase, strict=True):
        angle = 2 * np.pi * f * time + p
        road += a * np.sin(angle)
        slope += 2 * np.pi * f * a * np.cos(angle)
    law = law or (lambda d, v: 0.0)
    k1, c1, k2, c2 = STIFFNESS["primary"], DAMPING["primary"], STIFFNESS["secondary"], DAMPING["secondary"]

    def accelerations(x, w, dw):
        z1, z2, v1, v2 = x
        upper = k2 * (z1 - z2) + c2 * (v1 - v2) + law(z1 - z2, v1 - v2)
        lower = k1 * (z2 - w) + c1 * (v2 - dw)
        return -upper / 8000, (upper - lower) / 1300

    def rate(x, i):
        a1, a2 = accelerations(x, road[i], slope[i])
        return (x[2], x[3], a1, a2)

    x = (0.0, 0.0, 0.0, 0.0)
    out = np.empty((n, 2))
    for i in range(n):
        out[i] = accelerations(x, road[2 * i], slope[2 * i])
        r1 = rate(x, 2 * i)
        r2 = rate(tuple(a + step / 2 * b for a, b in zip(x, r1, strict=True)), 2 * i + 1)
        r3 = rate(tuple(a + step / 2 * b for a, b in zip(x, r2, strict=True)), 2 * i + 1)
        r4 = rate(tuple(a + step * b for a, b in zip(x, r3, strict=True)), 2 * i + 2)
        x = tuple(a + step / 6 * (p + 2 * q + 2 * r + s) for a, p, q, r, s in zip(x, r1, r2, r3, r4, strict=True))
    channels = np.column_stack([road[: 2 * n : 2], slope[: 2 * n : 2], out[:, 0], out[:, 0], out[:, 1], out[:, 1]])
    values = _decimated(channels)
    values += noise * rng.standard_normal(values.shape) * np.array([1e-5, 5e-4, 4e-3, 4e-3, 3e-2, 3e-2])
    return MadeRecord(values)


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

"""A quarter car whose strut has laws, simulated by code of its own: what windows with laws are tested against."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicHermiteSpline
from scipy.signal import firwin

from sprung.model.signals import FloatArray
from sprung.model.system import System, parse_system

RATE = 200.0  # Hz
NOISE = [1e-5, 5e-4, 0.03, 0.01, 2.0]
STIFFNESS, DAMPING = 22e3, 1400.0  # of the strut that is simulated; the file has 20e3 and 1500
FINE = 8  # points a sample, before the anti-alias filter
TEXT = """
name: quarter-car
sample_rate: 200
window: 200
bodies:
  wheel: {{mass: 45}}
  car: {{mass: 400}}
inputs:
  road:
    kind: displacement
    displacement: {{csv: road, noise: 1.0e-5}}
    velocity: {{csv: rate, noise: 5.0e-4}}
elements:
  tyre: {{upper: wheel, lower: road, stiffness: 200000, damping: {{value: 50, fixed: true}}}}
  strut: {{upper: car, lower: wheel, stiffness: 20000, damping: 1500, laws: [{law}]}}
sensors:
  wheel_a: {{kind: acceleration, body: wheel, csv: a, noise: 0.03}}
  car_a: {{kind: acceleration, body: car, csv: b, noise: 0.01, laws: [{sensor}]}}
  strut_f: {{kind: force, element: strut, csv: f, noise: 2.0}}
"""


def strut(law: str = "", sensor: str = "") -> System:
    """With a law of the strut and one of the body's accelerometer, as in a system file."""
    return parse_system(TEXT.format(law=law, sensor=sensor))


def road(seconds: float, seed: int) -> tuple[FloatArray, CubicHermiteSpline]:
    """Times and height of a road of random phases, 0.4 to 25 Hz."""
    rng = np.random.default_rng(seed)
    t = np.arange(round(seconds * RATE)) / RATE
    f, phase = rng.uniform(0.4, 25, 120), rng.uniform(0, 6.3, 120)
    height = (8e-3 / f / 4 * np.sin(2 * np.pi * f * t[:, None] + phase)).sum(axis=1)
    speed = (8e-3 / 2 * np.pi * np.cos(2 * np.pi * f * t[:, None] + phase)).sum(axis=1)
    return t, CubicHermiteSpline(t, height, speed)


def recorded(
    seconds: float,
    seed: int,
    force: Callable[[FloatArray, FloatArray], FloatArray],
    memory: Callable[[float, float], float] = lambda v, z: 0.0,
) -> FloatArray:
    """A noisy recording (T, 5) of the strut with a further force of its rate and memory; memory: rate of that."""
    t, u = road(seconds, seed)
    rate = u.derivative()

    def forces(time: FloatArray, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        v = x[3] - x[2]
        return STIFFNESS * (x[1] - x[0]) + DAMPING * v + force(v, x[4]), 2e5 * (x[0] - u(time)) + 50 * (
            x[2] - rate(time)
        )

    def slope(time: FloatArray, x: FloatArray) -> list[float]:
        pull, tyre = forces(time, x)
        return [x[2], x[3], (pull - tyre) / 45, -pull / 400, memory(x[3] - x[2], x[4])]

    fine = np.arange(FINE * (len(t) - 1) + 1) / (FINE * RATE)
    x = solve_ivp(slope, (0, t[-1]), np.zeros(5), t_eval=fine, rtol=1e-7, atol=1e-10, max_step=1 / RATE).y
    pull, tyre = forces(fine, x)
    sensors = np.stack([(pull - tyre) / 45, -pull / 400, pull], axis=1)
    taps = firwin(FINE * 64 + 1, 0.9 / FINE)  # the anti-alias filter that a recorder has
    shown = np.apply_along_axis(np.convolve, 0, sensors, taps, "same")[::FINE]
    clean = np.column_stack([u(t), rate(t), shown])
    return np.asarray(clean + np.random.default_rng([seed, 1]).normal(0, NOISE, clean.shape))

"""What is concealed: laws added to k d + c v, and how their parameters are drawn from a strength.

`force(d, v, p, k, c, t, m)` returns the extra force (N); laws with memory also return the rate of their memory `m`.
All arguments are arrays over the slots (one slot = one effect on one element of one recording); `p` has one row per
parameter.  `draw(rng, s, k, c, D, R)` turns a strength s (about the extra force over the element's whole force) into
parameters, with D and R the usual rms deflection (m) and rate (m/s) of the element.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Law:
    """One concealed effect of an element."""

    force: Callable[..., Any]
    draw: Callable[..., list[float]]
    memory: bool = False
    named: bool = True  # in the published list of words; otherwise the right verdict is unknown physics
    known_as: str = ""  # a law of the catalogue that describes it as well, if it has another name
    strength: tuple[float, float] = (0.01, 0.4)


def cubic(d: Array, v: Array, p: Array, k: Array, c: Array, t: float, m: Array) -> Array:
    found: Array = p[0] * d * d * d
    return found


def bump(d: Array, v: Array, p: Array, k: Array, c: Array, t: float, m: Array) -> Array:
    found: Array = p[1] * (d - np.minimum(np.maximum(d, -p[0]), p[0]))
    return found


def clearance(d: Array, v: Array, p: Array, k: Array, c: Array, t: float, m: Array) -> Array:
    found: Array = -k * np.minimum(np.maximum(d, -p[0]), p[0])
    return found


def coulomb(d: Array, v: Array, p: Array, k: Array, c: Array, t: float, m: Array) -> Array:
    found: Array = p[0] * np.tanh(v / p[1])
    return found


def blowoff(d: Array, v: Array, p: Array, k: Array, c: Array, t: float, m: Array) -> Array:
    found: Array = (p[1] - 1) * c * (v - np.minimum(np.maximum(v, -p[0]), p[0]))
    return found


def asymmetry(d: Array, v: Array, p: Array, k: Array, c: Array, t: float, m: Array) -> Array:
    found: Array = p[0] * c * np.abs(v)
    return found


def quadratic_damping(d: Array, v: Array, p: Array, k: Array, c: Array, t: float, m: Array) -> Array:
    found: Array = p[0] * v * np.abs(v)
    return found


def series(d: Array, v: Array, p: Array, k: Array, c: Array, t: float, m: Array) -> tuple[Array, Array]:
    """The memory is the damper's force F: F' = ks (v - F / c)."""
    return m - c * v, p[0] * (v - m / c)


def bouc_wen(d: Array, v: Array, p: Array, k: Array, c: Array, t: float, m: Array) -> tuple[Array, Array]:
    size = np.abs(m)
    power = size ** (p[2] - 1)
    return p[0] * m, v - p[1] * np.abs(v) * power * m - 0.5 * p[1] * v * power * size


def varying_stiffness(d: Array, v: Array, p: Array, k: Array, c: Array, t: float, m: Array) -> Array:
    found: Array = k * d * p[0] * (1 - np.exp(-t / p[1]))
    return found


def varying_damping(d: Array, v: Array, p: Array, k: Array, c: Array, t: float, m: Array) -> Array:
    found: Array = c * v * p[0] * (1 - np.exp(-t / p[1]))
    return found


def quadratic_stiffness(d: Array, v: Array, p: Array, k: Array, c: Array, t: float, m: Array) -> Array:
    found: Array = p[0] * d * d
    return found


def position_damping(d: Array, v: Array, p: Array, k: Array, c: Array, t: float, m: Array) -> Array:
    found: Array = p[0] * d * d * v
    return found


def ripple(d: Array, v: Array, p: Array, k: Array, c: Array, t: float, m: Array) -> Array:
    """A toothed guide: the force waves with the deflection."""
    found: Array = p[0] * np.sin(d / p[1])
    return found


def speed_stiffness(d: Array, v: Array, p: Array, k: Array, c: Array, t: float, m: Array) -> Array:
    """Rubber that stiffens with the rate: k_v |v| d."""
    found: Array = p[0] * np.abs(v) * d
    return found


def one_sided_stop(d: Array, v: Array, p: Array, k: Array, c: Array, t: float, m: Array) -> Array:
    """A stop that is met in compression only."""
    found: Array = p[1] * np.minimum(d + p[0], 0.0)
    return found


def saturating(d: Array, v: Array, p: Array, k: Array, c: Array, t: float, m: Array) -> Array:
    """A part of the spring slips once its travel is used up, without hysteresis."""
    found: Array = p[1] * k * (p[0] * np.tanh(d / p[0]) - d)
    return found


def _signed(rng: np.random.Generator, size: float) -> float:
    return float(size * rng.choice([-1.0, 1.0]))


def _hysteresis(rng: np.random.Generator, s: float, k: float, reach: float) -> list[float]:
    """[alpha, beta, n] whose memory settles at `reach` metres: reach^n = 1 / (1.5 beta)."""
    order = float(rng.choice([1.0, 1.0, 2.0]))
    return [2 * s * k, 1 / (1.5 * reach**order), order]


LAWS: dict[str, Law] = {
    "cubic_stiffness": Law(cubic, lambda rng, s, k, c, D, R: [s * k / (2 * D**2)], strength=(0.005, 0.4)),
    "bump_stop": Law(bump, lambda rng, s, k, c, D, R: [rng.uniform(0.8, 2.0) * D, 12 * s * k], strength=(0.02, 0.6)),
    "clearance": Law(clearance, lambda rng, s, k, c, D, R: [s * D], strength=(0.01, 0.4)),
    "coulomb_friction": Law(
        coulomb,
        lambda rng, s, k, c, D, R: [s * k * D, float(rng.choice([0.001, 0.002, 0.004]))],
        strength=(0.005, 0.3),
    ),
    "damper_blowoff": Law(
        blowoff,
        lambda rng, s, k, c, D, R: [rng.uniform(0.3, 1.3) * R, float(np.clip(1 - 2 * s, 0.05, 0.95))],
        strength=(0.05, 0.45),
    ),
    "damper_asymmetry": Law(asymmetry, lambda rng, s, k, c, D, R: [_signed(rng, s)], strength=(0.02, 0.5)),
    "quadratic_damping": Law(quadratic_damping, lambda rng, s, k, c, D, R: [s * c / R], strength=(0.05, 1.0)),
    "series_stiffness": Law(
        series, lambda rng, s, k, c, D, R: [c * 2 * np.pi * 3 / s], memory=True, strength=(0.1, 1.0)
    ),
    "bouc_wen": Law(
        bouc_wen,
        lambda rng, s, k, c, D, R: _hysteresis(rng, s, k, rng.uniform(0.2, 1.0) * D),
        memory=True,
        strength=(0.02, 0.3),
    ),
    "time_varying_stiffness": Law(
        varying_stiffness,
        lambda rng, s, k, c, D, R: [_signed(rng, s), rng.uniform(8, 40)],
        strength=(0.01, 0.4),
    ),
    "time_varying_damping": Law(
        varying_damping,
        lambda rng, s, k, c, D, R: [_signed(rng, s), rng.uniform(8, 40)],
        strength=(0.03, 0.5),
    ),
    "quadratic_stiffness": Law(
        quadratic_stiffness,
        lambda rng, s, k, c, D, R: [_signed(rng, s * k / D)],
        named=False,
        strength=(0.01, 0.12),
    ),
    "position_dependent_damping": Law(
        position_damping, lambda rng, s, k, c, D, R: [s * c / D**2], named=False, strength=(0.1, 1.5)
    ),
    "force_ripple": Law(
        ripple,
        lambda rng, s, k, c, D, R: [s * k * D, rng.uniform(0.2, 0.5) * D],
        named=False,
        strength=(0.02, 0.2),
    ),
    "one_sided_stop": Law(
        one_sided_stop,
        lambda rng, s, k, c, D, R: [rng.uniform(0.6, 1.5) * D, 12 * s * k],
        named=False,
        known_as="bump_stop",
        strength=(0.02, 0.4),
    ),
    "saturating_spring": Law(
        saturating, lambda rng, s, k, c, D, R: [rng.uniform(0.4, 1.2) * D, s], named=False, strength=(0.03, 0.3)
    ),
    "rate_dependent_stiffness": Law(
        speed_stiffness, lambda rng, s, k, c, D, R: [s * k / R], named=False, strength=(0.03, 0.4)
    ),
}

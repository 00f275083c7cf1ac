"""Physics without a name: static forces over deflection and rate that no law of the catalogue has.

Two kinds of trial.  Small ones, of one or two terms, find a weak effect that is smooth; a wide one, of all low
products of deflection and rate, judges whether a named law leaves something out at its element.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from sprung.model.laws import ElementLaw, Motion, Observed, ParameterSpec, SpringDamper
from sprung.model.laws.base import RARE, Values
from sprung.model.signals import FloatArray

UNKNOWN = "unknown"
_Basis = Callable[[FloatArray, FloatArray], list[FloatArray]]  # of normalised deflection and rate


def _wide(x: FloatArray, y: FloatArray) -> list[FloatArray]:
    size_x, size_y, xx, xy, yy = np.abs(x), np.abs(y), x * x, x * y, y * y
    cubes = [yy * y, x * yy, xx * y, xx * x]
    fourths = [yy * yy, x * cubes[0], xx * yy, xx * xy, xx * xx]
    return [yy, xy, xx, *cubes, *fourths, x * size_y, y * size_x, x * size_x, y * size_y, size_x, size_y]


SMALL: dict[str, _Basis] = {
    "d^2": lambda x, y: [x**2],
    "d v": lambda x, y: [x * y],
    "d^2 v": lambda x, y: [x**2 * y],
    "d v^2": lambda x, y: [x * y**2],
    "d |v|": lambda x, y: [x * np.abs(y)],
    "|d| v": lambda x, y: [np.abs(x) * y],
}
_OTHERS = 8  # trials that are as likely before a recording as every small one: ripples and the map
RIPPLES = (1.5, 2.2, 3.0, 4.0, 5.5, 7.5, 10.0)  # periods of a force ripple per 2 pi rms deflections


def _ripple(wave: float) -> _Basis:
    return lambda x, y: [np.sin(wave * x), np.cos(wave * x) - 1]  # nothing at rest


def trials() -> dict[str, _Basis]:
    """Every basis that is tried, by name."""
    ripples: dict[str, _Basis] = {f"ripple {wave:g}": _ripple(wave) for wave in RIPPLES}
    return {**SMALL, **ripples, "map": _wide}


@dataclass(frozen=True)
class StaticLaw(ElementLaw):
    """A sum of known functions of deflection and rate."""

    basis: _Basis = _wide
    scale_d: float = 1.0  # m
    scale_v: float = 1.0  # m/s

    def values(self, deflection: FloatArray, rate: FloatArray) -> list[FloatArray]:
        """The functions along a motion."""
        return self.basis(np.asarray(deflection) / self.scale_d, np.asarray(rate) / self.scale_v)


def static_law(basis: _Basis, seen: Observed) -> StaticLaw:
    """A law that is linear in its parameters, which are forces in newtons at the rms deflection and rate."""
    scale_d, scale_v = max(seen.deflection_rms, 1e-12), max(seen.rate_rms, 1e-12)
    count = len(basis(np.zeros(1), np.zeros(1)))
    size = max(seen.stiffness * scale_d, seen.damping * scale_v, 1e-12)

    def force(motion: Motion, p: Values, element: SpringDamper) -> FloatArray:
        values = basis(np.asarray(motion.deflection) / scale_d, np.asarray(motion.rate) / scale_v)
        return np.asarray(sum(weight * value for weight, value in zip(p, values, strict=True)))

    return StaticLaw(
        name=UNKNOWN,
        title="a force that no law of the catalogue explains",
        parameters=tuple(
            ParameterSpec(f"w{i}", "N", -1e12, 1e12, "weight of one basis function", lambda s: 0.1 * size)
            for i in range(count)
        ),
        force=force,
        shapes=lambda s: np.full((1, count), 0.1 * size),
        absent=(0.0,) * count,
        looks_like="a residual force that is a function of deflection and rate, of no named kind",
        confused_with=(),
        sentence="a force that no law of the catalogue explains",
        prior_cost=RARE + 2 * float(np.log(len(SMALL) + _OTHERS)),
        named=False,
        listed=False,
        basis=basis,
        scale_d=scale_d,
        scale_v=scale_v,
    )

"""The memory of the Bouc-Wen law along a whole deflection, from reversal to reversal."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from sprung.model.signals import FloatArray, IntArray

# Of the Bouc-Wen law as it is commonly written, z' = v - beta (abs(v) abs(z)^(n-1) z + gamma v abs(z)^n)
GAMMA = 0.5
_FAR, _BLOWS = 60.0, 1.5  # ends of the growing functions


@dataclass(frozen=True)
class Stretches:
    """A deflection (T,) from reversal to reversal: along each stretch a rate-independent memory has a closed form."""

    lengths: FloatArray  # way from reversal to reversal, m, (R,)
    signs: FloatArray  # direction of every stretch, +-1, (R,)
    stretch: IntArray  # that every sample but the first ends in, (T - 1,)
    way: FloatArray  # from the stretch's begin to every sample but the first, m, (T - 1,)

    @classmethod
    def of(cls, deflection: FloatArray) -> Stretches:
        """Where it stands still it goes on in one direction."""
        signs = np.sign(np.diff(deflection))
        signs[signs == 0] = 1.0
        turns = np.flatnonzero(signs[1:] != signs[:-1]) + 1
        starts, ends = np.concatenate([[0], turns]), np.concatenate([turns, [len(signs)]])
        stretch = np.repeat(np.arange(len(starts)), ends - starts)
        way = np.abs(deflection[1:] - deflection[starts][stretch])
        return cls(np.abs(deflection[ends] - deflection[starts]), signs[starts], stretch, way)

    def begins(self, ahead: Callable[[float, float], float]) -> FloatArray:
        """Values at the begin of every stretch, in its direction, from 0; `ahead(value, way)`: after a way. (R,)."""
        found, value, before = [], 0.0, 1.0
        for length, sign in zip(self.lengths.tolist(), self.signs.tolist(), strict=True):
            found.append(value if sign == before else -value)
            value, before = ahead(found[-1], length), sign
        return np.array(found)

    def path(self, ahead: FloatArray) -> FloatArray:
        """Values (T,) from those in the direction of every stretch, (T - 1,); 0 at first."""
        return np.concatenate([[0.0], self.signs[self.stretch] * ahead])


def bouc_wen_memory(deflection: FloatArray, beta: float, exponent: float, gamma: float = GAMMA) -> FloatArray:
    """z of the Bouc-Wen law along a deflection (T,), from z = 0; rate independent.

    Between two reversals of the motion, with x the way travelled and u = z in the direction of travel,
    dx = du / (1 - a u^n) for u > 0, a = beta (1 + gamma), and du / (1 + b |u|^n) for u < 0, b = beta (1 - gamma).
    So one function of u, the way X(u), and its inverse carry z from any reversal to the next.
    """
    ahead, behind = _Side(beta * (1 + gamma), exponent), _Side(beta * (gamma - 1), exponent)
    runs = Stretches.of(deflection)
    position = np.array(_ways(ahead, behind, runs.lengths))[runs.stretch] + runs.way
    onward, z = position > 0, np.empty_like(position)
    z[onward] = ahead.along(position[onward])
    z[~onward] = -behind.along(-position[~onward])
    return runs.path(z)


def _ways(ahead: _Side, behind: _Side, lengths: FloatArray) -> list[float]:
    """The way X at which every monotone stretch begins: minus the z at which the one before ended."""
    ways = []
    u, a, b = 0.0, ahead.unit, behind.unit
    for length in lengths.tolist():
        start = a * ahead.way(u / a) if u > 0 else -b * behind.way(-u / b)
        ways.append(start)
        end = start + length
        u = -a * ahead.back(end / a) if end > 0 else b * behind.back(-end / b)
    return ways


class _Side:
    """The way X(u) = integral du / (1 - a u^n) for u >= 0 and its inverse: of one float, and of arrays.

    In units of |a|^(-1/n) it is one of two functions of n: towards saturation for a > 0, growing for a < 0.
    `way` and `back` take and return numbers in those units.
    """

    def __init__(self, a: float, exponent: float) -> None:
        self.unit = max(abs(a), 1e-12) ** (-1 / exponent)
        self.way, self.back, self._along = _functions(exponent, a > 0)

    def along(self, x: FloatArray) -> FloatArray:
        """u after ways x."""
        found: FloatArray = self.unit * self._along(np.maximum(x, 0) / self.unit)
        return found


@lru_cache(maxsize=64)
def _functions(
    exponent: float, saturates: bool
) -> tuple[Callable[[float], float], Callable[[float], float], Callable[[FloatArray], FloatArray]]:
    """X(u), its inverse, and that of arrays, for dX = du / (1 - u^n) or du / (1 + u^n), u >= 0."""
    if exponent == 1.0 and saturates:
        return lambda u: -math.log(max(1 - u, 1e-12)), lambda x: -math.expm1(-x), lambda x: -np.expm1(-x)
    if exponent == 1.0:
        return math.log1p, lambda x: math.expm1(min(x, _FAR)), lambda x: np.expm1(np.minimum(x, _FAR))
    if exponent == 2.0 and saturates:
        return lambda u: math.atanh(min(u, 1 - 1e-15)), math.tanh, np.tanh
    if exponent == 2.0:
        return math.atan, lambda x: math.tan(min(x, _BLOWS)), lambda x: np.tan(np.minimum(x, _BLOWS))
    u, way = _table(exponent, saturates)
    us, ways = u.tolist(), way.tolist()
    return _interpolation(us, ways), _interpolation(ways, us), lambda x: np.interp(x, way, u)


def _interpolation(x: list[float], y: list[float]) -> Callable[[float], float]:
    """Linear interpolation of one number; quicker than through arrays.  Where x stands still, the last y."""
    last = len(x) - 1

    def between(value: float) -> float:
        i = bisect_right(x, value, 1, last)
        begin, low = x[i - 1], y[i - 1]
        width = x[i] - begin
        share = (value - begin) / width if width > 0 else 1.0
        if share < 0:  # called for every reversal: comparisons, since min and max take as long as all the rest
            share = 0.0
        elif share > 1:
            share = 1.0
        return low + share * (y[i] - low)

    return between


def _table(exponent: float, saturates: bool) -> tuple[FloatArray, FloatArray]:
    """X(u) on a fine grid, by the trapezoidal rule in a variable that resolves the approach to u = 1."""
    if saturates:
        u = -np.expm1(-np.linspace(0, 25, 6000))
        slope = 1 / np.maximum(1 - u**exponent, 1e-14)
    else:
        u = np.concatenate([np.linspace(0, 3, 3000), np.geomspace(3, 1e3, 1000)[1:]])
        slope = 1 / (1 + u**exponent)
    return u, np.concatenate([[0.0], np.cumsum(np.diff(u) * (slope[1:] + slope[:-1]) / 2)])

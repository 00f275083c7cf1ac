"""Forces of laws along whole trajectories, fast: memoryless laws in one call, Bouc-Wen from reversal to reversal."""

from __future__ import annotations

import math
from bisect import bisect_right
from functools import lru_cache

import numpy as np

from model.diagnosis.catalogue import CLOCK_LEAD, ElementLaw, Motion, SpringDamper
from model.diagnosis.catalogue.trajectory import along
from model.signals import FloatArray

_ROOT3 = math.sqrt(3.0)


def force_along(
    law: ElementLaw,
    parameters: tuple[float, ...],
    deflection: FloatArray,
    rate: FloatArray,
    time: FloatArray,
    element: SpringDamper,
) -> FloatArray:
    """Force of a law, N, along deflection and rate (T,) at times (T,) in s since the start of the recording."""
    if law.memory == 0:
        return np.asarray(law.force(Motion(deflection, rate, time + CLOCK_LEAD), parameters, element))
    if law.name == "bouc_wen":
        alpha, beta, exponent = parameters
        return alpha * bouc_wen_memory(deflection, beta, exponent)
    step = time[1] - time[0]
    return along(law, parameters, deflection, rate, sample_rate=1 / step, element=element, start=time[0] + CLOCK_LEAD)


def bouc_wen_memory(deflection: FloatArray, beta: float, exponent: float) -> FloatArray:
    """z of the Bouc-Wen law along a deflection (T,), from z = 0; rate independent.

    Between two reversals of the motion, with x the way travelled and u = z / z_max in the direction of travel,
    z_max^n = 1 / (1.5 beta):  dx = z_max du / (1 - u^n) for u > 0 and z_max du / (1 + |u|^n / 3) for u < 0.
    So one function of u, X(u), and its inverse carry z from any reversal to the next.
    """
    limit = (1 / (1.5 * beta)) ** (1 / exponent)
    way, back = _travel(exponent)
    steps = np.diff(deflection)
    direction = np.sign(steps)
    direction[direction == 0] = 1.0
    turns = np.flatnonzero(direction[1:] != direction[:-1]) + 1
    starts = np.concatenate([[0], turns])  # first step of every monotone stretch
    ends = np.concatenate([turns, [len(steps)]])
    signs = direction[starts]
    travelled = np.abs(deflection[ends] - deflection[starts]) / limit
    begin = np.empty(len(starts))
    u = 0.0
    for i in range(len(starts)):
        begin[i] = way(signs[i] * u)
        u = signs[i] * back(begin[i] + travelled[i])
    stretch = np.repeat(np.arange(len(starts)), ends - starts)
    position = begin[stretch] + np.abs(deflection[1:] - deflection[starts][stretch]) / limit
    z = np.zeros_like(deflection)
    z[1:] = signs[stretch] * _inverse(position, exponent) * limit
    return z


def _travel(exponent: float):
    """X(u) and its inverse as functions of one float."""
    if exponent == 1.0:

        def way(u: float) -> float:
            return -math.log(max(1 - u, 1e-12)) if u > 0 else -3 * math.log1p(-u / 3)

        def back(x: float) -> float:
            return -math.expm1(-x) if x > 0 else -3 * math.expm1(-x / 3)

        return way, back
    if exponent == 2.0:

        def square_way(u: float) -> float:
            return math.atanh(min(u, 1 - 1e-15)) if u > 0 else _ROOT3 * math.atan(u / _ROOT3)

        def square_back(x: float) -> float:
            return math.tanh(x) if x > 0 else _ROOT3 * math.tan(max(x / _ROOT3, -1.5))

        return square_way, square_back
    u, x = (list(column) for column in _table(exponent))

    def tabled_way(value: float) -> float:
        return _between(value, u, x)

    def tabled_back(value: float) -> float:
        return _between(value, x, u)

    return tabled_way, tabled_back


def _between(value: float, x: list[float], y: list[float]) -> float:
    """Linear interpolation of one number; quicker than through arrays."""
    i = min(max(bisect_right(x, value), 1), len(x) - 1)
    share = (value - x[i - 1]) / (x[i] - x[i - 1])
    return y[i - 1] + min(max(share, 0.0), 1.0) * (y[i] - y[i - 1])


def _inverse(x: FloatArray, exponent: float) -> FloatArray:
    if exponent == 1.0:
        return np.where(x > 0, -np.expm1(-np.maximum(x, 0)), -3 * np.expm1(-np.minimum(x, 0) / 3))
    if exponent == 2.0:
        return np.where(x > 0, np.tanh(x), _ROOT3 * np.tan(np.clip(x / _ROOT3, -1.5, 0)))
    u, table = _table(exponent)
    return np.interp(x, table, u)


@lru_cache(maxsize=8)
def _table(exponent: float) -> tuple[FloatArray, FloatArray]:
    """X(u) on a fine grid, by the trapezoidal rule in a variable that resolves the approach to u = 1."""
    approach = -np.expm1(-np.linspace(0, 25, 6000))
    rising = _cumulative(approach, 1 / np.maximum(1 - approach**exponent, 1e-14))
    falling_u = np.linspace(0, 1, 2000)
    falling = _cumulative(falling_u, 1 / (1 + falling_u**exponent / 3))
    u = np.concatenate([-falling_u[:0:-1], approach])
    return u, np.concatenate([-falling[:0:-1], rising])


def _cumulative(x: FloatArray, y: FloatArray) -> FloatArray:
    return np.concatenate([[0.0], np.cumsum(np.diff(x) * (y[1:] + y[:-1]) / 2)])

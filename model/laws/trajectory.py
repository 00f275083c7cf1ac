"""The force of a law along a motion that is already known: for screening, pictures and tests."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from sprung.model.laws.base import ElementLaw, Values
from sprung.model.laws.motion import CLOCK_LEAD, Motion, SpringDamper
from sprung.model.signals import FloatArray

_At = tuple[FloatArray, FloatArray, float]  # deflection, rate, time
_Rate = Callable[[int, FloatArray], FloatArray]  # of a sample, and the states there
_SERIES = 0.5  # below this the recursion for phi loses digits and the power series takes over


def phi(x: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """phi_0 = exp, phi_1, phi_2, phi_3 of real numbers (...): phi_l(x) = x phi_{l+1}(x) + 1/l!."""
    x = np.asarray(x, dtype=float)
    small = np.abs(x) < _SERIES
    safe = np.where(small, 1.0, x)
    one = np.expm1(safe) / safe
    two = (one - 1) / safe
    three = (two - 0.5) / safe
    series = np.zeros_like(x)
    y = np.where(small, x, 0.0)
    for k in range(14, -1, -1):
        series = series * y + 1 / math.factorial(k + 3)
    three = np.where(small, series, three)
    two = np.where(small, y * series + 0.5, two)
    one = np.where(small, y * two + 1, one)
    return np.exp(x), one, two, three


def along(
    law: ElementLaw,
    p: Values,
    deflection: FloatArray,
    rate: FloatArray,
    *,
    sample_rate: float,
    element: SpringDamper,
    start: float = CLOCK_LEAD,
) -> FloatArray:
    """Force that the law adds, N, along deflection and rate of shape (..., T).

    Every entry of `p` and of `element` broadcasts with the leading axes: give p = (gaps[:, None], ...) for many
    trials at once.  `start` is the laws' clock at the first sample.  Memories start as
    the law says (`memory_start`).
    """
    T = np.shape(deflection)[-1]
    time = start + np.arange(T) / sample_rate
    memory = recall(law, p, deflection, rate, time=time, element=element) if law.memory else ()
    return np.asarray(law.force(Motion(deflection, rate, time, memory), p, element))


def recall(
    law: ElementLaw,
    p: Values,
    deflection: FloatArray,
    rate: FloatArray,
    *,
    time: FloatArray,
    element: SpringDamper,
    first: FloatArray | None = None,
) -> FloatArray:
    """The law's own states, shape (memory, ..., T): ETDRK4 (Cox and Matthews 2002), one step per sample.

    Between samples the deflection is the cubic through its values and rates.  first: states at the first sample,
    (memory, ...), as the law says if left out.
    """
    h = time[1] - time[0]
    p = tuple(_column(value) for value in p)
    element = SpringDamper(_column(element.stiffness), _column(element.damping))
    shape = np.broadcast_shapes(np.shape(deflection)[:-1], *[np.shape(v) for v in (*p, *element)])
    if law.memory == 1:  # decays of several states need the shape of their values
        p, element = tuple(_number(value) for value in p), SpringDamper(*(_number(value) for value in element))
    d = np.moveaxis(np.broadcast_to(deflection, (*shape, len(time))), -1, 0)
    v = np.moveaxis(np.broadcast_to(rate, (*shape, len(time))), -1, 0)
    d_half = 0.5 * (d[1:] + d[:-1]) + h / 8 * (v[:-1] - v[1:])
    v_half = 1.5 / h * (d[1:] - d[:-1]) - 0.25 * (v[:-1] + v[1:])
    step = MemoryStep(law, p, element, h)
    path = np.zeros((len(time), law.memory, *shape))
    path[0] = law.memory_start(Motion(d[0], v[0], time[0]), p, element) if first is None else first
    if law.memory_rates and not law.memory_decay:
        node, half = law.memory_rates(Motion(d, v, time), p), law.memory_rates(Motion(d_half, v_half, time[1:]), p)
        return np.moveaxis(_runge_kutta(path, node, half, h), 0, -1)
    if law.memory_decay:
        clock = time.reshape(-1, *(1 for _ in shape))
        between = Motion(d_half, v_half, clock[:-1] + h / 2)
        return np.moveaxis(step.decayed(path, Motion(d, v, clock), between), 0, -1)
    for i in range(len(time) - 1):
        t = float(time[i])
        middle = d_half[i], v_half[i], t + h / 2
        path[i + 1] = step.advance(path[i], (d[i], v[i], t), middle, (d[i + 1], v[i + 1], t + h))
    return np.moveaxis(path, 0, -1)


def _runge_kutta(path: FloatArray, node: _Rate, half: _Rate, h: float) -> FloatArray:
    """States (T, memory, ...) from the first on, by the classical method with one step per sample.

    node, half: rates of the states (memory, ...) at a sample, and in the middle of the step that begins there.
    """
    with np.errstate(over="ignore", invalid="ignore"):  # values of a trial may run away: the path then is not finite
        for i in range(len(path) - 1):
            z = path[i]
            n0 = node(i, z)
            na = half(i, z + h / 2 * n0)
            nb = half(i, z + h / 2 * na)
            path[i + 1] = z + h / 6 * (n0 + 2 * (na + nb) + node(i + 1, z + h * nb))
    return path


class MemoryStep:
    """Coefficients of ETDRK4 for z' = -decay z + source(z, motion) with step h; z is (memory, ...), ... as in p."""

    def __init__(self, law: ElementLaw, p: Values, element: SpringDamper, h: float) -> None:
        self.law, self.p, self.element = law, p, element
        self.decay: Any = law.memory_decay(p, element) if law.memory_decay else 0.0
        self.full, one, two, three = phi(-np.asarray(self.decay) * h)
        self.half, half_one, *_ = phi(-np.asarray(self.decay) * h / 2)
        self.q = h / 2 * half_one
        self.f1 = h * (one - 3 * two + 4 * three)
        self.f2 = 2 * h * (two - 2 * three)
        self.f3 = h * (4 * three - two)
        self.h = h

    def advance(self, z: FloatArray, begin: _At, middle: _At, end: _At) -> FloatArray:
        """The states after a step from z; the motion at its begin, in the middle and at its end."""
        n0 = self.source(*begin, z)
        if not self.law.memory_decay:  # what ETDRK4 is without decay: Runge and Kutta's method
            na = self.source(*middle, z + self.h / 2 * n0)
            nb = self.source(*middle, z + self.h / 2 * na)
            return z + self.h / 6 * (n0 + 2 * (na + nb) + self.source(*end, z + self.h * nb))
        a = self.half * z + self.q * n0
        na = self.source(*middle, a)
        nb = self.source(*middle, self.half * z + self.q * na)
        nc = self.source(*end, self.half * a + self.q * (2 * nb - n0))
        return self.full * z + self.f1 * n0 + self.f2 * (na + nb) + self.f3 * nc

    def decayed(self, path: FloatArray, ends: Motion, middle: Motion) -> FloatArray:
        """`advance` along a whole motion of a law whose states decay: `path` (T, memory, ...) from its first entry.

        ends: the motion at every sample, (T, ...); middle: between them, (T-1, ...).  What drives such states does not
        depend on them (`ElementLaw.memory_decay`), so that it is known for all steps at once.
        """
        lanes = path.shape[2:]
        none = np.zeros((self.law.memory, *(1 for _ in path.shape[1:])))
        at_ends, between = (
            np.broadcast_to(
                self.law.memory_rate(motion._replace(memory=none), self.p, self.element),
                (self.law.memory, len(motion.time), *lanes),
            ).swapaxes(0, 1)
            for motion in (ends, middle)
        )
        push = self.f1 * at_ends[:-1] + 2 * self.f2 * between + self.f3 * at_ends[1:]
        for i, added in enumerate(push):
            np.multiply(self.full, path[i], out=path[i + 1])
            path[i + 1] += added
        return path

    def source(self, d: FloatArray, v: FloatArray, t: float | FloatArray, z: FloatArray) -> FloatArray:
        found: FloatArray = self.law.memory_rate(Motion(d, v, t, z), self.p, self.element)
        return found + self.decay * z if self.law.memory_decay else found


def _column(value: Any) -> Any:
    """A parameter that broadcasts with (..., T), without the axis of samples."""
    array = np.asarray(value, dtype=float)
    return array[..., 0] if array.ndim else array


def _number(value: FloatArray) -> Any:
    """One number where all are the same: its powers are quick."""
    return float(value.flat[0]) if value.size and (value == value.flat[0]).all() else value

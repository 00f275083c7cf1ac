"""Batched integration of law forces acting on a linear system: ETDRK4 (Cox and Matthews 2002).

    x' = A x + b f(y, z, t),   y = y_known(t) + R x,   z' = memory_rate(y, z, t)

The linear part is exact; only the force is integrated.  R are the deflections and rates of the L sites where laws
act, y_known what the measured inputs alone do there.  The stages need no full states, only y: one product with the
state per step gives all of them.  W independent runs (variants x segments) advance together.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.linalg

from sprung.model.laws.base import ElementLaw, Values
from sprung.model.laws.motion import Motion, SpringDamper
from sprung.model.laws.trajectory import MemoryStep
from sprung.model.signals import FloatArray


@dataclass(frozen=True, slots=True)
class Site:
    """One place where a law acts, with the values of each of the W runs (scalars or (W,))."""

    law: ElementLaw
    p: Values
    element: SpringDamper


@dataclass(frozen=True, slots=True)
class ForceSteps:
    """Coefficients of one step h for all L sites together."""

    h: float
    whole: FloatArray  # (N + 6L, N): the state, then y now, at half and at full step, by the state alone
    half_gain: FloatArray  # (2L, L): y at half step by a force held since its start
    cross_gain: FloatArray  # (2L, L): y at full step by a force held in the first half
    gain: FloatArray  # (N, 4L): the state by the four stage forces

    @property
    def size(self) -> int:
        return len(self.gain)


def force_steps(A: FloatArray, b: FloatArray, rows: FloatArray, h: float) -> ForceSteps:
    """Coefficients for A (N, N), force columns b (N, L) and outputs rows (2L, N): deflections, then rates."""
    N, L = b.shape
    E, one, two, three = _phi_times(A * h, b)
    half, half_one, *_ = _phi_times(A * (h / 2), b)
    held = h / 2 * half_one
    gain = np.hstack([h * (one - 3 * two + 4 * three), *[2 * h * (two - 2 * three)] * 2, h * (4 * three - two)])
    whole = np.vstack([E, rows, rows @ half, rows @ E])
    return ForceSteps(h, whole, rows @ held, rows @ half @ held, np.ascontiguousarray(gain.reshape(N, 4 * L)))


def _phi_times(Ah: FloatArray, b: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """exp(Ah), and phi_1 b, phi_2 b, phi_3 b from one exponential (Al-Mohy and Higham 2011)."""
    N, L = b.shape
    whole = np.zeros((N + 3 * L, N + 3 * L))
    whole[:N, :N] = Ah
    whole[:N, N : N + L] = b
    whole[N : N + L, N + L : N + 2 * L] = np.eye(L)
    whole[N + L : N + 2 * L, N + 2 * L :] = np.eye(L)
    result = scipy.linalg.expm(whole)[:N]
    return result[:, :N], result[:, N : N + L], result[:, N + L : N + 2 * L], result[:, N + 2 * L :]


@dataclass(frozen=True, slots=True)
class March:
    """What a run over Q samples left behind."""

    states: FloatArray  # at the samples, (Q + 1, N, W)
    motion: FloatArray  # deflections and rates at the start of every step, (Q parts, 2L, W)
    forces: FloatArray  # there, (Q parts, L, W)
    memories: list[FloatArray]  # per site, there and at the end, (Q parts + 1, memory, W)


def march(
    steps: ForceSteps,
    sites: Sequence[Site],
    known: FloatArray,
    *,
    parts: int,
    x0: FloatArray,
    z0: Sequence[FloatArray],
    start: FloatArray,
) -> March:
    """Advance W runs over known (2 Q parts + 1, 2L, W): y by the inputs at every step and half step.

    x0 (N, W); z0 per site (memory, W); start (W,) clock of the laws, s.
    """
    L, N, h = len(sites), steps.size, steps.h
    Q, W = (len(known) - 1) // (2 * parts), x0.shape[1]
    states, motion, forces = np.empty((Q + 1, N, W)), np.empty((Q * parts, 2 * L, W)), np.empty((Q * parts, L, W))
    memories = [np.empty((Q * parts + 1, site.law.memory, W)) for site in sites]
    memory_steps = [_memory_step(site, h) if site.law.memory else None for site in sites]
    x, z = x0, [np.array(value) for value in z0]
    timed = start
    stage = np.empty((4, L, W))
    flat = stage.reshape(4 * L, W)
    for i in range(Q * parts):
        if i % parts == 0:
            states[i // parts] = x
            timed = start + i * h
        for store, value in zip(memories, z, strict=True):
            store[i] = value
        t = timed + (i % parts) * h
        free = steps.whole @ x
        now, half, full = (free[N + 2 * L * k : N + 2 * L * (k + 1)] for k in range(3))
        now += known[2 * i]
        half += known[2 * i + 1]
        full += known[2 * i + 2]
        stepping = [_Memory(step, value) if step else None for step, value in zip(memory_steps, z, strict=True)]
        _stage(sites, stepping, now, t, stage[0])
        _stage(sites, stepping, half + steps.half_gain @ stage[0], t + h / 2, stage[1])
        _stage(sites, stepping, half + steps.half_gain @ stage[1], t + h / 2, stage[2])
        last = full + steps.cross_gain @ stage[0] + steps.half_gain @ (2 * stage[2] - stage[0])
        _stage(sites, stepping, last, t + h, stage[3])
        motion[i], forces[i] = now, stage[0]
        x = free[:N] + steps.gain @ flat
        z = [memory.end() if memory else value for memory, value in zip(stepping, z, strict=True)]
    states[Q] = x
    for store, value in zip(memories, z, strict=True):
        store[-1] = value
    return March(states, motion, forces, memories)


def _memory_step(site: Site, h: float) -> MemoryStep:
    """The same values for all runs."""
    return MemoryStep(site.law, tuple(np.atleast_1d(value) for value in site.p), site.element, h)


class _Memory:
    """The stages of one site's memory within one step."""

    def __init__(self, step: MemoryStep, z: FloatArray) -> None:
        self.step, self.z = step, z
        self.sources: list[FloatArray] = []
        self.stages: list[FloatArray] = []

    def at_stage(self, d: FloatArray, v: FloatArray, t: FloatArray) -> FloatArray:
        """State of the memory at the next stage; remembers its source."""
        step, done = self.step, len(self.sources)
        if done == 0:
            z = self.z
        elif done == 3:
            z = step.half * self.stages[1] + step.q * (2 * self.sources[2] - self.sources[0])
        else:
            z = step.half * self.z + step.q * self.sources[done - 1]
        self.stages.append(z)
        self.sources.append(step.source(d, v, t, z))
        return z

    def end(self) -> FloatArray:
        step, (n0, na, nb, nc) = self.step, self.sources
        return step.full * self.z + step.f1 * n0 + step.f2 * (na + nb) + step.f3 * nc


def _stage(
    sites: Sequence[Site], stepping: Sequence[_Memory | None], y: FloatArray, t: FloatArray, out: FloatArray
) -> None:
    """Forces of all sites at outputs y (2L, W) into out (L, W)."""
    L = len(sites)
    for i, (site, memory) in enumerate(zip(sites, stepping, strict=True)):
        d, v = y[i], y[L + i]
        z = memory.at_stage(d, v, t) if memory else ()
        out[i] = site.law.force(Motion(d, v, t, z), site.p, site.element)

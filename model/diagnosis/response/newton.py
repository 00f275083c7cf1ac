"""Newton's steps for laws that shape their own motion strongly, such as stops that are hit again and again.

A force's change answers itself through the plant: with slopes s of the laws over deflection and rate,

    change = s motion(change) + what is missing,

a linear system that varies over time.  It is marched step by step, the force linear in between; before its beginning a
periodic motion was what it is before its end.  The iteration around whole trajectories then needs only what the two
ways to simulate differ by.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.linalg import expm

from sprung.model.diagnosis.record.spectra import OVERSAMPLING
from sprung.model.diagnosis.response.harmonic_balance import HarmonicBalance
from sprung.model.signals import FloatArray

PATIENCE = 8  # steps in which the error has to halve
_MEMORY = 1.5  # time constants of the slowest mode that a march begins earlier
_STEP = 1e-3  # of a motion's deviation, for the slopes


def newton_step(loop: HarmonicBalance) -> Callable[[FloatArray], FloatArray]:
    """The next forces (4N, m) from the present ones."""
    s, step = loop.plant.structure, loop.grid.step / OVERSAMPLING
    A = s.state_matrix()
    hold = _hold(A, s.force_columns(loop.wide), step)
    memory = _MEMORY / (step * max(float(np.min(-np.linalg.eigvals(A).real)), 1e-9))
    rows = s.motion_rows(loop.wide)  # deflections of the ports, then rates

    def improved(force: FloatArray) -> FloatArray:
        d, v = loop.motion(force)
        present = loop.law(d, v)
        by_d, by_v = _slopes(loop, d, v)
        m = len(loop.terms)
        gains = by_d[:, :, None] * rows[:m] + by_v[:, :, None] * rows[m:]  # force per state, (4N, m, states)
        return force + _answered(hold, gains, present - force, memory)

    return improved


def _slopes(loop: HarmonicBalance, d: FloatArray, v: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Slopes of the laws' forces over deflection and rate along a motion, without the equivalents, 2 x (4N, m).

    Laws with memory have no slope in one instant: for them the equivalent stands.
    """
    instant = np.array([0.0 if term.element_law.memory else 1.0 for term in loop.terms])
    h = _STEP * d.std(axis=0) + 1e-300, _STEP * v.std(axis=0) + 1e-300
    by_d = (loop.law(d + h[0], v) - loop.law(d - h[0], v)) / (2 * h[0])
    by_v = (loop.law(d, v + h[1]) - loop.law(d, v - h[1])) / (2 * h[1])
    return instant * by_d, instant * by_v


def _hold(A: FloatArray, B: FloatArray, step: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Transition of the states over a step, and what forces at its beginning and its end add, linear in between."""
    n, m = B.shape
    block = np.zeros((n + 2 * m, n + 2 * m))
    block[:n, :n], block[:n, n : n + m] = A * step, B * step
    block[n : n + m, n + m :] = np.eye(m)
    found = expm(block)
    end = found[:n, n + m :]
    return found[:n, :n], found[:n, n : n + m] - end, end


def _answered(
    hold: tuple[FloatArray, FloatArray, FloatArray], gains: FloatArray, missing: FloatArray, memory: float
) -> FloatArray:
    """Forces f (T, m) with f = gains x + missing, x the states that f drives, periodic.

    Stretches of the record are marched beside each other, each from so many steps (`memory`) before it.
    """
    transition, begin, end = hold
    inverse = np.linalg.inv(np.eye(len(end.T)) - gains @ end)  # (T, m, m)
    rows, right = inverse @ gains, inverse @ missing[:, :, None]
    total = len(missing)
    before = int(min(np.ceil(memory), total))
    stretches = total // before
    length = -(-total // stretches)
    first = length * np.arange(stretches)
    x, f = np.zeros((len(transition), stretches)), np.zeros((missing.shape[1], stretches))
    result = np.empty_like(missing)
    for k in range(-before, length):
        at = (first + k) % total
        moved = transition @ x + begin @ f
        f = (rows[at] @ moved.T[:, :, None] + right[at])[:, :, 0].T
        x = moved + end @ f
        if k >= 0:
            result[at] = f.T
    return result

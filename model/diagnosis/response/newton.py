"""Newton's method for laws that dominate their own motion, such as stops that are hit repeatedly.

A change of the forces acts on itself through the plant.  With the laws' slopes s over deflection and rate, the Newton
correction of forces f whose defect is  law(motion(f)) - f  solves

    correction = s motion(correction) + defect,

a linear time-varying system with periodic boundary conditions.  It is integrated step by step with a first-order hold
on the forces.  The iteration over whole trajectories then only has to correct the difference between this integration
and the frequency response.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
from scipy.linalg import expm

from sprung.model.diagnosis.record.spectra import OVERSAMPLING
from sprung.model.diagnosis.response.harmonic_balance import HarmonicBalance
from sprung.model.signals import FloatArray

PATIENCE = 8  # steps in which the error has to halve
_RUN_IN = 1.5  # time constants of the slowest mode, integrated before a segment
_STEP = 1e-3  # of a motion's standard deviation, for finite differences
_EVALUATIONS = 30  # of a law, whose cost equals that of one correction
_SEGMENTS = 1e5  # segments times states cubed at which arithmetic costs as much as the calls
_CALLS = 16.0  # cost of a step of all segments over that of composing one, where calls count
_RELATIVE_COST = 2.0  # of a multiple-shooting step over one of single shooting

FirstOrderHold = tuple[
    FloatArray, FloatArray, FloatArray
]  # transition matrix (n, n), and input matrices (n, m) of the force at either end


def newton_step(balance: HarmonicBalance) -> Callable[[FloatArray], FloatArray] | None:
    """Map from forces (4N, m) to their Newton iterate; None where all laws have memory, and therefore no slope."""
    memoryless = [i for i, term in enumerate(balance.terms) if not term.element_law.memory]
    if not memoryless:
        return None
    s, step = balance.plant.structure, balance.grid.step / OVERSAMPLING
    moving = slice(s.moving)  # filters of sensors follow the motion
    A = s.state_matrix()[moving, moving]
    hold = _first_order_hold(A, s.force_columns(balance.wide)[moving], step)
    memory = _RUN_IN / (step * max(float(np.min(-np.linalg.eigvals(A).real)), 1e-9))
    rows = s.motion_rows(balance.wide)[:, moving]  # deflections of the ports, then rates

    def corrected(force: FloatArray) -> FloatArray:
        d, v = balance.motion(force)
        present = balance.law_forces(d, v)
        by_d, by_v = _slopes(balance, memoryless, d, v)
        m = len(balance.terms)
        balance.evaluations += _EVALUATIONS
        gains = by_d[:, :, None] * rows[:m] + by_v[:, :, None] * rows[m:]  # force per state, (4N, m, states)
        return force + periodic_response(hold, gains, present - force, memory)

    return corrected


def _slopes(
    balance: HarmonicBalance, memoryless: list[int], d: FloatArray, v: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Slopes of the laws' forces over deflection and rate along a motion, less the equivalents, each (4N, m).

    Laws with memory have no instantaneous slope; their equivalent linearisation is used instead.
    """
    by_d, by_v = np.zeros_like(d), np.zeros_like(v)
    for i in memoryless:
        force = partial(_moved_force, balance, i, d, v)
        by_d[:, i], by_v[:, i] = central_slopes(force, d[:, i], v[:, i])
    return by_d, by_v


def _moved_force(
    balance: HarmonicBalance, index: int, d: FloatArray, v: FloatArray, by_d: float, by_v: float
) -> FloatArray:
    return balance.law_force(index, d + by_d, v + by_v)


def central_slopes(
    force: Callable[[float, float], FloatArray], deflection: FloatArray, rate: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Slopes of a force over deflection and rate along a motion, each (T,), by central differences.

    force: along the motion with offsets to its deflection and rate, (T,).
    """
    d, v = (_STEP * float(np.std(motion)) + 1e-300 for motion in (deflection, rate))
    return (force(d, 0.0) - force(-d, 0.0)) / (2 * d), (force(0.0, v) - force(0.0, -v)) / (2 * v)


def _first_order_hold(A: FloatArray, B: FloatArray, step: float) -> FirstOrderHold:
    """First-order hold: transition of the states over a step, and the effect of the forces at its two ends."""
    n, m = B.shape
    block = np.zeros((n + 2 * m, n + 2 * m))
    block[:n, :n], block[:n, n : n + m] = A * step, B * step
    block[n : n + m, n + m :] = np.eye(m)
    found = expm(block)
    end = found[:n, n + m :]
    return found[:n, :n], found[:n, n : n + m] - end, end


def periodic_response(hold: FirstOrderHold, gains: FloatArray, defect: FloatArray, memory: float) -> FloatArray:
    """Forces f (T, m) with f = gains x + defect, where x are the states (T, n) of the periodic response to f.

    gains: (T, m, n); defect: (T, m).  Segments of the record are integrated in parallel: each from rest, `memory`
    steps before it begins, or, where that costs more, by multiple shooting.
    """
    total, states = len(defect), len(hold[0])
    before = int(min(np.ceil(memory), total))
    count = int(np.clip(min(_SEGMENTS / states**3, np.sqrt(_CALLS * total)), 4, total // 4))
    inverse = np.linalg.inv(np.eye(defect.shape[1]) - gains @ hold[2])  # (T, m, m)
    rows, right = inverse @ gains, (inverse @ defect[:, :, None])[:, :, 0]
    with np.errstate(all="ignore"):  # diverging corrections are rejected by the caller
        if _RELATIVE_COST * total < before * count:
            return _multiple_shooting(hold, gains, defect, (rows, right), count)
        return _integrated_from_rest(hold, (rows, right), before)


def _integrated_from_rest(hold: FirstOrderHold, solved: tuple[FloatArray, FloatArray], before: int) -> FloatArray:
    """Segments integrated from rest, beginning `before` steps ahead of each."""
    transition, begin, end = hold
    rows, right = solved
    total = len(right)
    segments = total // before
    length = -(-total // segments)
    first = length * np.arange(segments)
    x, f = np.zeros((len(transition), segments)), np.zeros((right.shape[1], segments))
    result = np.empty_like(right)
    for k in range(-before, length):
        at = (first + k) % total
        moved = transition @ x + begin @ f
        f = (rows[at] @ moved.T[:, :, None])[:, :, 0].T + right[at].T
        x = moved + end @ f
        if k >= 0:
            result[at] = f.T
    return result


def _multiple_shooting(
    hold: FirstOrderHold,
    gains: FloatArray,
    defect: FloatArray,
    solved: tuple[FloatArray, FloatArray],
    count: int,
) -> FloatArray:
    """Segments as affine maps of their initial states, x' = P x + r.

    The fixed point of their composition is the periodic initial state; it determines those of all segments.
    """
    transition, begin, end = hold
    rows, right = solved
    total, states = len(right), len(transition)
    length = -(-total // count)
    first = length * np.arange(-(-total // length))

    def advanced(x: FloatArray, k: int) -> tuple[FloatArray, FloatArray]:
        """States (segments, n, columns) one step later, and the forces; the defect acts on the last column only."""
        at = np.minimum(first + k, total - 1)
        f = gains[at - 1] @ x
        f[:, :, -1] += defect[at - 1]
        moved = transition @ x + begin @ f
        f = rows[at] @ moved
        f[:, :, -1] += right[at]
        inside = (first + k < total)[:, None, None]
        return np.where(inside, moved + end @ f, x), f

    maps = np.tile(np.eye(states, states + 1), (len(first), 1, 1))
    for k in range(length):
        maps, _ = advanced(maps, k)
    whole = np.eye(states, states + 1)
    for one in maps:
        whole = one[:, :-1] @ whole
        whole[:, -1] += one[:, -1]
    if not np.all(np.isfinite(whole)):  # no periodic solution
        return np.full_like(right, np.nan)
    x = [np.linalg.lstsq(np.eye(states) - whole[:, :-1], whole[:, -1], rcond=None)[0]]
    for one in maps[:-1]:
        x.append(one[:, :-1] @ x[-1] + one[:, -1])
    now, result = np.array(x)[:, :, None], np.empty((len(first) * length, right.shape[1]))
    for k in range(length):
        now, f = advanced(now, k)
        result[first + k] = f[:, :, 0]
    return result[:total]

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
_MARCH = 30  # rounds of a law that a march takes as long as
_AT_ONCE = 1e5  # stretches times states cubed that take as long as calling for them
_DEARER = 2.0  # times that a step of them from every state takes what one from rest takes

Hold = tuple[FloatArray, FloatArray, FloatArray]  # transition, and what forces at its beginning and its end add


def newton_step(loop: HarmonicBalance) -> Callable[[FloatArray], FloatArray] | None:
    """The next forces (4N, m) from the present ones; None where every law has a memory, and so no slope."""
    instant = [i for i, term in enumerate(loop.terms) if not term.element_law.memory]
    if not instant:
        return None
    s, step = loop.plant.structure, loop.grid.step / OVERSAMPLING
    A = s.state_matrix()
    hold = _hold(A, s.force_columns(loop.wide), step)
    memory = _MEMORY / (step * max(float(np.min(-np.linalg.eigvals(A).real)), 1e-9))
    rows = s.motion_rows(loop.wide)  # deflections of the ports, then rates

    def improved(force: FloatArray) -> FloatArray:
        d, v = loop.motion(force)
        present = loop.law(d, v)
        by_d, by_v = _slopes(loop, instant, d, v)
        m = len(loop.terms)
        loop.rounds += _MARCH
        gains = by_d[:, :, None] * rows[:m] + by_v[:, :, None] * rows[m:]  # force per state, (4N, m, states)
        return force + answered(hold, gains, present - force, memory)

    return improved


def _slopes(loop: HarmonicBalance, instant: list[int], d: FloatArray, v: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Slopes of the laws' forces over deflection and rate along a motion, without the equivalents, 2 x (4N, m).

    Laws with memory have no slope in one instant: for them the equivalent stands.
    """
    by_d, by_v = np.zeros_like(d), np.zeros_like(v)
    h = _STEP * d.std(axis=0) + 1e-300, _STEP * v.std(axis=0) + 1e-300
    for i in instant:
        by_d[:, i] = (loop.law_of(i, d + h[0], v) - loop.law_of(i, d - h[0], v)) / (2 * h[0][i])
        by_v[:, i] = (loop.law_of(i, d, v + h[1]) - loop.law_of(i, d, v - h[1])) / (2 * h[1][i])
    return by_d, by_v


def _hold(A: FloatArray, B: FloatArray, step: float) -> Hold:
    """Transition of the states over a step, and what forces at its beginning and its end add, linear in between."""
    n, m = B.shape
    block = np.zeros((n + 2 * m, n + 2 * m))
    block[:n, :n], block[:n, n : n + m] = A * step, B * step
    block[n : n + m, n + m :] = np.eye(m)
    found = expm(block)
    end = found[:n, n + m :]
    return found[:n, :n], found[:n, n : n + m] - end, end


def answered(hold: Hold, gains: FloatArray, missing: FloatArray, memory: float) -> FloatArray:
    """Forces f (T, m) with f = gains x + missing, x the states that f drives, periodic.

    Stretches of the record are marched beside each other: each from so many steps (`memory`) before it, or, where a
    structure remembers for too long, each from every state at once.
    """
    total, states = len(missing), len(hold[0])
    before = int(min(np.ceil(memory), total))
    many = int(np.clip(_AT_ONCE / states**3, 4, total // 4))
    inverse = np.linalg.inv(np.eye(missing.shape[1]) - gains @ hold[2])  # (T, m, m)
    rows, right = inverse @ gains, (inverse @ missing[:, :, None])[:, :, 0]
    with np.errstate(all="ignore"):  # steps that diverge are not taken
        if _DEARER * total < before * many:
            return _joined(hold, gains, missing, (rows, right), many)
        return _marched(hold, (rows, right), before)


def _marched(hold: Hold, solved: tuple[FloatArray, FloatArray], before: int) -> FloatArray:
    """Stretches from rest, so many steps before each of them."""
    transition, begin, end = hold
    rows, right = solved
    total = len(right)
    stretches = total // before
    length = -(-total // stretches)
    first = length * np.arange(stretches)
    x, f = np.zeros((len(transition), stretches)), np.zeros((right.shape[1], stretches))
    result = np.empty_like(right)
    for k in range(-before, length):
        at = (first + k) % total
        moved = transition @ x + begin @ f
        f = (rows[at] @ moved.T[:, :, None])[:, :, 0].T + right[at].T
        x = moved + end @ f
        if k >= 0:
            result[at] = f.T
    return result


def _joined(
    hold: Hold, gains: FloatArray, missing: FloatArray, solved: tuple[FloatArray, FloatArray], many: int
) -> FloatArray:
    """Stretches from every state at once: each maps the state before it to that at its end, x' = P x + r.

    The maps in a row tell the state that comes back to itself, and with it those before all stretches.
    """
    transition, begin, end = hold
    rows, right = solved
    total, states = len(right), len(transition)
    length = -(-total // many)
    first = length * np.arange(-(-total // length))

    def stepped(x: FloatArray, k: int) -> tuple[FloatArray, FloatArray]:
        """States (stretches, n, columns) a step on, and the forces; the last column alone feels what is missing."""
        at = np.minimum(first + k, total - 1)
        f = gains[at - 1] @ x
        f[:, :, -1] += missing[at - 1]
        moved = transition @ x + begin @ f
        f = rows[at] @ moved
        f[:, :, -1] += right[at]
        inside = (first + k < total)[:, None, None]
        return np.where(inside, moved + end @ f, x), f

    maps = np.tile(np.eye(states, states + 1), (len(first), 1, 1))
    for k in range(length):
        maps, _ = stepped(maps, k)
    whole = np.eye(states, states + 1)
    for one in maps:
        whole = one[:, :-1] @ whole
        whole[:, -1] += one[:, -1]
    if not np.all(np.isfinite(whole)):  # nothing comes back to itself
        return np.full_like(right, np.nan)
    x = [np.linalg.lstsq(np.eye(states) - whole[:, :-1], whole[:, -1], rcond=None)[0]]
    for one in maps[:-1]:
        x.append(one[:, :-1] @ x[-1] + one[:, -1])
    now, result = np.array(x)[:, :, None], np.empty((len(first) * length, right.shape[1]))
    for k in range(length):
        now, f = stepped(now, k)
        result[first + k] = f[:, :, 0]
    return result[:total]

"""All segments of a recording at once: the parallel-in-time iteration around model.simulate.etd.

A segment's first state comes from the sweep before: what the segment before it ended with, plus the linear
propagation of that segment's own correction (parareal, Lions, Maday and Turinici 2001).  Suspensions forget within
seconds, so a few sweeps do; after as many sweeps as there are segments the answer is exact in any case.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sprung.model.laws.motion import Motion
from sprung.model.signals import FloatArray
from sprung.model.simulate.etd import ForceSteps, March, Site, march

_WIDTH = 384  # runs that march together: enough to hide the interpreter, few enough for the cache
_SHORTEST = 50  # samples of a segment
_RUNAWAY = 1e3  # growth of the states since the first sweep at divergence
_PATIENCE, _SHRINKS = 8, 0.5  # sweeps in which the change of the first states has to fall, and to which share
_FEW = 8  # segments that are not worth their sweeps where more of them have not settled


@dataclass(frozen=True, slots=True)
class Solution:
    """The laws' part of V runs at the samples, and the forces at every step."""

    states: FloatArray  # at the samples, (T, N, V)
    motion: FloatArray  # deflections and rates of the sites at every step, inputs included, ((T-1) parts + 1, 2L, V)
    force: FloatArray  # there, ((T-1) parts + 1, L, V)


def solve(
    steps: ForceSteps,
    transition: FloatArray,
    sites: Sequence[Site],
    known: FloatArray,
    *,
    parts: int,
    start: float,
    tolerance: float = 1e-6,
) -> Solution:
    """Law forces of V runs along known ((T-1) 2 parts + 1, 2L, V), from rest of the laws' part.

    `transition` is the linear propagation over one sample; parameters of the sites are scalars or (V,).  The sweeps
    end when no first state moves by more than `tolerance` of its largest value.
    """
    V, samples = known.shape[2], (len(known) - 1) // (2 * parts)
    if not sites:
        none = np.zeros((samples * parts + 1, 0, V))
        return Solution(np.zeros((samples + 1, len(transition), V)), none, none)
    segments = int(np.clip(_WIDTH // V, 1, max(1, samples // _SHORTEST)))
    while True:
        found = _sweeps(steps, transition, sites, known, parts, start, tolerance, segments)
        if found is not None:
            return found
        # hardly damped systems forget too slowly for many segments
        segments = segments // 4 if segments // 4 > _FEW else 1


def _sweeps(
    steps: ForceSteps,
    transition: FloatArray,
    sites: Sequence[Site],
    known: FloatArray,
    parts: int,
    start: float,
    tolerance: float,
    segments: int,
) -> Solution | None:
    """The iteration with so many segments; None: it does not settle."""
    V, samples = known.shape[2], (len(known) - 1) // (2 * parts)
    Q = -(-(samples + 1) // segments)  # one sample more than needed: the last one is inside a segment, too
    segments = -(-(samples + 1) // Q)
    stacked = _stack(known, segments, 2 * parts * Q)
    wide = [_widen(site, segments) for site in sites]
    clocks = np.repeat(start + np.arange(segments) * Q * parts * steps.h, V)
    x, z = _at_rest(wide, stacked[0], clocks, (segments, V, len(transition)))
    over = np.linalg.matrix_power(transition, Q)
    largest: FloatArray | None = None
    changes: list[float] = []
    for sweep in range(1, segments + 1):
        with np.errstate(over="ignore", invalid="ignore"):  # a run away is met below
            done = march(steps, wide, stacked, parts=parts, x0=_flat(x), z0=[_flat(value) for value in z], start=clocks)
        if segments == 1:
            return _join(done, (segments, Q, V, samples), parts)
        size = np.abs(done.states).max(axis=(0, 2))[:, None, None]
        largest = size if largest is None else largest
        if not np.all(size < _RUNAWAY * np.maximum(largest, 1e-300)):
            return None
        moved = _corrections(done.states[-1].reshape(x.shape), x, over)
        change = float(np.max(np.abs(moved) / np.maximum(size, 1e-300)))
        change = max(change, *(_hand_over(path, memory) for path, memory in zip(done.memories, z, strict=True)))
        if change < tolerance or sweep == segments:
            break
        if sweep > _PATIENCE and change > _SHRINKS * changes[-_PATIENCE]:
            return None
        changes.append(change)
        x = x + moved
    return _join(done, (segments, Q, V, samples), parts)


def _corrections(ends: FloatArray, x: FloatArray, over: FloatArray) -> FloatArray:
    """By how much the first states (N, segments, V) must move, given where the segments ended."""
    moved = np.zeros_like(x)
    for s in range(1, x.shape[1]):
        moved[:, s] = ends[:, s - 1] + over @ moved[:, s - 1] - x[:, s]
    return moved


def _hand_over(path: FloatArray, first: FloatArray) -> float:
    """Give every segment the memory that the one before it ended with; the relative change."""
    last = path[-1].reshape(first.shape)
    step = np.abs(last[:, :-1] - first[:, 1:]).max(initial=0.0)
    first[:, 1:] = last[:, :-1]
    return float(step / max(np.abs(path).max(initial=0.0), 1e-300))


def _flat(value: FloatArray) -> FloatArray:
    return value.reshape(value.shape[0], value.shape[1] * value.shape[2])


def _stack(known: FloatArray, segments: int, nodes: int) -> FloatArray:
    """(nodes + 1, 2L, segments V): the segments side by side; the last one is continued by its last value."""
    short = segments * nodes + 1 - len(known)
    if short:
        known = np.concatenate([known, np.broadcast_to(known[-1:], (short, *known.shape[1:]))])
    out = np.empty((nodes + 1, known.shape[1], segments, known.shape[2]))
    for s in range(segments):
        out[:, :, s] = known[s * nodes : (s + 1) * nodes + 1]
    return out.reshape(nodes + 1, known.shape[1], -1)


def _widen(site: Site, segments: int) -> Site:
    def tile(value: FloatArray) -> FloatArray:
        return np.tile(value, segments) if np.ndim(value) else value

    element = type(site.element)(*[tile(value) for value in site.element])
    return Site(site.law, tuple(tile(value) for value in site.p), element)


def _at_rest(
    sites: Sequence[Site], y: FloatArray, clocks: FloatArray, shape: tuple[int, ...]
) -> tuple[FloatArray, list[FloatArray]]:
    """First states (N, segments, V) and memories of every segment, as if the laws began there."""
    segments, V, N = shape
    L = len(sites)
    z = []
    for i, site in enumerate(sites):
        begin = site.law.memory_start(Motion(y[i], y[L + i], clocks), site.p, site.element)
        z.append(np.broadcast_to(begin, (site.law.memory, segments * V)).reshape(site.law.memory, segments, V).copy())
    return np.zeros((N, segments, V)), z


def _join(done: March, shape: tuple[int, ...], parts: int) -> Solution:
    """The segments one after the other, cut to the recording's length."""
    segments, Q, V, samples = shape

    def chain(path: FloatArray, per_segment: int, count: int) -> FloatArray:
        rows = path.shape[1]
        body = path[:per_segment].reshape(per_segment, rows, segments, V).transpose(2, 0, 1, 3)
        return body.reshape(segments * per_segment, rows, V)[:count]

    fine = samples * parts + 1
    return Solution(
        states=chain(done.states, Q, samples + 1),
        motion=chain(done.motion, Q * parts, fine),
        force=chain(done.forces, Q * parts, fine),
    )

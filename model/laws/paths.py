"""Paths of memories along a known motion: exact, from reversal to reversal where they can be."""

from __future__ import annotations

import math

import numpy as np

from sprung.model.laws.reversals import Stretches
from sprung.model.signal_filters import lfilter
from sprung.model.signals import FloatArray


def stop_path(deflection: FloatArray, reach: float, corner: float = 0.0) -> FloatArray:
    """The stop operator u' = d' within +-reach, m, (T,): how far a slider's spring is bent (Krasnoselskii).

    corner: m before `reach` over which it begins to slip, u' = d' (reach - u) / corner while it goes on.
    """
    runs, firm = Stretches.of(deflection), reach - corner

    def ahead(u: float, way: float) -> float:
        if way <= firm - u:
            return u + way
        if corner <= 0:
            return reach
        return reach - (reach - max(u, firm)) * math.exp(-(way - max(firm - u, 0.0)) / corner)

    u = runs.begins(ahead)[runs.stretch]
    slipping = np.full(len(u), reach)
    if corner > 0:
        since = np.maximum(runs.way - np.maximum(firm - u, 0.0), 0.0)
        slipping -= (reach - np.maximum(u, firm)) * np.exp(-since / corner)
    return runs.path(np.where(runs.way <= firm - u, u + runs.way, slipping))


def presliding_path(deflection: FloatArray, reach: float, level: FloatArray | None = None) -> FloatArray:
    """z of  dz = (sign(dx) - z / level) |dx| / reach, (T,): friction over that of sliding.

    Without a level Dahl (1968); with one that depends on the rate, (T,), LuGre.
    """
    if level is None:
        runs = Stretches.of(deflection)
        z = runs.begins(lambda z, way: 1 - (1 - z) * math.exp(-way / reach))[runs.stretch]
        return runs.path(1 - (1 - z) * np.exp(-runs.way / reach))
    ways, middle = np.diff(deflection), 0.5 * (level[1:] + level[:-1])
    keep = np.exp(-np.abs(ways) / (reach * middle))
    towards = np.sign(ways) * middle * (1 - keep)
    return np.concatenate([[0.0], recurrence(keep, towards)])


def recurrence(keep: FloatArray, add: FloatArray) -> FloatArray:
    """x_i = keep_i x_(i - 1) + add_i from 0, (T,), for factors between 0 and 1: steps are joined two by two.

    Hillis and Steele (1986): log2 T passes over arrays instead of T steps.
    """
    factor, found, shift = keep.copy(), add.copy(), 1
    while shift < len(found) and factor[shift:].any():
        found[shift:] += factor[shift:] * found[:-shift]
        factor[shift:] *= factor[:-shift].copy()
        shift *= 2
    return found


def maxwell_path(deflection: FloatArray, time_constant: float, step: float) -> FloatArray:
    """Deflection of the spring of a spring and damper in series, m, (T,): s' = d' - s / time_constant."""
    keep = math.exp(-step / time_constant)
    gain = time_constant / step * (1 - keep)
    found: FloatArray = lfilter([gain], [1.0, -keep], np.diff(deflection, prepend=deflection[:1]))
    return found

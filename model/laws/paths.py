"""Paths of memories along a known motion, stepped exactly from sample to sample."""

from __future__ import annotations

import math

import numpy as np

from sprung.model.signals import FloatArray


def stop_path(deflection: FloatArray, reach: float, corner: float = 0.0) -> FloatArray:
    """The stop operator u' = d' within +-reach, m, (T,): how far a slider's spring is bent (Krasnoselskii).

    corner: m before `reach` over which it begins to slip, u' = d' (reach - u) / corner while it goes on.
    """
    path = np.empty(len(deflection))
    u, path[0], firm = 0.0, 0.0, reach - corner
    for i, way in enumerate(np.diff(deflection).tolist(), 1):
        ahead, size = (u, way) if way > 0 else (-u, -way)
        free = firm - ahead
        if size <= free:
            ahead += size
        elif corner > 0:
            if free > 0:
                ahead, size = firm, size - free
            ahead = reach - (reach - ahead) * math.exp(-size / corner)
        else:
            ahead = reach
        u = ahead if way > 0 else -ahead
        path[i] = u
    return path


def presliding_path(deflection: FloatArray, reach: float, level: FloatArray | None = None) -> FloatArray:
    """z of  dz = (sign(dx) - z / level) |dx| / reach, (T,): friction over that of sliding.

    Without a level Dahl (1968); with one that depends on the rate, (T,), LuGre.
    """
    ways = np.diff(deflection)
    middle = np.ones(len(ways)) if level is None else 0.5 * (level[1:] + level[:-1])
    keep = np.exp(-np.abs(ways) / (reach * middle))
    towards = np.sign(ways) * middle * (1 - keep)
    path = np.empty(len(deflection))
    z, path[0] = 0.0, 0.0
    for i, (a, b) in enumerate(zip(keep.tolist(), towards.tolist(), strict=True), 1):
        z = a * z + b
        path[i] = z
    return path


def maxwell_path(deflection: FloatArray, time_constant: float, step: float) -> FloatArray:
    """Deflection of the spring of a spring and damper in series, m, (T,): s' = d' - s / time_constant."""
    keep = math.exp(-step / time_constant)
    gain = time_constant / step * (1 - keep)
    path = np.empty(len(deflection))
    s, path[0] = 0.0, 0.0
    for i, way in enumerate(np.diff(deflection).tolist(), 1):
        s = keep * s + gain * way
        path[i] = s
    return path

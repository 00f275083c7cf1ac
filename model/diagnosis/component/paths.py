"""Paths of memories along a known motion, each normalised to 1 where it slips or saturates.

All are stepped exactly from sample to sample: rate-independent ones depend on the way only, the Maxwell branch is
linear.
"""

from __future__ import annotations

import math

import numpy as np

from sprung.model.laws.reversals import GAMMA, bouc_wen_memory
from sprung.model.signals import FloatArray


def stop_path(deflection: FloatArray, reach: float) -> FloatArray:
    """The stop operator u' = d' within +-reach, m, (T,): how far a slider's spring is bent (Krasnoselskii)."""
    path = np.empty(len(deflection))
    u, path[0] = 0.0, 0.0
    for i, way in enumerate(np.diff(deflection).tolist(), 1):
        u += way
        u = reach if u > reach else (-reach if u < -reach else u)
        path[i] = u
    return path


def presliding_path(deflection: FloatArray, reach: float, level: FloatArray | None = None) -> FloatArray:
    """z of  dz = (level sign(dx) - z) |dx| / reach  (Dahl 1968; with a level that depends on the rate: LuGre), (T,)."""
    ways = np.diff(deflection)
    keep = np.exp(-np.abs(ways) / reach)
    towards = np.sign(ways) * (1 - keep)
    if level is not None:
        towards = towards * 0.5 * (level[1:] + level[:-1])
    path = np.empty(len(deflection))
    z, path[0] = 0.0, 0.0
    for i, (a, b) in enumerate(zip(keep.tolist(), towards.tolist(), strict=True), 1):
        z = a * z + b
        path[i] = z
    return path


def bouc_wen_path(deflection: FloatArray, reach: float, exponent: float, gamma: float = GAMMA) -> FloatArray:
    """z over its saturation `reach` of the Bouc-Wen law, (T,)."""
    beta = 1 / ((1 + gamma) * reach**exponent)
    exponent = 1.0 if exponent < 1.0 + 1e-9 else exponent
    return bouc_wen_memory(deflection, beta, exponent, gamma) / reach


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

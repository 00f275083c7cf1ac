"""Friction that is more than a constant force: Stribeck's fall with the rate, presliding (Dahl), both (LuGre).

Presliding is a spring z that gives way the more, the nearer its force comes to that of sliding:

    z' = v - stiffness abs(v) z / g(v),   f = stiffness z                    (Canudas de Wit et al. 1995)

with g the friction force at rate v: constant for Dahl (1968), falling from the static to the sliding one for LuGre.
"""

from __future__ import annotations

import numpy as np

from sprung.model.laws.base import RARE, ElementLaw, ParameterSpec, Values, grid
from sprung.model.laws.damping import SMOOTHING
from sprung.model.laws.motion import Motion, Observed, SpringDamper
from sprung.model.laws.paths import presliding_path
from sprung.model.signals import FloatArray


def _size(seen: Observed) -> float:
    """A force that matters beside the element's own, N."""
    return 0.1 * seen.damping * seen.rate_rms + 0.05 * seen.stiffness * seen.deflection_rms


def _yield(seen: Observed) -> float:
    return 0.1 * max(seen.deflection_rms, 1e-12)


_FORCE = ParameterSpec("force", "N", 0.0, 1e9, "friction while it slides", _size)
_STATIC = ParameterSpec("static_force", "N", 0.0, 1e9, "friction as the rate goes to zero", _size)
_FALL = ParameterSpec(
    "stribeck_rate", "m/s", 1e-6, 10.0, "rate at which it has fallen", lambda seen: 0.3 * seen.rate_rms, log=True
)
_STIFFNESS = ParameterSpec(
    "stiffness", "N/m", 0.0, 1e12, "stiffness before it slides", lambda seen: _size(seen) / _yield(seen)
)


def _stribeck(motion: Motion, p: Values, element: SpringDamper) -> FloatArray:
    force, static, fall, smoothing = p
    v = motion.rate
    found: FloatArray = np.tanh(v / smoothing) * (force + (static - force) * np.exp(-((v / fall) ** 2)))
    return found


STRIBECK = ElementLaw(
    name="stribeck",
    title="friction that falls with the rate (Stribeck)",
    parameters=(
        _FORCE,
        _STATIC,
        _FALL,
        SMOOTHING,
    ),
    force=_stribeck,
    formula="tanh(v / smoothing) * (force + (static_force - force) * exp(-((v / stribeck_rate) ** 2)))",
    shapes=lambda seen: grid(
        [_size(seen)], [1.5 * _size(seen)], max(seen.rate_rms, 1e-12) * np.array([0.1, 0.4]), [0.05 * seen.rate_rms]
    ),
    absent=(0.0, 0.0, 1.0, 1.0),
    looks_like="friction that is largest at standstill and falls as the motion gets faster",
    confused_with=("coulomb_friction", "lugre", "damper_blowoff"),
    sentence="friction of {static_force} at standstill that falls to {force} beyond {stribeck_rate}",
    strength=None,
    corner=3,
    prior_cost=RARE,
    screened=False,
)


def _presliding_force(motion: Motion, p: Values, element: SpringDamper) -> FloatArray:
    (z,) = motion.memory
    found: FloatArray = p[-1] * z  # the stiffness comes last
    return found


def _dahl_rate(motion: Motion, p: Values, element: SpringDamper) -> FloatArray:
    force, stiffness = p
    (z,) = motion.memory
    found: FloatArray = (motion.rate - stiffness * np.abs(motion.rate) * z / force)[None]
    return found


def _dahl_path(motion: Motion, p: Values) -> FloatArray:
    force, stiffness = p
    found: FloatArray = force * presliding_path(motion.deflection, force / stiffness)
    return found


DAHL = ElementLaw(
    name="dahl",
    title="friction with presliding (Dahl)",
    parameters=(_FORCE, _STIFFNESS),
    force=_presliding_force,
    formula="stiffness * z",
    memory_formula="v - stiffness * abs(v) * z / force",
    shapes=lambda seen: grid(
        [_size(seen)], _size(seen) / (max(seen.deflection_rms, 1e-12) * np.array([0.03, 0.1, 0.3]))
    ),
    absent=(1.0, 0.0),
    looks_like="friction that is a spring for small reversals; the loop does not depend on the rate",
    confused_with=("coulomb_friction", "bouc_wen", "lugre"),
    sentence="friction of {force} behind a presliding stiffness of {stiffness}",
    strength=None,
    memory=1,
    memory_rate=_dahl_rate,
    path=_dahl_path,
    prior_cost=RARE,
    screened=False,
)


def _sliding(v: FloatArray, p: Values) -> FloatArray:
    """Friction of steady sliding at a rate, N."""
    force, static, fall, _ = p
    found: FloatArray = force + (static - force) * np.exp(-((v / fall) ** 2))
    return found


def _lugre_rate(motion: Motion, p: Values, element: SpringDamper) -> FloatArray:
    (z,) = motion.memory
    v = motion.rate
    found: FloatArray = (v - p[3] * np.abs(v) * z / _sliding(v, p))[None]
    return found


def _lugre_path(motion: Motion, p: Values) -> FloatArray:
    force, stiffness = p[0], p[3]
    found: FloatArray = force * presliding_path(motion.deflection, force / stiffness, _sliding(motion.rate, p) / force)
    return found


LUGRE = ElementLaw(
    name="lugre",
    title="friction with presliding that falls with the rate (LuGre)",
    parameters=(_FORCE, _STATIC, _FALL, _STIFFNESS),
    force=_presliding_force,
    formula="stiffness * z",
    memory_formula=("v - stiffness * abs(v) * z / (force + (static_force - force) * exp(-((v / stribeck_rate) ** 2)))"),
    shapes=lambda seen: grid(
        [_size(seen)],
        [1.5 * _size(seen)],
        max(seen.rate_rms, 1e-12) * np.array([0.1, 0.4]),
        _size(seen) / (max(seen.deflection_rms, 1e-12) * np.array([0.03, 0.1])),
    ),
    absent=(1.0, 1.0, 1.0, 0.0),
    looks_like="friction that is a spring for small reversals and falls as the motion gets faster",
    confused_with=("stribeck", "dahl", "bouc_wen"),
    sentence="friction of {static_force} that falls to {force} beyond {stribeck_rate}, behind {stiffness}",
    strength=None,
    memory=1,
    memory_rate=_lugre_rate,
    path=_lugre_path,
    prior_cost=RARE,
    screened=False,
)

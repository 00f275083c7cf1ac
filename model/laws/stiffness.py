"""Springs that are not linear: cubic, bump stop, clearance."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sprung.model.laws.base import (
    RARE,
    ElementLaw,
    Motion,
    Observed,
    ParameterSpec,
    SpringDamper,
    Values,
    grid,
    with_wider_form,
)
from sprung.model.signals import FloatArray


def _typical_cubic(seen: Observed) -> float:
    return 0.1 * seen.stiffness / max(3 * seen.deflection_rms**2, 1e-30)


def _cubic(motion: Motion, p: Values, element: SpringDamper) -> FloatArray:
    (k3,) = p
    found: FloatArray = k3 * motion.deflection**3
    return found


CUBIC_STIFFNESS = ElementLaw(
    name="cubic_stiffness",
    title="progressive (cubic) spring",
    parameters=(ParameterSpec("k3", "N/m^3", -1e15, 1e15, "cubic coefficient; negative: softening", _typical_cubic),),
    force=_cubic,
    shapes=lambda seen: grid([_typical_cubic(seen)]),
    formula="k3 * d**3",
    absent=(0.0,),
    looks_like="stiffness grows smoothly with amplitude; odd harmonics; no hysteresis",
    confused_with=("bump_stop", "clearance"),
    sentence="the spring stiffens with the cube of its deflection, k3 = {k3}",
)


def _bump_stop(motion: Motion, p: Values, element: SpringDamper) -> FloatArray:
    gap, stiffness = p
    d = motion.deflection
    found: FloatArray = stiffness * (d - np.minimum(np.maximum(d, -gap), gap))  # = kb max(|d| - gap, 0) sign d
    return found


def _reach(seen: Observed) -> FloatArray:
    return seen.deflection_quantile([0.75, 0.95])


def _either_side(p: Values, seen: Observed) -> tuple[tuple[float, ...], ...]:
    """Both sides alike, or hardly anything on one of them."""
    gap, stiffness = p
    return ((gap, stiffness, gap, stiffness), (gap, stiffness, gap, 0.1 * stiffness), (gap, 0.1 * stiffness, *p))


def _two_stops(motion: Motion, p: Values, element: SpringDamper) -> FloatArray:
    gap, stiffness, gap_compression, stiffness_compression = p
    d = motion.deflection
    found: FloatArray = stiffness * np.maximum(d - gap, 0.0) + stiffness_compression * np.minimum(
        d + gap_compression, 0.0
    )
    return found


_BUMP_STOP = ElementLaw(
    name="bump_stop",
    title="bump stop",
    parameters=(
        ParameterSpec("gap", "m", 1e-7, 1.0, "free travel to each side", lambda seen: seen.deflection[90], log=True),
        ParameterSpec("stiffness", "N/m", 0.0, 1e12, "stiffness beyond the gap", lambda seen: seen.stiffness),
    ),
    force=_bump_stop,
    shapes=lambda seen: grid(
        seen.deflection_quantile([0.35, 0.5, 0.65, 0.75, 0.83, 0.9, 0.95, 0.98, 0.995]), [seen.stiffness]
    ),
    absent=(1.0, 0.0),
    formula="stiffness * (d - min(max(d, -gap), gap))",
    looks_like="the error appears only in the largest deflections, to both sides, and is elastic",
    confused_with=("cubic_stiffness", "clearance"),
    sentence="a stop of {stiffness} is touched beyond {gap} of travel",
    strength=1,
)
BUMP_STOP = with_wider_form(
    _BUMP_STOP,
    replace(_BUMP_STOP.parameters[0], name="gap_compression", meaning="free travel in compression"),
    replace(_BUMP_STOP.parameters[1], name="stiffness_compression", meaning="stiffness beyond that"),
    force=_two_stops,
    shapes=lambda seen: grid(_reach(seen), [seen.stiffness], _reach(seen), [seen.stiffness]),
    absent=(1.0, 0.0, 1.0, 0.0),
    formula="stiffness * max(d - gap, 0) + stiffness_compression * min(d + gap_compression, 0)",
    sentence=(
        "a stop of {stiffness} is touched beyond {gap} of extension, one of {stiffness_compression} beyond "
        "{gap_compression} of compression"
    ),
    strength=None,
    prior_cost=RARE,
    screened=False,
    widened=_either_side,
)


def _clearance(motion: Motion, p: Values, element: SpringDamper) -> FloatArray:
    (gap,) = p
    found: FloatArray = -element.stiffness * np.minimum(np.maximum(motion.deflection, -gap), gap)
    return found


CLEARANCE = ElementLaw(
    name="clearance",
    title="clearance (lost motion) of the spring",
    parameters=(
        ParameterSpec("gap", "m", 0.0, 1.0, "half of the lost motion", lambda seen: 0.3 * seen.deflection_rms),
    ),
    force=_clearance,
    shapes=lambda seen: grid(seen.deflection_quantile([0.03, 0.08, 0.15, 0.25, 0.35, 0.5, 0.65, 0.8])),
    absent=(0.0,),
    formula="-k * min(max(d, -gap), gap)",
    looks_like="no spring force around the middle, full stiffness beyond: the error is largest at small deflections",
    confused_with=("coulomb_friction", "bump_stop", "cubic_stiffness"),
    sentence="the spring has a clearance of {gap} to each side before it acts",
    strength=None,
)

"""Springs that are not linear: cubic, bump stop, clearance."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from sprung.model.laws.base import (
    COMPRESSION,
    EXTENSION,
    RARE,
    ElementLaw,
    ParameterSpec,
    Restatement,
    Values,
    grid,
    with_wider_form,
)
from sprung.model.laws.motion import Motion, Observed, SpringDamper
from sprung.model.signals import FloatArray


def _typical_cubic(seen: Observed) -> float:
    return 0.1 * seen.stiffness / max(3 * seen.deflection_rms**2, 1e-30)


def _cubic(motion: Motion, p: Values, element: SpringDamper) -> FloatArray:
    (k3,) = p
    d = motion.deflection
    found: FloatArray = k3 * d * d * d  # far faster than a power
    return found


def _off_centre(motion: Motion, p: Values, element: SpringDamper) -> FloatArray:
    k3, k2 = p
    found: FloatArray = (k3 * motion.deflection + k2) * motion.deflection**2
    return found


_CUBIC_STIFFNESS = ElementLaw(
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
CUBIC_STIFFNESS = with_wider_form(
    _CUBIC_STIFFNESS,
    ParameterSpec("k2", "N/m^2", -1e12, 1e12, "quadratic coefficient: it is soft elsewhere", lambda seen: 0.0),
    force=_off_centre,
    formula="k3 * d**3 + k2 * d**2",
    shapes=lambda seen: grid([_typical_cubic(seen)], [0.0]),
    absent=(0.0, 0.0),
    sentence="the spring stiffens with its deflection, k3 = {k3}, and is softest off the middle, k2 = {k2}",
    strength=None,
    prior_cost=RARE,
    screened=False,
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


def _extension_stop(motion: Motion, p: Values, element: SpringDamper) -> FloatArray:
    gap, stiffness = p
    found: FloatArray = stiffness * np.maximum(motion.deflection - gap, 0.0)
    return found


def _compression_stop(motion: Motion, p: Values, element: SpringDamper) -> FloatArray:
    gap, stiffness = p
    found: FloatArray = stiffness * np.minimum(motion.deflection + gap, 0.0)
    return found


def _on_one_side(
    side: str, force: Callable[[Motion, Values, SpringDamper], FloatArray], formula: str
) -> tuple[str, ElementLaw]:
    sentence = f"a stop of {{stiffness}} is touched beyond {{gap}} of {side}"
    return side, replace(_BUMP_STOP, force=force, formula=formula, sentence=sentence)


BUMP_STOP = replace(  # of cars most stops act in compression alone
    BUMP_STOP,
    forms=(
        _on_one_side(EXTENSION, _extension_stop, "stiffness * max(d - gap, 0)"),
        _on_one_side(COMPRESSION, _compression_stop, "stiffness * min(d + gap, 0)"),
    ),
)


def _progressive_stop(motion: Motion, p: Values, element: SpringDamper) -> FloatArray:
    gap, stiffness, gap_compression, stiffness_compression, exponent = p
    d = motion.deflection
    extended, compressed = np.maximum(d - gap, 0.0), np.maximum(-d - gap_compression, 0.0)
    found: FloatArray = (
        stiffness * gap * (extended / gap) ** exponent
        - stiffness_compression * gap_compression * (compressed / gap_compression) ** exponent
    )
    return found


PROGRESSIVE_STOP = ElementLaw(
    name="progressive_stop",
    title="progressive stop",
    parameters=(
        _BUMP_STOP.parameters[0],
        ParameterSpec("stiffness", "N/m", 0.0, 1e12, "force over depth, a gap's length deep", lambda s: s.stiffness),
        replace(_BUMP_STOP.parameters[0], name="gap_compression", meaning="free travel in compression"),
        ParameterSpec("stiffness_compression", "N/m", 0.0, 1e12, "the same in compression", lambda s: s.stiffness),
        ParameterSpec("exponent", "1", 1.0, 4.0, "power of the depth", lambda seen: 2.0),
    ),
    force=_progressive_stop,
    shapes=lambda seen: grid(_reach(seen), [seen.stiffness], _reach(seen), [seen.stiffness], [2.0]),
    absent=(1.0, 0.0, 1.0, 0.0, 2.0),
    formula=(
        "stiffness * gap * (max(d - gap, 0) / gap)**exponent"
        " - stiffness_compression * gap_compression * (max(-d - gap_compression, 0) / gap_compression)**exponent"
    ),
    looks_like="the error appears only in the largest deflections, is elastic, and grows there ever faster",
    confused_with=("bump_stop", "cubic_stiffness"),
    sentence=(
        "a stop that grows with the power {exponent} of its depth is touched beyond {gap} of extension and "
        "{gap_compression} of compression"
    ),
    strength=None,
    prior_cost=2 * RARE,  # it contains stops that differ in the two directions, and these such that do not
    screened=False,
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


def _lost_motion(p: Values, element: SpringDamper) -> tuple[Restatement, ...]:
    """Stops of a spring that has nearly none before them: the spring begins at them."""
    gap, stiffness = (float(np.mean(values)) for values in (p[::2], p[1::2]))  # of both sides
    return (Restatement(CLEARANCE, (gap,), SpringDamper(element.stiffness + stiffness, element.damping)),)


if BUMP_STOP.wider is not None:
    BUMP_STOP = replace(BUMP_STOP, restated=_lost_motion, wider=replace(BUMP_STOP.wider, restated=_lost_motion))

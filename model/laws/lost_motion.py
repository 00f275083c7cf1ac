"""Hysteresis of joints: friction, gap and stick in series; loops that are pinched in the middle of the travel."""

from __future__ import annotations

import numpy as np

from sprung.model.laws.base import RARE, ElementLaw, ParameterSpec, Values, grid, with_wider_form
from sprung.model.laws.motion import Motion, Observed, SpringDamper
from sprung.model.laws.paths import stop_path
from sprung.model.laws.reversals import GAMMA, bouc_wen_memory
from sprung.model.signals import FloatArray

_CORNER = 0.05  # of the deflection from contact to slip: over it the slider begins to slip
_LEAST = 1e-9  # m


def _size(seen: Observed) -> float:
    return 0.3 * seen.stiffness * seen.deflection_rms


def _travel(seen: Observed) -> float:
    return max(seen.deflection_rms, 1e-12)


def _limits(p: Values) -> tuple[FloatArray, FloatArray]:
    """How far the slider is carried before it slips, and over how much of it slipping begins, m."""
    force, gap, stiffness, *further = p
    inner = further[0] if further else 0.0
    reach = (force - 0.5 * inner * gap) / stiffness
    return np.asarray(0.5 * gap + reach), np.maximum(_CORNER * reach, _LEAST)


def _backlash(motion: Motion, p: Values, element: SpringDamper) -> FloatArray:
    _, gap, stiffness, *further = p
    inner = further[0] if further else 0.0
    (u,) = motion.memory
    found: FloatArray = inner * u + (stiffness - inner) * np.sign(u) * np.maximum(np.abs(u) - 0.5 * gap, 0.0)
    return found


def _backlash_rate(motion: Motion, p: Values, element: SpringDamper) -> FloatArray:
    (u,) = motion.memory
    v = motion.rate
    most, corner = _limits(p)
    slipping = np.minimum(np.maximum((np.abs(u) - most + corner) / corner, 0.0), 1.0)
    found: FloatArray = (v - slipping * 0.5 * (v + np.abs(v) * np.sign(u)))[None]
    return found


def _backlash_path(motion: Motion, p: Values) -> FloatArray:
    most, corner = _limits(p)
    carried = stop_path(motion.deflection, float(most), float(corner))
    return _backlash(motion._replace(memory=carried[None]), p, SpringDamper(0.0, 0.0))


_REACH = f"max({_CORNER} * (force / stiffness), {_LEAST})"
_INNER_REACH = f"max({_CORNER} * ((force - 0.5 * inner_stiffness * gap) / stiffness), {_LEAST})"
_SLIPS = "v - min(max((abs(z) - (0.5 * gap + {reach}) + {corner}) / {corner}, 0), 1) * 0.5 * (v + abs(v) * sign(z))"

_FRICTION_BACKLASH = ElementLaw(
    name="friction_backlash",
    title="friction with backlash (slip, gap and stick in series)",
    parameters=(
        ParameterSpec("force", "N", 0.0, 1e9, "force at which it slips", _size),
        ParameterSpec("gap", "m", 0.0, 1.0, "whole lost motion", lambda seen: 0.5 * _travel(seen)),
        ParameterSpec("stiffness", "N/m", 1e-6, 1e12, "stiffness between contact and slip", lambda s: s.stiffness),
    ),
    force=_backlash,
    formula="stiffness * sign(z) * max(abs(z) - 0.5 * gap, 0)",
    memory_formula=_SLIPS.format(reach="force / stiffness", corner=_REACH),
    shapes=lambda seen: grid([_size(seen)], _travel(seen) * np.array([0.3, 1.0]), [max(seen.stiffness, 1e-6)]),
    absent=(0.0, 0.0, 1.0),
    looks_like="after every reversal no force over the gap, then a stiff contact, then slipping at constant force",
    confused_with=("bouc_wen", "clearance", "pinched_hysteresis"),
    sentence="it slips at {force} after a lost motion of {gap} and sticks with {stiffness}",
    strength=None,
    memory=1,
    memory_rate=_backlash_rate,
    turns_over=lambda p: _limits(p)[1],
    path=_backlash_path,
    prior_cost=RARE,
    screened=False,
)
FRICTION_BACKLASH = with_wider_form(
    _FRICTION_BACKLASH,
    ParameterSpec("inner_stiffness", "N/m", 0.0, 1e12, "what still holds within the gap", lambda s: 0.0),
    formula=("inner_stiffness * z + (stiffness - inner_stiffness) * sign(z) * max(abs(z) - 0.5 * gap, 0)"),
    memory_formula=_SLIPS.format(reach="(force - 0.5 * inner_stiffness * gap) / stiffness", corner=_INNER_REACH),
    shapes=lambda seen: grid(
        [_size(seen)], _travel(seen) * np.array([0.3, 1.0]), [max(seen.stiffness, 1e-6)], [0.1 * seen.stiffness]
    ),
    absent=(0.0, 0.0, 1.0, 0.0),
    sentence=(
        "it slips at {force} after a lost motion of {gap}, within which {inner_stiffness} still holds, and sticks "
        "with {stiffness}"
    ),
)


def _pinched(motion: Motion, p: Values, element: SpringDamper) -> FloatArray:
    force, reach, pinching, width = p
    (z,) = motion.memory
    found: FloatArray = force * z / reach * (1 - pinching * np.exp(-((motion.deflection / width) ** 2)))
    return found


def _pinched_rate(motion: Motion, p: Values, element: SpringDamper) -> FloatArray:
    (z,) = motion.memory
    v = motion.rate
    found: FloatArray = (v - (np.abs(v) * z + GAMMA * v * np.abs(z)) / ((1 + GAMMA) * p[1]))[None]
    return found


def _pinched_path(motion: Motion, p: Values) -> FloatArray:
    z = bouc_wen_memory(motion.deflection, 1 / ((1 + GAMMA) * p[1]), 1.0)
    return _pinched(motion._replace(memory=z[None]), p, SpringDamper(0.0, 0.0))


PINCHED_HYSTERESIS = ElementLaw(
    name="pinched_hysteresis",
    title="hysteresis pinched in the middle of the travel",
    parameters=(
        ParameterSpec("force", "N", 0.0, 1e9, "force at which it yields, away from the middle", _size),
        ParameterSpec(
            "yield_displacement",
            "m",
            1e-9,
            1.0,
            "deflection over which it yields",
            lambda s: 0.1 * _travel(s),
            log=True,
        ),
        ParameterSpec("pinching", "1", 0.0, 1.0, "share of the force that is lost in the middle", lambda seen: 0.5),
        ParameterSpec("pinching_width", "m", 1e-9, 10.0, "width of the middle", lambda s: 0.5 * _travel(s), log=True),
    ),
    force=_pinched,
    formula="force * z / yield_displacement * (1 - pinching * exp(-((d / pinching_width) ** 2)))",
    memory_formula=f"v - (abs(v) * z + {GAMMA} * v * abs(z)) / ({1 + GAMMA} * yield_displacement)",
    shapes=lambda seen: grid([_size(seen)], _travel(seen) * np.array([0.03, 0.2]), [0.5], [0.5 * _travel(seen)]),
    absent=(0.0, 1.0, 0.0, 1.0),
    looks_like="a loop that is thin in the middle of the travel and wide at its ends: worn or bolted joints",
    confused_with=("bouc_wen", "friction_backlash", "clearance"),
    sentence="a loop of {force} that yields over {yield_displacement}, pinched by {pinching} within {pinching_width}",
    memory=1,
    memory_rate=_pinched_rate,
    path=_pinched_path,
    prior_cost=2 * RARE,  # it imitates friction with backlash, too, which is rare itself
    screened=False,
)

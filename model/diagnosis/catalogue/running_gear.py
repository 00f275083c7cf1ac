"""What belongs to rails and wheels: wheel flat, rail joints, anti-roll bar.

Wheel flat and rail joints move the support of a primary element in a way that its measured displacement does not
show: a periodic dip w(t).  The true deflection is then d - w, which adds -(k w + c w') to the element's force.
"""

from __future__ import annotations

import numpy as np

from model.diagnosis.catalogue.base import (
    ElementLaw,
    Motion,
    Observed,
    ParameterSpec,
    SpringDamper,
    Values,
    Where,
    grid,
)
from model.signals import FloatArray

_HARMONICS = np.arange(1, 9)


def _dip(time: FloatArray, frequency: FloatArray, phase: FloatArray, width: float) -> tuple[FloatArray, FloatArray]:
    """A dip of unit depth per period and its rate: a Gaussian of relative `width`, as its first harmonics.

    The mean is left out (it is a static deflection), the harmonics are smooth in every parameter, and what they
    omit lies above what suspensions pass on.
    """
    angle = 2 * np.pi * (np.asarray(time) * frequency - phase)
    value: FloatArray = np.zeros(np.shape(angle))
    slope: FloatArray = np.zeros(np.shape(angle))
    for n in _HARMONICS:
        weight = -2 * np.sqrt(2 * np.pi) * width * np.exp(-0.5 * (2 * np.pi * n * width) ** 2)
        value = value + weight * np.cos(n * angle)
        slope = slope - weight * n * np.sin(n * angle)
    return value, 2 * np.pi * frequency * slope


def _dip_law(name: str, title: str, width: float, *, looks_like: str, sentence: str, where: Where) -> ElementLaw:
    def force(motion: Motion, p: Values, element: SpringDamper) -> FloatArray:
        depth, frequency, phase = p
        w, rate = _dip(motion.time, frequency, phase, width)
        return -depth * (element.stiffness * w + element.damping * rate)

    def shapes(seen: Observed) -> FloatArray:
        if not seen.lines:  # nothing periodic is left in the residual: nothing to try
            return np.zeros((0, 3))
        fundamentals = sorted({f / n for f in seen.lines for n in (1, 2, 3) if f / n >= 0.3})
        return grid([0.1 * seen.deflection_rms], fundamentals, np.arange(8) / 8)

    return ElementLaw(
        name=name,
        title=title,
        parameters=(
            ParameterSpec("depth", "m", 0.0, 0.1, "depth of the dip", lambda seen: 0.1 * seen.deflection_rms),
            ParameterSpec("frequency", "Hz", 0.1, 200.0, "dips per second", lambda seen: 1.0, log=True),
            ParameterSpec("phase", "1", -2.0, 2.0, "periods from the start of the laws' clock to a dip", lambda s: 0.1),
        ),
        force=force,
        shapes=shapes,
        absent=(0.0, 1.0, 0.0),
        looks_like=looks_like,
        confused_with=("external_force", "wheel_flat" if name == "rail_joints" else "rail_joints"),
        sentence=sentence,
        where=where,
        passive=False,
        odd=False,
    )


WHEEL_FLAT = _dip_law(
    "wheel_flat",
    "wheel flat",
    0.02,
    looks_like="lines at the wheel's revolutions and their harmonics, at one wheel",
    sentence="a flat of {depth} on the wheel below, {frequency} times a second",
    where="element",
)
RAIL_JOINTS = _dip_law(
    "rail_joints",
    "rail joints",
    0.06,
    looks_like="lines at speed over rail length, at both wheels of an axle",
    sentence="dips of {depth} at the rail joints, {frequency} a second",
    where="axle",
)


def _bar(motion: Motion, p: Values, element: SpringDamper) -> FloatArray:
    (stiffness,) = p
    return stiffness * motion.deflection


ANTI_ROLL_BAR = ElementLaw(
    name="anti_roll_bar",
    title="anti-roll bar between the sides",
    parameters=(
        ParameterSpec(
            "stiffness", "N/m", 0.0, 1e12, "force per difference of the two deflections", lambda s: 0.1 * s.stiffness
        ),
    ),
    force=_bar,  # deflection: left minus right; the force acts on the left element, its negative on the right one
    shapes=lambda seen: grid([0.1 * seen.stiffness]),
    absent=(0.0,),
    looks_like="roll stiffer than the bounce stiffness explains; linear, acts on both sides",
    confused_with=("mass_change", "flexible_mode"),
    sentence="an anti-roll bar of {stiffness} between the two sides",
    where="pair",
)

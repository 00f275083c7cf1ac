"""What belongs to rails and wheels: wheel flat, rail joints, anti-roll bar."""

from __future__ import annotations

import numpy as np

from sprung.model.laws.base import RARE, ElementLaw, ParameterSpec, Values, Where, grid
from sprung.model.laws.kinds import SupportLaw
from sprung.model.laws.motion import Motion, SpringDamper
from sprung.model.signals import FloatArray

_COUNT = 8  # harmonics of a dip


def _dip_law(
    name: str, title: str, width: float, *, looks_like: str, confused_with: tuple[str, ...], sentence: str, where: Where
) -> SupportLaw:
    """A Gaussian dip of relative `width` per period, as its first harmonics.

    The mean is left out (it is a static deflection), the harmonics are smooth in every parameter, and what they
    omit lies above what suspensions pass on.
    """
    n = np.arange(1, _COUNT + 1)
    harmonics = -2 * np.sqrt(2 * np.pi) * width * np.exp(-0.5 * (2 * np.pi * n * width) ** 2)
    return SupportLaw(
        name=name,
        title=title,
        parameters=(
            ParameterSpec("depth", "m", 0.0, 0.1, "depth of the dip", lambda seen: 0.1 * seen.deflection_rms),
            ParameterSpec("frequency", "Hz", 0.1, 200.0, "dips per second", lambda seen: 1.0, log=True),
            ParameterSpec("phase", "1", -2.0, 2.0, "periods from the start of the laws' clock to a dip", lambda s: 0.1),
        ),
        harmonics=tuple(harmonics.tolist()),
        absent=(0.0, 1.0, 0.0),
        looks_like=looks_like,
        confused_with=confused_with,
        sentence=sentence,
        where=where,
        prior_cost=RARE,
    )


WHEEL_FLAT = _dip_law(
    "wheel_flat",
    "wheel flat",
    0.02,
    looks_like="lines at the wheel's revolutions and their harmonics, at one wheel",
    confused_with=("external_force", "rail_joints"),
    sentence="a flat of {depth}, {frequency} times a second",
    where="support",
)
RAIL_JOINTS = _dip_law(
    "rail_joints",
    "rail joints",
    0.06,
    looks_like="lines at speed over rail length, at both wheels of an axle",
    confused_with=("external_force", "wheel_flat"),
    sentence="dips of {depth} at the rail joints, {frequency} a second",
    where="axle",
)


def _bar(motion: Motion, p: Values, element: SpringDamper) -> FloatArray:
    (stiffness,) = p
    found: FloatArray = stiffness * motion.deflection
    return found


ANTI_ROLL_BAR = ElementLaw(
    name="anti_roll_bar",
    title="anti-roll bar between the sides",
    parameters=(
        ParameterSpec(
            "stiffness", "N/m", 0.0, 1e12, "force per difference of the two deflections", lambda s: 0.1 * s.stiffness
        ),
    ),
    formula="stiffness * d",
    force=_bar,  # deflection: left minus right; the force acts on the left element, its negative on the right one
    shapes=lambda seen: grid([0.1 * seen.stiffness]),
    absent=(0.0,),
    looks_like="roll stiffer than the bounce stiffness explains; linear, acts on both sides",
    confused_with=("mass_change", "flexible_mode"),
    sentence="an anti-roll bar of {stiffness} between the two sides",
    where="pair",
    prior_cost=RARE,
)

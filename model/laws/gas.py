"""Static forces of rigs and struts: a preload, and a gas spring that stiffens as it is compressed."""

from __future__ import annotations

import numpy as np

from sprung.model.laws.base import RARE, ElementLaw, ParameterSpec, Values, grid
from sprung.model.laws.motion import Motion, Observed, SpringDamper
from sprung.model.signals import FloatArray

_SHORTEST = 0.02  # of the gas column: nearer to its bottom the formula is no gas


def _size(seen: Observed) -> float:
    return seen.stiffness * max(seen.deflection_rms, 1e-12)


def _preload(motion: Motion, p: Values, element: SpringDamper) -> FloatArray:
    (force,) = p
    found: FloatArray = force + 0.0 * np.asarray(motion.deflection)
    return found


PRELOAD = ElementLaw(
    name="preload",
    title="static preload",
    parameters=(ParameterSpec("force", "N", -1e9, 1e9, "force at rest; positive: it pulls", _size),),
    force=_preload,
    formula="force",
    shapes=lambda seen: grid([_size(seen)]),
    absent=(0.0,),
    looks_like="a constant force: gas, weight, or the setting of a rig; no fault",
    confused_with=("sensor_bias",),
    sentence="a static preload of {force}",
    nuisance=True,
    screened=False,
    constant=True,
)


def _gas(motion: Motion, p: Values, element: SpringDamper) -> FloatArray:
    force, length, exponent = p
    column = np.maximum(1 + motion.deflection / length, _SHORTEST)
    found: FloatArray = force * (1 - column**-exponent)
    return found


GAS_SPRING = ElementLaw(
    name="gas_spring",
    title="gas spring (progressive in compression)",
    parameters=(
        ParameterSpec("force", "N", 0.0, 1e9, "gas force at rest; by itself a preload that pushes", _size),
        ParameterSpec(
            "length",
            "m",
            1e-4,
            100.0,
            "volume of the gas over its piston's area",
            lambda s: 5 * max(s.deflection_rms, 1e-4),
            log=True,
        ),
        ParameterSpec("exponent", "1", 1.0, 1.67, "polytropic: 1 slow, 1.4 fast (air, nitrogen)", lambda seen: 1.3),
    ),
    force=_gas,
    formula=f"force * (1 - max(1 + d / length, {_SHORTEST}) ** (-exponent))",
    shapes=lambda seen: grid([_size(seen)], max(seen.deflection_rms, 1e-4) * np.array([5.0, 20.0]), [1.3]),
    absent=(0.0, 1.0, 1.3),
    looks_like="stiffer in compression than in extension, without a knee or a loop",
    confused_with=("cubic_stiffness", "bump_stop"),
    sentence="a gas spring of {force} at rest on a column of {length}",
    prior_cost=RARE,
    screened=False,
)

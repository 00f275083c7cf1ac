"""Springs and dampers that change during the recording: warming, leaking, settling."""

from __future__ import annotations

import numpy as np

from sprung.model.laws.base import ElementLaw, ParameterSpec, Values, grid
from sprung.model.laws.motion import CLOCK_LEAD, Motion, Observed, SpringDamper
from sprung.model.signals import FloatArray

_CHANGE = ParameterSpec(  # a larger change is rather a wrong value of the file
    "p", "1", -0.95, 20.0, "relative change that is reached in the end", lambda seen: 0.1, usual=(0.0, 10.0)
)
_TAU = ParameterSpec(  # a change completed before the first sample is not observable
    "tau",
    "s",
    0.05,
    1e6,
    "time constant of the change",
    lambda seen: seen.seconds / 3,
    log=True,
    plausible=(CLOCK_LEAD / 5, float("inf")),
)


def _progress(time: FloatArray, tau: FloatArray) -> FloatArray:
    """Share of the change that is done, 0 at the start of the laws' clock."""
    return -np.expm1(-np.asarray(time) / tau)


def _stiffness(motion: Motion, p: Values, element: SpringDamper) -> FloatArray:
    change, tau = p
    found: FloatArray = element.stiffness * change * _progress(motion.time, tau) * motion.deflection
    return found


def _damping(motion: Motion, p: Values, element: SpringDamper) -> FloatArray:
    change, tau = p
    found: FloatArray = element.damping * change * _progress(motion.time, tau) * motion.rate
    return found


def _shapes(seen: Observed) -> FloatArray:
    spans = np.array([0.03, 0.08, 0.2, 0.5, 1.5])
    return grid([0.1], np.maximum(spans * (seen.seconds + CLOCK_LEAD), 0.1))


TIME_VARYING_STIFFNESS = ElementLaw(
    name="time_varying_stiffness",
    title="stiffness that changes during the recording",
    parameters=(_CHANGE, _TAU),
    force=_stiffness,
    formula="k * p * (1 - exp(-t / tau)) * d",
    shapes=_shapes,
    over_time=True,
    absent=(0.0, 1.0),
    looks_like="a residual in phase with the deflection that changes sign once over the recording",
    confused_with=("time_varying_damping", "air_spring"),
    sentence="the stiffness changes by {p} (share of its first value) with a time constant of {tau}",
)

TIME_VARYING_DAMPING = ElementLaw(
    name="time_varying_damping",
    title="damping that changes during the recording",
    parameters=(_CHANGE, _TAU),
    force=_damping,
    formula="c * p * (1 - exp(-t / tau)) * v",
    shapes=_shapes,
    over_time=True,
    absent=(0.0, 1.0),
    looks_like="a residual in phase with the rate that changes sign once over the recording",
    confused_with=("time_varying_stiffness",),
    sentence="the damping changes by {p} (share of its first value) with a time constant of {tau}",
)

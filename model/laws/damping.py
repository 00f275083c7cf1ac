"""Dampers that are not linear: dry friction, blow-off, asymmetry, other powers of the rate."""

from __future__ import annotations

from dataclasses import replace
from math import gamma, pi, sqrt
from statistics import NormalDist

import numpy as np

from sprung.model.laws.base import (
    RARE,
    ElementLaw,
    FittedElement,
    ParameterSpec,
    Restart,
    Values,
    grid,
    with_wider_form,
)
from sprung.model.laws.motion import Motion, Observed, SpringDamper
from sprung.model.signals import FloatArray

SMOOTHING = ParameterSpec(
    "smoothing",
    "m/s",
    1e-6,
    10.0,
    "rate over which the force changes sign",
    lambda seen: 0.05 * seen.rate_rms,
    log=True,
    minor=True,
)


def _coulomb(motion: Motion, p: Values, element: SpringDamper) -> FloatArray:
    force, smoothing = p
    found: FloatArray = force * np.tanh(motion.rate / smoothing)
    return found


def _sliding(motion: Motion, p: Values, element: SpringDamper) -> FloatArray:
    force, smoothing, slow, rate = p
    v = motion.rate
    found: FloatArray = np.tanh(v / smoothing) * (force + (slow - force) * np.exp(-np.abs(v) / rate))
    return found


def _slow_forces(p: Values, seen: Observed) -> tuple[tuple[float, ...], ...]:
    force, smoothing = p
    rate = _TURNS * max(seen.rate_rms, 1e-12)
    return tuple((fast * force, min(smoothing, 0.3 * rate), slow * force, rate) for fast, slow in _FAST_AND_SLOW)


_TURNS = 0.3  # of the rms rate, within which friction changes to that of fast sliding
_FAST_AND_SLOW = ((1.2, 0.5), (0.9, 1.5))  # times a constant friction that was read


def _coulomb_shapes(seen: Observed) -> FloatArray:
    widest = max(seen.rate_rms, 1e-12)
    return grid([0.1 * seen.damping * widest + 0.05 * seen.stiffness * seen.deflection_rms], widest * _WIDTHS)


_WIDTHS = np.array([0.02, 0.07, 0.2, 0.6])

_COULOMB = ElementLaw(
    name="coulomb_friction",
    title="dry friction",
    parameters=(
        ParameterSpec("force", "N", 0.0, 1e9, "friction force", lambda seen: _coulomb_shapes(seen)[0, 0]),
        replace(SMOOTHING, usual=(0.0, 4.0)),  # wider, it is a damper that saturates
    ),
    force=_coulomb,
    shapes=_coulomb_shapes,
    formula="force * tanh(v / smoothing)",
    absent=(0.0, 1.0),
    looks_like="force of constant size against the motion; strongest relative effect at small amplitudes",
    confused_with=("damper_blowoff", "quadratic_damping", "bouc_wen", "clearance"),
    sentence="dry friction of {force}",
    corner=1,
)
# Sliding bearings: PTFE has a third of its friction at creeping rates (Constantinou, Mokha and Reinhorn 1990)
COULOMB_FRICTION = with_wider_form(
    _COULOMB,
    ParameterSpec("slow_force", "N", 0.0, 1e9, "friction force at creeping rates", lambda s: _coulomb_shapes(s)[0, 0]),
    ParameterSpec(
        "rate", "m/s", 1e-6, 10.0, "rate over which it changes", lambda s: _TURNS * max(s.rate_rms, 1e-12), log=True
    ),
    force=_sliding,
    formula="tanh(v / smoothing) * (force + (slow_force - force) * exp(-abs(v) / rate))",
    shapes=lambda seen: np.array([_slow_forces(p, seen)[0] for p in _coulomb_shapes(seen).tolist()]),
    absent=(0.0, 1.0, 0.0, 1.0),
    sentence="dry friction of {force} that is {slow_force} at creeping rates and changes over {rate}",
    prior_cost=RARE,
    screened=False,
    widened=_slow_forces,
)


def _blowoff(motion: Motion, p: Values, element: SpringDamper) -> FloatArray:
    knee, ratio = p
    v = motion.rate
    found: FloatArray = (ratio - 1) * element.damping * (v - np.minimum(np.maximum(v, -knee), knee))
    return found


def _two_knees(motion: Motion, p: Values, element: SpringDamper) -> FloatArray:
    knee, ratio, knee_compression, ratio_compression = p
    v = motion.rate
    extension, compression = np.maximum(v - knee, 0.0), np.minimum(v + knee_compression, 0.0)
    found: FloatArray = element.damping * ((ratio - 1) * extension + (ratio_compression - 1) * compression)
    return found


def _knees(seen: Observed) -> FloatArray:
    return seen.rate_quantile([0.35, 0.65, 0.9])


_STRONGER, _FALLS_TO = (1.4, 2.0), 0.3  # times the damping that was read; beyond the knee


def _of_a_stronger_damper(read: FittedElement) -> tuple[Restart, ...]:
    """Valves of stronger dampers that are read as this one: by the mean slope over a normal rate of the same size.

    The mean slope of a ratio r beyond a knee q is c (r + (1 - r) P(|v| < q)) (statistical linearisation, Booton 1954).
    """
    starts = []
    for stronger in _STRONGER:
        below = (1 / stronger - _FALLS_TO) / (1 - _FALLS_TO)
        knee = read.rate * NormalDist().inv_cdf((1 + below) / 2)
        starts.append(Restart(1.0, stronger, (knee, _FALLS_TO)))
    return tuple(starts)


_BLOWOFF = ElementLaw(
    name="damper_blowoff",
    title="damper blow-off",
    parameters=(
        ParameterSpec(
            "knee",
            "m/s",
            1e-7,
            100.0,
            "rate at which the valve opens",
            lambda seen: seen.rate[50],
            log=True,
            usual=(0.45, float("inf")),  # a valve that opens long before usual rates acts as friction
        ),
        ParameterSpec("ratio", "1", 0.0, 0.98, "slope beyond the knee over slope below it", lambda seen: 0.3),
    ),
    force=_blowoff,
    shapes=lambda seen: grid(seen.rate_quantile([0.08, 0.2, 0.35, 0.5, 0.65, 0.8, 0.9, 0.96, 0.99]), [0.3]),
    absent=(100.0, 1.0),
    formula="(ratio - 1) * c * (v - min(max(v, -knee), knee))",
    looks_like="the damper is softer at high rates, with a knee; the force stays odd in the rate",
    confused_with=("coulomb_friction", "quadratic_damping", "series_stiffness"),
    sentence="the damper blows off beyond {knee}; its slope falls to {ratio} of the nominal one",
    strength=1,
    knees=(0,),
    restarts=_of_a_stronger_damper,
)
DAMPER_BLOWOFF = with_wider_form(
    _BLOWOFF,
    replace(_BLOWOFF.parameters[0], name="knee_compression"),
    replace(_BLOWOFF.parameters[1], name="ratio_compression"),
    force=_two_knees,
    formula=("c * ((ratio - 1) * max(v - knee, 0) + (ratio_compression - 1) * min(v + knee_compression, 0))"),
    shapes=lambda seen: grid(_knees(seen), [0.3], _knees(seen), [0.3]),
    absent=(100.0, 1.0, 100.0, 1.0),
    sentence=(
        "the damper blows off beyond {knee} in extension and {knee_compression} in compression; its slope falls to "
        "{ratio} and {ratio_compression} of the nominal one"
    ),
    strength=None,
    knees=(0, 2),
    restarts=None,
    prior_cost=RARE,
    screened=False,
    widened=lambda p, seen: ((*p, *p),),
)


def _asymmetry(motion: Motion, p: Values, element: SpringDamper) -> FloatArray:
    (a,) = p
    found: FloatArray = a * element.damping * np.abs(motion.rate)  # c (1 + a) v for v > 0, c (1 - a) v for v < 0
    return found


_ASYMMETRY = ElementLaw(
    name="damper_asymmetry",
    title="damper asymmetry",
    parameters=(ParameterSpec("a", "1", -0.99, 0.99, "positive: harder in extension", lambda seen: 0.1),),
    force=_asymmetry,
    formula="a * c * abs(v)",
    shapes=lambda seen: grid([0.3]),
    absent=(0.0,),
    looks_like="even harmonics and a shift of the mean deflection that grows with the rate",
    confused_with=("sensor_bias",),
    sentence="the damper is harder in one direction, a = {a} (positive: extension)",
)


def _asymmetry_of_valves(motion: Motion, p: Values, element: SpringDamper) -> FloatArray:
    a, knee, ratio = p
    rate = np.abs(motion.rate)
    found: FloatArray = a * element.damping * (ratio * rate + (1 - ratio) * np.minimum(rate, knee))
    return found


def _levels_off(p: Values, seen: Observed) -> tuple[tuple[float, ...], ...]:
    (a,) = p
    return tuple((a, float(knee), 0.3) for knee in _knees(seen)[:2])


# Valves of one knee whose forces in the two directions keep their ratio: beyond it, the difference grows as the forces
DAMPER_ASYMMETRY = with_wider_form(
    _ASYMMETRY,
    replace(_BLOWOFF.parameters[0], meaning="rate beyond which the difference grows more slowly"),
    ParameterSpec("ratio", "1", -2.0, 2.0, "growth beyond the knee over that below it", lambda seen: 0.3),
    force=_asymmetry_of_valves,
    formula="a * c * (ratio * abs(v) + (1 - ratio) * min(abs(v), knee))",
    shapes=lambda seen: grid([0.3], _knees(seen), [0.3]),
    absent=(0.0, 100.0, 1.0),
    sentence=(
        "the damper is harder in one direction, a = {a} (positive: extension) up to {knee}; the difference grows "
        "with {ratio} of that beyond"
    ),
    knees=(1,),
    prior_cost=RARE,
    screened=False,
    widened=_levels_off,
)


def _typical_quadratic(seen: Observed) -> float:
    return 0.3 * seen.damping / max(seen.rate_rms, 1e-30)


def _quadratic(motion: Motion, p: Values, element: SpringDamper) -> FloatArray:
    (c2,) = p
    found: FloatArray = c2 * motion.rate * np.abs(motion.rate)
    return found


QUADRATIC_DAMPING = ElementLaw(
    name="quadratic_damping",
    title="quadratic (orifice) damping",
    parameters=(ParameterSpec("c2", "N s^2/m^2", 0.0, 1e12, "quadratic coefficient", _typical_quadratic),),
    force=_quadratic,
    formula="c2 * v * abs(v)",
    shapes=lambda seen: grid([_typical_quadratic(seen)]),
    absent=(0.0,),
    looks_like="damping grows with the rate, smoothly",
    confused_with=("damper_blowoff", "coulomb_friction"),
    sentence="the damper has a force with the square of the rate, c2 = {c2}",
)


def _power(motion: Motion, p: Values, element: SpringDamper) -> FloatArray:
    force, exponent, smoothing = p
    found: FloatArray = force * motion.rate * (motion.rate**2 + smoothing**2) ** ((exponent - 1) / 2)
    return found


def _typical_at_unit_rate(seen: Observed) -> float:
    """A force that matters at the rates seen, for an exponent of a half, N at 1 m/s."""
    return 0.3 * seen.damping * float(np.sqrt(max(seen.rate_rms, 1e-12)))


_ORIFICES = (0.15, float("inf"))  # exponents that are made (Constantinou and Symans 1993); below them it is friction
_EXPONENT, _LEFT = 0.4, 0.05  # to begin with; of the damper that was read, beside it


def _read_as_linear(read: FittedElement) -> tuple[Restart, ...]:
    """A fluid damper that is read as this linear one: by the mean slope over a normal rate of the same size.

    The mean slope of C abs(v)^a is C r^(a - 1) E abs(x)^(a + 1), x normal (statistical linearisation, Booton 1954).
    """
    moment = 2 ** ((_EXPONENT + 1) / 2) * gamma(_EXPONENT / 2 + 1) / sqrt(pi)
    force = (1 - _LEFT) * read.damping * read.rate ** (1 - _EXPONENT) / moment
    return (Restart(1.0, _LEFT, (force, _EXPONENT, 0.05 * read.rate)),)


# Fluid through shaped orifices, as in dampers of buildings and bridges (Constantinou and Symans 1993)
POWER_LAW_DAMPING = ElementLaw(
    name="power_law_damping",
    title="damping with a power of the rate",
    parameters=(
        ParameterSpec("force", "N", 0.0, 1e12, "force at 1 m/s", _typical_at_unit_rate),
        ParameterSpec(
            "exponent", "1", 0.1, 0.95, "of the rate: 1 is a linear damper", lambda seen: 0.5, plausible=_ORIFICES
        ),
        replace(SMOOTHING, meaning="rate below which the force is linear"),
    ),
    force=_power,
    formula="force * v * (v ** 2 + smoothing ** 2) ** ((exponent - 1) / 2)",
    shapes=lambda seen: grid([_typical_at_unit_rate(seen)], [0.2, 0.4, 0.7], [0.05 * seen.rate_rms]),
    absent=(0.0, 1.0, 1.0),
    looks_like="damping that grows ever more slowly with the rate, without a knee",
    confused_with=("coulomb_friction", "damper_blowoff"),
    sentence="the damper has a force of {force} at 1 m/s, with the rate to the power of {exponent}",
    prior_cost=RARE,
    restarts=_read_as_linear,
)

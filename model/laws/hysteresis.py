"""Elements with memory: damper with series stiffness (Maxwell), air spring (Zener), Bouc-Wen hysteresis."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from sprung.model.laws.base import (
    RARE,
    ElementLaw,
    FittedElement,
    Maxwell,
    ParameterSpec,
    Restart,
    Values,
    grid,
    with_wider_form,
)
from sprung.model.laws.motion import Motion, Observed, SpringDamper
from sprung.model.laws.paths import maxwell_path
from sprung.model.laws.reversals import GAMMA, bouc_wen_memory
from sprung.model.signals import FloatArray

# Corner frequencies, Hz, at which a branch with a spring and a damper in series is sought
_STRONGER = 2.6  # a damper behind a spring over its reading, where nominal is no more
_CORNERS = np.array([0.5, 1.2, 3.0, 6.0, 10.0, 16.0, 25.0, 40.0, 70.0])


def _series_force(motion: Motion, p: Values, element: SpringDamper) -> FloatArray:
    (branch,) = motion.memory  # N, force of spring and damper in series
    found: FloatArray = branch - element.damping * motion.rate
    return found


def _series_rate(motion: Motion, p: Values, element: SpringDamper) -> FloatArray:
    (ks,) = p
    (branch,) = motion.memory
    found: FloatArray = (ks * (motion.rate - branch / element.damping))[None]
    return found


def _series_decay(p: Values, element: SpringDamper) -> FloatArray:
    (ks,) = p
    return np.asarray(ks / element.damping)[None]


def _series_start(motion: Motion, p: Values, element: SpringDamper) -> FloatArray:
    return np.asarray(element.damping * motion.rate)[None]  # the branch without its spring


def _series_branch(p: Values, damping: float) -> Maxwell:
    return Maxwell(p[0], damping / p[0], damping)


def _behind_a_spring(read: FittedElement) -> tuple[Restart, ...]:
    """A damper that gives way was read as a weaker one beside a stiffer spring: start from a stronger one, too.

    At w, c behind ks acts as a damper c / (1 + r^2) and a spring w c r / (1 + r^2), r = w c / ks.  With w the motion's
    mean frequency, ks and the change of the spring follow from the assumed c and from the damping that was read.
    """
    assumed = max(_STRONGER * read.damping, read.nominal_damping)
    ratio = float(np.sqrt(assumed / read.damping - 1))
    read_as_spring = read.frequency * read.damping * ratio
    softer = max(1 - read_as_spring / read.stiffness, 0.5) if read.stiffness > 0 else 1.0
    return (Restart(softer, assumed / read.damping, (read.frequency * assumed / ratio,)),)


SERIES_STIFFNESS = ElementLaw(
    name="series_stiffness",
    title="series stiffness of the damper",
    parameters=(
        ParameterSpec(
            "ks",
            "N/m",
            1e-6,
            1e12,
            "stiffness of the damper's bushings and oil",
            lambda seen: seen.damping * 2 * np.pi * 10,
            log=True,
        ),
    ),
    force=_series_force,
    formula="z - c * v",
    memory_formula="ks * (v - z / c)",
    shapes=lambda seen: grid(max(seen.damping, 1e-12) * 2 * np.pi * _CORNERS),
    absent=(np.inf,),
    looks_like="the damper acts like a spring at high frequencies: less damping, more stiffness there; linear",
    confused_with=("air_spring", "sensor_lag", "damper_blowoff", "flexible_mode"),
    sentence="the damper gives way through a stiffness of {ks} in series",
    strength=None,
    memory=1,
    memory_rate=_series_rate,
    memory_decay=_series_decay,
    memory_start=_series_start,
    branch=_series_branch,
    restarts=_behind_a_spring,
)


def _air_force(motion: Motion, p: Values, element: SpringDamper) -> FloatArray:
    (branch,) = motion.memory
    found: FloatArray = branch
    return found


def _air_rate(motion: Motion, p: Values, element: SpringDamper) -> FloatArray:
    stiffness, tau = p
    (branch,) = motion.memory
    found: FloatArray = (stiffness * motion.rate - branch / tau)[None]
    return found


def _air_path(motion: Motion, p: Values) -> FloatArray:
    stiffness, tau = p
    found: FloatArray = stiffness * maxwell_path(motion.deflection, tau, float(motion.time[1] - motion.time[0]))
    return found


def _air_decay(p: Values, element: SpringDamper) -> FloatArray:
    _, tau = p
    return np.asarray(1 / tau)[None]


AIR_SPRING = ElementLaw(
    name="air_spring",
    title="air spring with a reservoir behind an orifice",
    parameters=(
        ParameterSpec(
            "stiffness", "N/m", 0.0, 1e12, "gain of stiffness when no air flows", lambda s: 0.3 * s.stiffness
        ),
        ParameterSpec("tau", "s", 1e-4, 1e4, "time in which reservoir and bellows even out", lambda s: 0.1, log=True),
    ),
    force=_air_force,
    formula="z",
    memory_formula="stiffness * v - z / tau",
    shapes=lambda seen: grid([0.3 * seen.stiffness], 1 / (2 * np.pi * _CORNERS)),
    absent=(0.0, 1.0),
    looks_like="soft below and stiff above a frequency, with most damping between; linear",
    confused_with=("series_stiffness", "time_varying_stiffness", "sensor_lag"),
    sentence="an air spring: stiffer by {stiffness} above the exchange time of {tau}",
    memory=1,
    memory_rate=_air_rate,
    memory_decay=_air_decay,
    branch=lambda p, damping: Maxwell(p[0], p[1], 0.0),
    path=_air_path,
    prior_cost=RARE,
)


def _bouc_wen_force(motion: Motion, p: Values, element: SpringDamper) -> FloatArray:
    alpha = p[0]
    (z,) = motion.memory
    found: FloatArray = alpha * z
    return found


def _bouc_wen_rate(motion: Motion, p: Values, element: SpringDamper) -> FloatArray:
    _, beta, n, *further = p
    gamma = further[0] if further else GAMMA
    (z,) = motion.memory
    v = motion.rate
    found: FloatArray = (v - beta * np.abs(z) ** n * (np.copysign(v, z) + gamma * v))[None]
    return found


def _bouc_wen_rates(motion: Motion, p: Values) -> Callable[[int, FloatArray], FloatArray]:
    _, beta, n, *further = p
    v = motion.rate
    turning, yielding = beta * v, (further[0] if further else GAMMA) * beta * v
    linear = np.ndim(n) == 0 and n == 1

    def rate(i: int, z: FloatArray) -> FloatArray:
        size = np.abs(z) if linear else np.abs(z) ** n
        found: FloatArray = v[i] - size * (np.copysign(turning[i], z) + yielding[i])
        return found

    return rate


def _bouc_wen_path(motion: Motion, p: Values) -> FloatArray:
    alpha, beta, exponent, *gamma = p
    found: FloatArray = alpha * bouc_wen_memory(motion.deflection, beta, exponent, *gamma)
    return found


def _bouc_wen_shapes(seen: Observed) -> FloatArray:
    n = np.array([1.0, 2.0])
    yields = max(seen.deflection_rms, 1e-12) * np.array([0.03, 0.1, 0.3, 1.0])
    trials = grid([0.2 * seen.stiffness], yields, n)
    trials[:, 1] = 1 / (1.5 * trials[:, 1] ** trials[:, 2])  # beta at which z saturates at the yield deflection
    return trials


def _free_shapes(seen: Observed) -> FloatArray:
    yields = max(seen.deflection_rms, 1e-12) * np.array([0.03, 0.1, 0.3, 1.0])
    return grid([0.2 * seen.stiffness], 1 / (1.5 * yields), [1.0], [-1.4, -0.7, 0.0, 1.5])


def _other_yields(p: Values) -> tuple[tuple[float, ...], ...]:
    """The same force at yield over a quarter and over four times of the deflection."""
    alpha, beta, n, *further = p
    return tuple((alpha / factor, beta / factor**n, n, *further) for factor in (0.25, 4.0))


_BOUC_WEN = ElementLaw(
    name="bouc_wen",
    title="hysteresis (Bouc-Wen)",
    parameters=(
        ParameterSpec("alpha", "N/m", 0.0, 1e12, "stiffness of the hysteretic part", lambda s: 0.2 * s.stiffness),
        ParameterSpec(
            "beta", "m^-n", 1e-6, 1e60, "inverse of the yield deflection^n, times 2/3", lambda s: 0.0, log=True
        ),
        ParameterSpec("n", "1", 1.0, 8.0, "sharpness of the yielding", lambda seen: 1.0, minor=True),
    ),
    force=_bouc_wen_force,
    formula="alpha * z",
    memory_formula="v - beta * abs(z)**n * (abs(v) * sign(z) + 0.5 * v)",
    shapes=_bouc_wen_shapes,
    absent=(0.0, 1.0, 1.0),
    looks_like="stiff for small reversals, then slipping; a loop whose area depends on amplitude, not on rate",
    confused_with=("coulomb_friction", "clearance", "series_stiffness"),
    sentence="a hysteretic part of {alpha} that yields (beta = {beta}, n = {n})",
    memory=1,
    memory_rate=_bouc_wen_rate,
    memory_rates=_bouc_wen_rates,
    path=_bouc_wen_path,
    alike=_other_yields,
)
# The loop's shape free: gamma below -1 stiffens while it is loaded, above 1 it hardly yields while it is unloaded
_FREE = ParameterSpec("gamma", "1", -4.0, 4.0, "in z' = v - beta (abs(v) z + gamma v abs(z))", lambda seen: GAMMA)
BOUC_WEN = with_wider_form(
    _BOUC_WEN,
    _FREE,
    shapes=_free_shapes,
    absent=(*_BOUC_WEN.absent, GAMMA),
    widened=lambda p, seen: ((*p, GAMMA),),
    prior_cost=RARE,
    sentence="a hysteretic part of {alpha} that yields (beta = {beta}, n = {n}, gamma = {gamma})",
    memory_formula="v - beta * abs(z)**n * (abs(v) * sign(z) + gamma * v)",
)

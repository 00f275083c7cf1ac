"""Dampers of the catalogue, and springs behind them, as pieces of a component's force: see `pieces`."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sprung.model.diagnosis.force.piece import FittedPiece, Piece, admissible, wider_form
from sprung.model.diagnosis.force.sizes import MotionSizes, rates_at
from sprung.model.laws import SpringDamper, grid
from sprung.model.laws.damping import DAMPER_ASYMMETRY, DAMPER_BLOWOFF, POWER_LAW_DAMPING, QUADRATIC_DAMPING
from sprung.model.laws.hysteresis import AIR_SPRING, SERIES_STIFFNESS

_EXPONENT = admissible(POWER_LAW_DAMPING, "exponent")
_LOW = 0.02  # of the lowest knee that is searched: no limit beside what the motion resolves


def _knee_limits(seen: MotionSizes) -> tuple[float, float]:
    return (seen.lowest_knee, float(seen.rate[97]))


def _damping(element: SpringDamper) -> float:
    return max(float(element.damping), 1e-300)


def _apart_from_zero(value: float) -> float:
    return value if value != 0 else 1e-300


def _admissible_asymmetry(fitted: FittedPiece) -> bool:
    """Whether the damper pushes the right way in both directions."""
    low, high = admissible(DAMPER_ASYMMETRY, "a")
    return low <= fitted.values["a"] <= high


def _opens_late_enough(fitted: FittedPiece) -> bool:
    """A plausible valve: lower slope beyond the knee, and knees that the sampling resolves."""
    ratios = [fitted.values[name] for name in ("ratio", "ratio_compression") if name in fitted.values]
    knees = [fitted.values[name] for name in ("knee", "knee_compression") if name in fitted.values]
    least, most = fitted.rules.valve_least, admissible(DAMPER_BLOWOFF, "ratio")[1]
    return all(least <= r < most for r in ratios) and all(k > fitted.corner for k in knees)


_QUADRATIC = Piece(
    QUADRATIC_DAMPING,
    signs=(1,),
    parameters=lambda a, s, e: (a[0],),
    strengthened=True,
)
_POWER = Piece(
    POWER_LAW_DAMPING,
    shapes=("exponent", "smoothing"),
    grid=lambda seen: grid([0.15, 0.3, 0.45, 0.6, 0.8], seen.rate_rms * np.array([0.005, 0.1])),
    limits=lambda seen: [_EXPONENT, (1e-3 * seen.rate_rms, 0.5 * seen.rate_rms)],
    signs=(1,),
    parameters=lambda a, s, e: (a[0], s[0], s[1]),
    shape_of=lambda p: (p[1], p[2]),
    quoted=lambda a, s, e: {"force_at_0.1_m/s": (a[0] * 0.1 ** s[0], "N")},
    plausible=lambda fitted: _EXPONENT[0] < fitted.shape[0] < _EXPONENT[1],
    strengthened=True,
)
_BLOWOFF = Piece(
    DAMPER_BLOWOFF,
    shapes=("knee",),
    grid=lambda seen: grid(rates_at(seen, [0.2, 0.35, 0.5, 0.65, 0.8, 0.9])),
    limits=lambda seen: [_knee_limits(seen)],
    signs=(-1,),
    parameters=lambda a, s, e: (s[0], 1 + a[0] / _damping(e)),
    shape_of=lambda p: (p[0],),
    quoted=lambda a, s, e: {"force_at_knee": (float(e.damping) * s[0], "N")},
    plausible=_opens_late_enough,
)
LOW_VALVE = replace(_BLOWOFF, limits=lambda seen: [(_LOW * seen.lowest_knee, float(seen.rate[97]))])
_TWO_KNEES = Piece(
    wider_form(DAMPER_BLOWOFF),
    shapes=("knee", "knee_compression"),
    grid=lambda seen: grid(rates_at(seen, [0.2, 0.4, 0.7]), rates_at(seen, [0.2, 0.4, 0.7])),
    limits=lambda seen: [_knee_limits(seen)] * 2,
    signs=(-1, -1),
    parameters=lambda a, s, e: (s[0], 1 + a[0] / _damping(e), s[1], 1 + a[1] / _damping(e)),
    shape_of=lambda p: (p[0], p[2]),
    plausible=_opens_late_enough,
)
_ASYMMETRY = Piece(
    DAMPER_ASYMMETRY,
    signs=(0,),
    parameters=lambda a, s, e: (a[0] / _damping(e),),
    plausible=_admissible_asymmetry,
)
_ASYMMETRY_OF_VALVES = Piece(
    wider_form(DAMPER_ASYMMETRY),
    shapes=("knee",),
    grid=lambda seen: grid(rates_at(seen, [0.2, 0.4, 0.7])),
    limits=lambda seen: [_knee_limits(seen)],
    signs=(0, 0),  # of the rate's magnitude, and of the part below the knee
    parameters=lambda a, s, e: ((a[0] + a[1]) / _damping(e), s[0], a[0] / _apart_from_zero(a[0] + a[1])),
    shape_of=lambda p: (p[1],),
    plausible=lambda fitted: _opens_late_enough(fitted) and _admissible_asymmetry(fitted),
)
_SERIES = Piece(
    SERIES_STIFFNESS,
    shapes=("tau",),
    grid=lambda seen: grid(np.geomspace(2 * seen.step, 0.1 * seen.seconds, 9)),
    limits=lambda seen: [(0.5 * seen.step, seen.seconds)],
    signs=(1,),
    parameters=lambda a, s, e: (a[0],),
    shape_of=lambda p: (0.1,),
    quoted=lambda a, s, e: {"relaxation_time": (s[0], "s")},
    acting=AIR_SPRING,  # the branch of spring and damper in series, with a damper beside it that is free
    acting_parameters=lambda a, s, e: (a[0], s[0]),
)

DAMPING_PIECES: tuple[Piece, ...] = (
    _QUADRATIC,
    _POWER,
    _BLOWOFF,
    _TWO_KNEES,
    _ASYMMETRY,
    _ASYMMETRY_OF_VALVES,
    _SERIES,
)

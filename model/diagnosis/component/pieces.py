"""The laws of the catalogue as pieces of a component's force: strengths, shapes, and their search ranges.

The laws themselves are defined in `model.laws`.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sprung.model.diagnosis.component.piece import (
    ELASTIC,
    FRICTION,
    HYSTERESIS,
    FittedPiece,
    MotionSizes,
    Piece,
    Shape,
    Values,
    no_shapes,
    rates_at,
)
from sprung.model.laws import ElementLaw, SpringDamper, grid
from sprung.model.laws.damping import COULOMB_FRICTION, DAMPER_ASYMMETRY, DAMPER_BLOWOFF, QUADRATIC_DAMPING
from sprung.model.laws.drift import TIME_VARYING_DAMPING, TIME_VARYING_STIFFNESS
from sprung.model.laws.friction import DAHL, LUGRE, STRIBECK
from sprung.model.laws.gas import GAS_SPRING
from sprung.model.laws.hysteresis import AIR_SPRING, BOUC_WEN, SERIES_STIFFNESS
from sprung.model.laws.lost_motion import FRICTION_BACKLASH, PINCHED_HYSTERESIS
from sprung.model.laws.paths import stop_path
from sprung.model.laws.reversals import GAMMA
from sprung.model.laws.stiffness import BUMP_STOP, CLEARANCE, CUBIC_STIFFNESS, PROGRESSIVE_STOP
from sprung.model.laws.viscoelastic import FRACTIONAL_STIFFNESS
from sprung.model.signals import FloatArray

_SHARPEST = 1e-6  # distance of an exponent from 1 below which it is 1
_POLYTROPIC = 1.3  # of a gas; not identifiable beside the column's length at usual rates


def _yields(seen: MotionSizes) -> FloatArray:
    return seen.travel * np.geomspace(0.004, 0.8, 9)


def _yield_limits(seen: MotionSizes) -> tuple[float, float]:
    return (2e-4 * seen.travel, 0.8 * seen.travel)  # a larger yield displacement is a softening spring


def _knee_limits(seen: MotionSizes) -> tuple[float, float]:
    return (seen.lowest_knee, float(seen.rate[97]))


def _damping(element: SpringDamper) -> float:
    return max(float(element.damping), 1e-300)


def _apart_from_zero(value: float) -> float:
    return value if value != 0 else 1e-300


def _opens_late_enough(fitted: FittedPiece) -> bool:
    """A plausible valve: lower slope beyond the knee, and knees that the sampling resolves."""
    ratios = [fitted.values[name] for name in ("ratio", "ratio_compression") if name in fitted.values]
    knees = [fitted.values[name] for name in ("knee", "knee_compression") if name in fitted.values]
    least, most = fitted.rules.valve_least, fitted.rules.valve_most
    return all(least <= r < most for r in ratios) and all(k > fitted.corner for k in knees)


def _falls(fitted: FittedPiece) -> bool:
    """Whether the fall of a friction with the rate was observed to a sufficient part."""
    force, static = fitted.values["force"], fitted.values["static_force"]
    fall, smoothing = fitted.values["stribeck_rate"], fitted.values["smoothing"]
    rate = fall * np.linspace(0.0, 3.0, 301)
    shown = np.tanh(rate / smoothing) * (force + (static - force) * np.exp(-((rate / fall) ** 2)))
    return bool(shown.max() - force > fitted.rules.seen_to_fall * (static - force))


def _slips(fitted: FittedPiece) -> bool:
    """Whether it slips at all; otherwise it is a spring with a gap."""
    gap, reach = fitted.shape
    u = np.abs(stop_path(fitted.deflection, 0.5 * gap + reach))
    return bool(np.mean(u > 0.999 * (0.5 * gap + reach)) > fitted.rules.slips)


def _loose_within(fitted: FittedPiece) -> bool:
    """Whether the spring keeps no force within the gap."""
    return bool(abs(fitted.strengths[0] / max(fitted.element.stiffness, 1e-300) - 1) < fitted.rules.lost)


def _held_within(fitted: FittedPiece) -> bool:
    """Whether there is a force before the stop; otherwise it is a spring with clearance."""
    return bool(fitted.element.stiffness > fitted.rules.lost * np.max(fitted.strengths))


def _softest_within(fitted: FittedPiece) -> bool:
    """Whether the softest point, -k2 / (3 k3), lies within the travel."""
    travel = 0.5 * float(np.ptp(fitted.deflection))
    return bool(abs(fitted.values["k2"]) < 3 * abs(fitted.values["k3"]) * travel)


def _stops(fitted: FittedPiece) -> bool:
    """Whether a two-sided stop is stiff where it is compressed most; a soft one corrects the spring."""
    middle = 0.5 * (fitted.deflection.max() + fitted.deflection.min())
    d = fitted.deflection - middle
    depths = np.maximum([d.max() - fitted.shape[0], -d.min() - fitted.shape[1]], 0.0)
    power = fitted.values.get("exponent", 1.0) - 1
    hardest = np.max(fitted.strengths * (depths / np.array(fitted.shape[:2])) ** power)
    return _held_within(fitted) and bool(hardest > fitted.rules.stops * fitted.element.stiffness)


def _wider(law: ElementLaw) -> ElementLaw:
    assert law.wider is not None
    return law.wider


def _yield_words(a: FloatArray, s: Shape, e: SpringDamper) -> Values:
    return {"yield_force": (a[0], "N"), "yield_displacement": (s[0], "m")}


# --- friction and hysteresis ------------------------------------------------------------------------------------

_COULOMB = Piece(
    COULOMB_FRICTION,
    ("smoothing",),
    lambda seen: grid(seen.rate_rms * np.geomspace(0.005, 0.5, 7)),
    lambda seen: [(1e-3 * seen.rate_rms, 0.8 * seen.rate_rms)],
    (1,),
    lambda a, s, e: (a[0], s[0]),
    lambda p: (p[1],),
    lambda a, s, e: {"breakaway_force": (a[0], "N")},
    kind=FRICTION,
    at_low_rates=DAMPER_BLOWOFF,
)
_STRIBECK = Piece(
    STRIBECK,
    ("smoothing", "stribeck_rate"),
    lambda seen: grid(seen.rate_rms * np.geomspace(0.005, 0.2, 4), seen.rate_rms * np.geomspace(0.05, 0.8, 4)),
    lambda seen: [(1e-3 * seen.rate_rms, 0.5 * seen.rate_rms), (0.01 * seen.rate_rms, 1.5 * seen.rate_rms)],
    (1, 1),
    lambda a, s, e: (a[0], a[0] + a[1], s[1], s[0]),
    lambda p: (p[3], p[2]),
    lambda a, s, e: {"breakaway_force": (a[0] + a[1], "N")},
    kind=FRICTION,
    plain=1,
    believed=_falls,
)
_DAHL = Piece(
    DAHL,
    ("yield_displacement",),
    lambda seen: grid(_yields(seen)),
    lambda seen: [_yield_limits(seen)],
    (1,),
    lambda a, s, e: (a[0], a[0] / s[0]),
    lambda p: (p[0] / p[1],),
    _yield_words,
    kind=HYSTERESIS,
    plain=1,
)
_LUGRE = Piece(
    LUGRE,
    ("yield_displacement", "stribeck_rate", "excess"),
    lambda seen: grid(
        seen.travel * np.geomspace(0.004, 0.3, 4), seen.rate_rms * np.geomspace(0.05, 0.8, 3), [0.3, 1.5]
    ),
    lambda seen: [_yield_limits(seen), (0.01 * seen.rate_rms, 1.5 * seen.rate_rms), (1e-3, 3.0)],
    (1,),
    lambda a, s, e: (a[0], a[0] * (1 + s[2]), s[1], a[0] / s[0]),
    lambda p: (p[0] / p[3], p[2], p[1] / p[0] - 1),
    _yield_words,
    kind=HYSTERESIS,
    plain=1,
)


def _loop(a: FloatArray, s: Shape, e: SpringDamper) -> tuple[float, ...]:
    """Parameters of the Bouc-Wen law from yield force (strength), yield displacement, exponent and gamma (shapes)."""
    n = 1.0 if s[1] < 1 + _SHARPEST else s[1]
    gamma = s[2] if len(s) > 2 else GAMMA
    return (a[0] / s[0], 1 / ((1 + gamma) * s[0] ** n), n, *s[2:])


def _loop_shape(p: Sequence[float]) -> tuple[float, ...]:
    gamma = p[3] if len(p) > 3 else GAMMA
    return (((1 + gamma) * p[1]) ** (-1 / p[2]), p[2], *p[3:])


_BOUC_WEN = Piece(
    BOUC_WEN,
    ("yield_displacement", "n"),
    lambda seen: grid(_yields(seen), [1.0, 2.0]),
    lambda seen: [_yield_limits(seen), (1.0, 8.0)],
    (1,),
    _loop,
    _loop_shape,
    _yield_words,
    kind=HYSTERESIS,
)
_FREE_BOUC_WEN = Piece(
    _wider(BOUC_WEN),
    ("yield_displacement", "n", "gamma"),
    lambda seen: grid(_yields(seen)[::2], [1.0], [-0.6, 0.0, 1.5]),
    lambda seen: [_yield_limits(seen), (1.0, 8.0), (-0.95, 4.0)],
    (1,),
    _loop,
    _loop_shape,
    _yield_words,
    kind=HYSTERESIS,
)
_PINCHED = Piece(
    PINCHED_HYSTERESIS,
    ("yield_displacement", "pinching_width"),
    lambda seen: grid(seen.travel * np.geomspace(0.01, 0.4, 5), seen.travel * np.array([0.1, 0.25, 0.5])),
    lambda seen: [_yield_limits(seen), (0.03 * seen.travel, 1.0 * seen.travel)],
    (1, -1),
    lambda a, s, e: (a[0], s[0], -a[1] / max(a[0], 1e-300), s[1]),
    lambda p: (p[1], p[3]),
    lambda a, s, e: {"yield_force": (a[0], "N")},
    kind=HYSTERESIS,
    plain=2,
)


def _inner(a: FloatArray, s: Shape) -> float:
    """Stiffness within the gap, N/m."""
    return float(a[1] / (0.5 * s[0] + s[1]))


_BACKLASH = Piece(
    _wider(FRICTION_BACKLASH),
    ("gap", "reach"),
    lambda seen: grid(seen.travel * np.geomspace(0.02, 0.9, 7), seen.travel * np.geomspace(0.01, 0.5, 6)),
    lambda seen: [(2e-3 * seen.travel, 1.8 * seen.travel), (1e-3 * seen.travel, 1.5 * seen.travel)],
    (1, 1),
    lambda a, s, e: (a[0] + a[1], s[0], a[0] / s[1] + _inner(a, s), _inner(a, s)),
    lambda p: (p[1], (p[0] - 0.5 * p[1] * (p[3] if len(p) > 3 else 0.0)) / p[2]),
    lambda a, s, e: {"slip_force": (a[0] + a[1], "N"), "lost_motion": (s[0], "m")},
    kind=HYSTERESIS,
    believed=_slips,
)

# --- dampers ----------------------------------------------------------------------------------------------------

_QUADRATIC = Piece(QUADRATIC_DAMPING, (), no_shapes, lambda seen: [], (1,), lambda a, s, e: (a[0],), lambda p: ())
_BLOWOFF = Piece(
    DAMPER_BLOWOFF,
    ("knee",),
    lambda seen: grid(rates_at(seen, [0.2, 0.35, 0.5, 0.65, 0.8, 0.9])),
    lambda seen: [_knee_limits(seen)],
    (-1,),
    lambda a, s, e: (s[0], 1 + a[0] / _damping(e)),
    lambda p: (p[0],),
    lambda a, s, e: {"force_at_knee": (float(e.damping) * s[0], "N")},
    believed=_opens_late_enough,
)
_TWO_KNEES = Piece(
    _wider(DAMPER_BLOWOFF),
    ("knee", "knee_compression"),
    lambda seen: grid(rates_at(seen, [0.2, 0.4, 0.7]), rates_at(seen, [0.2, 0.4, 0.7])),
    lambda seen: [_knee_limits(seen)] * 2,
    (-1, -1),
    lambda a, s, e: (s[0], 1 + a[0] / _damping(e), s[1], 1 + a[1] / _damping(e)),
    lambda p: (p[0], p[2]),
    plain=1,
    believed=_opens_late_enough,
)
_ASYMMETRY = Piece(
    DAMPER_ASYMMETRY,
    (),
    no_shapes,
    lambda seen: [],
    (0,),
    lambda a, s, e: (a[0] / _damping(e),),
    lambda p: (),
    believed=lambda fitted: abs(fitted.values["a"]) <= 1.0,
)
_ASYMMETRY_OF_VALVES = Piece(
    _wider(DAMPER_ASYMMETRY),
    ("knee",),
    lambda seen: grid(rates_at(seen, [0.2, 0.4, 0.7])),
    lambda seen: [_knee_limits(seen)],
    (0, 0),  # of the rate's magnitude, and of the part below the knee
    lambda a, s, e: ((a[0] + a[1]) / _damping(e), s[0], a[0] / _apart_from_zero(a[0] + a[1])),
    lambda p: (p[1],),
    plain=1,
    believed=lambda fitted: _opens_late_enough(fitted) and abs(fitted.values["a"]) <= 1.0,
)
_SERIES = Piece(
    SERIES_STIFFNESS,
    ("tau",),
    lambda seen: grid(np.geomspace(2 * seen.step, 0.1 * seen.seconds, 9)),
    lambda seen: [(0.5 * seen.step, seen.seconds)],
    (1,),
    lambda a, s, e: (a[0],),
    lambda p: (0.1,),
    lambda a, s, e: {"relaxation_time": (s[0], "s")},
    acting=AIR_SPRING,  # the branch of spring and damper in series, with a damper beside it that is free
    acting_parameters=lambda a, s, e: (a[0], s[0]),
)

# --- springs ----------------------------------------------------------------------------------------------------

_CUBIC = Piece(
    CUBIC_STIFFNESS,
    (),
    no_shapes,
    lambda seen: [],
    (0,),
    lambda a, s, e: (a[0],),
    lambda p: (),
    kind=ELASTIC,
)
_CUBIC_OFF_CENTRE = Piece(
    _wider(CUBIC_STIFFNESS),
    (),
    no_shapes,
    lambda seen: [],
    (0, 0),
    lambda a, s, e: (a[0], a[1]),
    lambda p: (),
    kind=ELASTIC,
    plain=1,
    believed=_softest_within,
    imitates=True,
)
_BUMP_STOP = Piece(
    BUMP_STOP,
    ("gap",),
    lambda seen: grid(seen.travel * np.array([0.3, 0.5, 0.65, 0.8, 0.9])),
    lambda seen: [(0.1 * seen.travel, 0.97 * seen.travel)],
    (1,),
    lambda a, s, e: (s[0], a[0]),
    lambda p: (p[0],),
    kind=ELASTIC,
    believed=_held_within,
)
_TWO_STOPS = Piece(
    _wider(BUMP_STOP),
    ("gap", "gap_compression"),
    lambda seen: grid(*[seen.travel * np.array([0.3, 0.5, 0.7, 0.85])] * 2),
    lambda seen: [(0.25 * seen.travel, 0.97 * seen.travel)] * 2,
    (1, 1),
    lambda a, s, e: (s[0], a[0], s[1], a[1]),
    lambda p: (p[0], p[2]),
    kind=ELASTIC,
    plain=1,
    believed=_stops,
    imitates=True,
)
_PROGRESSIVE_STOP = Piece(
    PROGRESSIVE_STOP,
    ("gap", "gap_compression", "exponent"),
    lambda seen: grid(*[seen.travel * np.array([0.3, 0.5, 0.75])] * 2, [1.5, 2.5]),
    lambda seen: [(0.25 * seen.travel, 0.97 * seen.travel)] * 2 + [(1.0, 3.5)],  # nearer, it is a progressive spring
    (1, 1),
    lambda a, s, e: (s[0], a[0], s[1], a[1], s[2]),
    lambda p: (p[0], p[2], p[4]),
    kind=ELASTIC,
    plain=2,
    believed=_stops,
    imitates=True,
)
_CLEARANCE = Piece(
    CLEARANCE,
    ("gap",),
    lambda seen: grid(seen.travel * np.array([0.05, 0.1, 0.2, 0.35, 0.55, 0.75])),
    lambda seen: [(0.01 * seen.travel, 0.9 * seen.travel)],
    (1,),
    lambda a, s, e: (s[0],),
    lambda p: (p[0],),
    kind=ELASTIC,
    believed=_loose_within,
)
_GAS_SPRING = Piece(
    GAS_SPRING,
    ("length",),
    lambda seen: grid(seen.travel * np.array([1.3, 2.0, 4.0, 10.0])),
    lambda seen: [(1.1 * seen.travel, 30.0 * seen.travel)],
    (1,),
    lambda a, s, e: (a[0], s[0], _POLYTROPIC),
    lambda p: (p[1],),
    kind=ELASTIC,
    plain=1,
)

_FRACTIONAL = Piece(
    FRACTIONAL_STIFFNESS,
    ("order",),
    lambda seen: grid([0.1, 0.2, 0.35, 0.55]),
    lambda seen: [(0.03, 0.9)],
    (1,),
    lambda a, s, e: (a[0], s[0]),
    lambda p: (p[1],),
    plain=1,
)

# --- drift ------------------------------------------------------------------------------------------------------


def _drift(law: ElementLaw, quantity: str) -> Piece:
    return Piece(
        law,
        ("tau",),
        lambda seen: grid(seen.seconds * np.array([0.1, 0.3, 1.0])),
        lambda seen: [(0.03 * seen.seconds, 3.0 * seen.seconds)],
        (0,),
        lambda a, s, e: (a[0] / max(float(getattr(e, quantity)), 1e-300), s[0]),
        lambda p: (p[1],),
        plain=1,
        believed=lambda fitted: fitted.shape[0] > fitted.rules.drift * fitted.seconds,
    )


PIECES: tuple[Piece, ...] = (
    _COULOMB,
    _STRIBECK,
    _DAHL,
    _LUGRE,
    _BOUC_WEN,
    _FREE_BOUC_WEN,
    _PINCHED,
    _BACKLASH,
    _QUADRATIC,
    _BLOWOFF,
    _TWO_KNEES,
    _ASYMMETRY,
    _ASYMMETRY_OF_VALVES,
    _SERIES,
    _CUBIC,
    _CUBIC_OFF_CENTRE,
    _BUMP_STOP,
    _TWO_STOPS,
    _PROGRESSIVE_STOP,
    _CLEARANCE,
    _GAS_SPRING,
    _FRACTIONAL,
    _drift(TIME_VARYING_STIFFNESS, "stiffness"),
    _drift(TIME_VARYING_DAMPING, "damping"),
)

"""Friction and hysteresis of the catalogue as pieces of a component's force: see `pieces`."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sprung.model.diagnosis.force.piece import (
    FRICTION,
    HYSTERESIS,
    FittedPiece,
    Piece,
    Shape,
    Values,
    admissible,
    wider_form,
)
from sprung.model.diagnosis.force.pieces_damping import LOW_VALVE
from sprung.model.diagnosis.force.sizes import MotionSizes
from sprung.model.laws import SpringDamper, grid
from sprung.model.laws.damping import COULOMB_FRICTION
from sprung.model.laws.friction import DAHL, LUGRE, STRIBECK
from sprung.model.laws.hysteresis import BOUC_WEN
from sprung.model.laws.lost_motion import FRICTION_BACKLASH, PINCHED_HYSTERESIS
from sprung.model.laws.paths import stop_path
from sprung.model.laws.reversals import GAMMA
from sprung.model.signals import FloatArray

_SHARPEST = 1e-6  # distance of an exponent from 1 below which it is 1


def _yields(seen: MotionSizes) -> FloatArray:
    return seen.travel * np.geomspace(0.004, 0.8, 9)


def _yield_limits(seen: MotionSizes) -> tuple[float, float]:
    return (2e-4 * seen.travel, 0.8 * seen.travel)  # a larger yield displacement is a softening spring


def _falls(fitted: FittedPiece) -> bool:
    """Whether the fall of a friction with the rate was observed to a sufficient part."""
    force, static = fitted.values["force"], fitted.values["static_force"]
    fall, smoothing = fitted.values["stribeck_rate"], fitted.values["smoothing"]
    rate = fall * np.linspace(0.0, 3.0, 301)
    shown = np.tanh(rate / smoothing) * (force + (static - force) * np.exp(-((rate / fall) ** 2)))
    return bool(shown.max() - force > fitted.rules.seen_to_fall * (static - force))


def _rises(fitted: FittedPiece) -> bool:
    """Whether friction was observed both at creeping rates and where it hardly changes any more."""
    smoothing, rate = fitted.shape
    fastest = float(np.max(np.abs(np.diff(fitted.deflection)))) / fitted.step
    return smoothing < rate and 1 - np.exp(-fastest / rate) > fitted.rules.seen_to_fall


def _slips(fitted: FittedPiece) -> bool:
    """Whether it slips at all; otherwise it is a spring with a gap."""
    gap, reach = fitted.shape
    u = np.abs(stop_path(fitted.deflection, 0.5 * gap + reach))
    return bool(np.mean(u > 0.999 * (0.5 * gap + reach)) > fitted.rules.slips)


def _yield_words(a: FloatArray, s: Shape, e: SpringDamper) -> Values:
    return {"yield_force": (a[0], "N"), "yield_displacement": (s[0], "m")}


_COULOMB = Piece(
    COULOMB_FRICTION,
    shapes=("smoothing",),
    grid=lambda seen: grid(seen.rate_rms * np.geomspace(0.005, 0.5, 7)),
    limits=lambda seen: [(1e-3 * seen.rate_rms, 0.8 * seen.rate_rms)],
    signs=(1,),
    parameters=lambda a, s, e: (a[0], s[0]),
    shape_of=lambda p: (p[1],),
    quoted=lambda a, s, e: {"breakaway_force": (a[0], "N")},
    kind=FRICTION,
    at_low_rates=LOW_VALVE,
    yields_with_rate=True,
    strengthened=True,
)
_SLIDING = Piece(
    wider_form(COULOMB_FRICTION),
    shapes=("smoothing", "rate"),
    grid=lambda seen: grid(seen.rate_rms * np.geomspace(0.005, 0.1, 3), seen.rate_rms * np.geomspace(0.1, 1.0, 4)),
    limits=lambda seen: [(1e-3 * seen.rate_rms, 0.5 * seen.rate_rms), (0.02 * seen.rate_rms, 3.0 * seen.rate_rms)],
    signs=(1, 1),
    parameters=lambda a, s, e: (a[0] + a[1], s[0], a[0], s[1]),
    shape_of=lambda p: (p[1], p[3]),
    quoted=lambda a, s, e: {"breakaway_force": (a[0], "N")},
    kind=FRICTION,
    plausible=_rises,
)
_STRIBECK = Piece(
    STRIBECK,
    shapes=("smoothing", "stribeck_rate"),
    grid=lambda seen: grid(seen.rate_rms * np.geomspace(0.005, 0.2, 4), seen.rate_rms * np.geomspace(0.05, 0.8, 4)),
    limits=lambda seen: [(1e-3 * seen.rate_rms, 0.5 * seen.rate_rms), (0.01 * seen.rate_rms, 1.5 * seen.rate_rms)],
    signs=(1, 1),
    parameters=lambda a, s, e: (a[0], a[0] + a[1], s[1], s[0]),
    shape_of=lambda p: (p[3], p[2]),
    quoted=lambda a, s, e: {"breakaway_force": (a[0] + a[1], "N")},
    kind=FRICTION,
    plausible=_falls,
)
_DAHL = Piece(
    DAHL,
    shapes=("yield_displacement",),
    grid=lambda seen: grid(_yields(seen)),
    limits=lambda seen: [_yield_limits(seen)],
    signs=(1,),
    parameters=lambda a, s, e: (a[0], a[0] / s[0]),
    shape_of=lambda p: (p[0] / p[1],),
    quoted=_yield_words,
    kind=HYSTERESIS,
)
_LUGRE = Piece(
    LUGRE,
    shapes=("yield_displacement", "stribeck_rate", "excess"),
    grid=lambda seen: grid(
        seen.travel * np.geomspace(0.004, 0.3, 4), seen.rate_rms * np.geomspace(0.05, 0.8, 3), [0.3, 1.5]
    ),
    limits=lambda seen: [_yield_limits(seen), (0.01 * seen.rate_rms, 1.5 * seen.rate_rms), (1e-3, 3.0)],
    signs=(1,),
    parameters=lambda a, s, e: (a[0], a[0] * (1 + s[2]), s[1], a[0] / s[0]),
    shape_of=lambda p: (p[0] / p[3], p[2], p[1] / p[0] - 1),
    quoted=_yield_words,
    kind=HYSTERESIS,
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
    shapes=("yield_displacement", "n"),
    grid=lambda seen: grid(_yields(seen), [1.0, 2.0]),
    limits=lambda seen: [_yield_limits(seen), admissible(BOUC_WEN, "n")],
    signs=(1,),
    parameters=_loop,
    shape_of=_loop_shape,
    quoted=_yield_words,
    kind=HYSTERESIS,
    strengthened=True,
)
_FREE = wider_form(BOUC_WEN)
_YIELDS = -0.95  # of gamma: below -1 it stiffens while it is loaded, and has no yield force
_FREE_BOUC_WEN = Piece(
    _FREE,
    shapes=("yield_displacement", "n", "gamma"),
    grid=lambda seen: grid(_yields(seen)[::2], [1.0], [-0.6, 0.0, 1.5]),
    limits=lambda seen: [_yield_limits(seen), admissible(BOUC_WEN, "n"), (_YIELDS, admissible(_FREE, "gamma")[1])],
    signs=(1,),
    parameters=_loop,
    shape_of=_loop_shape,
    quoted=_yield_words,
    kind=HYSTERESIS,
)
_PINCHED = Piece(
    PINCHED_HYSTERESIS,
    shapes=("yield_displacement", "pinching_width"),
    grid=lambda seen: grid(seen.travel * np.geomspace(0.01, 0.4, 5), seen.travel * np.array([0.1, 0.25, 0.5])),
    limits=lambda seen: [_yield_limits(seen), (0.03 * seen.travel, 1.0 * seen.travel)],
    signs=(1, -1),
    parameters=lambda a, s, e: (a[0], s[0], -a[1] / max(a[0], 1e-300), s[1]),
    shape_of=lambda p: (p[1], p[3]),
    quoted=lambda a, s, e: {"yield_force": (a[0], "N")},
    kind=HYSTERESIS,
)


def _inner(a: FloatArray, s: Shape) -> float:
    """Stiffness within the gap, N/m."""
    return float(a[1] / (0.5 * s[0] + s[1]))


_BACKLASH = Piece(
    wider_form(FRICTION_BACKLASH),
    shapes=("gap", "reach"),
    grid=lambda seen: grid(seen.travel * np.geomspace(0.02, 0.9, 7), seen.travel * np.geomspace(0.01, 0.5, 6)),
    limits=lambda seen: [(2e-3 * seen.travel, 1.8 * seen.travel), (1e-3 * seen.travel, 1.5 * seen.travel)],
    signs=(1, 1),
    parameters=lambda a, s, e: (a[0] + a[1], s[0], a[0] / s[1] + _inner(a, s), _inner(a, s)),
    shape_of=lambda p: (p[1], (p[0] - 0.5 * p[1] * (p[3] if len(p) > 3 else 0.0)) / p[2]),
    quoted=lambda a, s, e: {"slip_force": (a[0] + a[1], "N"), "lost_motion": (s[0], "m")},
    kind=HYSTERESIS,
    plausible=_slips,
    strengthened=True,
)

FRICTION_PIECES: tuple[Piece, ...] = (
    _SLIDING,
    _COULOMB,
    _STRIBECK,
    _DAHL,
    _LUGRE,
    _BOUC_WEN,
    _FREE_BOUC_WEN,
    _PINCHED,
    _BACKLASH,
)

"""Springs, stops and gaps of the catalogue as pieces of a component's force: see `pieces`."""

from __future__ import annotations

import numpy as np

from sprung.model.diagnosis.force.piece import (
    ELASTIC,
    FittedPiece,
    Piece,
    admissible,
    wider_form,
)
from sprung.model.laws import grid
from sprung.model.laws.gas import GAS_SPRING
from sprung.model.laws.stiffness import BUMP_STOP, CLEARANCE, CUBIC_STIFFNESS, PROGRESSIVE_STOP
from sprung.model.laws.viscoelastic import FRACTIONAL_STIFFNESS

_POLYTROPIC = 1.3  # of a gas; not identifiable beside the column's length at usual rates


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


_CUBIC = Piece(
    CUBIC_STIFFNESS,
    signs=(0,),
    parameters=lambda a, s, e: (a[0],),
    kind=ELASTIC,
)
_CUBIC_OFF_CENTRE = Piece(
    wider_form(CUBIC_STIFFNESS),
    signs=(0, 0),
    parameters=lambda a, s, e: (a[0], a[1]),
    kind=ELASTIC,
    plausible=_softest_within,
    imitates=True,
)
_BUMP_STOP = Piece(
    BUMP_STOP,
    shapes=("gap",),
    grid=lambda seen: grid(seen.travel * np.array([0.3, 0.5, 0.65, 0.8, 0.9])),
    limits=lambda seen: [(0.1 * seen.travel, 0.97 * seen.travel)],
    signs=(1,),
    parameters=lambda a, s, e: (s[0], a[0]),
    shape_of=lambda p: (p[0],),
    kind=ELASTIC,
    plausible=_held_within,
)
_TWO_STOPS = Piece(
    wider_form(BUMP_STOP),
    shapes=("gap", "gap_compression"),
    grid=lambda seen: grid(*[seen.travel * np.array([0.3, 0.5, 0.7, 0.85])] * 2),
    limits=lambda seen: [(0.25 * seen.travel, 0.97 * seen.travel)] * 2,
    signs=(1, 1),
    parameters=lambda a, s, e: (s[0], a[0], s[1], a[1]),
    shape_of=lambda p: (p[0], p[2]),
    kind=ELASTIC,
    plausible=_stops,
    imitates=True,
)
_PROGRESSIVE_STOP = Piece(
    PROGRESSIVE_STOP,
    shapes=("gap", "gap_compression", "exponent"),
    grid=lambda seen: grid(*[seen.travel * np.array([0.3, 0.5, 0.75])] * 2, [1.5, 2.5]),
    # nearer, it is a progressive spring
    limits=lambda seen: [(0.25 * seen.travel, 0.97 * seen.travel)] * 2 + [admissible(PROGRESSIVE_STOP, "exponent")],
    signs=(1, 1),
    parameters=lambda a, s, e: (s[0], a[0], s[1], a[1], s[2]),
    shape_of=lambda p: (p[0], p[2], p[4]),
    kind=ELASTIC,
    plausible=_stops,
    imitates=True,
)
_CLEARANCE = Piece(
    CLEARANCE,
    shapes=("gap",),
    grid=lambda seen: grid(seen.travel * np.array([0.05, 0.1, 0.2, 0.35, 0.55, 0.75])),
    limits=lambda seen: [(0.01 * seen.travel, 0.9 * seen.travel)],
    signs=(1,),
    parameters=lambda a, s, e: (s[0],),
    shape_of=lambda p: (p[0],),
    kind=ELASTIC,
    plausible=_loose_within,
)
_GAS_SPRING = Piece(
    GAS_SPRING,
    shapes=("length",),
    grid=lambda seen: grid(seen.travel * np.array([1.3, 2.0, 4.0, 10.0])),
    limits=lambda seen: [(1.1 * seen.travel, 30.0 * seen.travel)],
    signs=(1,),
    parameters=lambda a, s, e: (a[0], s[0], _POLYTROPIC),
    shape_of=lambda p: (p[1],),
    kind=ELASTIC,
)
_FRACTIONAL = Piece(
    FRACTIONAL_STIFFNESS,
    shapes=("order",),
    grid=lambda seen: grid([0.1, 0.2, 0.35, 0.55]),
    limits=lambda seen: [admissible(FRACTIONAL_STIFFNESS, "order")],
    signs=(1,),
    parameters=lambda a, s, e: (a[0], s[0]),
    shape_of=lambda p: (p[1],),
)

STIFFNESS_PIECES: tuple[Piece, ...] = (
    _CUBIC,
    _CUBIC_OFF_CENTRE,
    _BUMP_STOP,
    _TWO_STOPS,
    _PROGRESSIVE_STOP,
    _CLEARANCE,
    _GAS_SPRING,
    _FRACTIONAL,
)

"""Pieces of a component's force: laws that are linear in their strengths at given shapes.

    F(t) = preload + k d + c v + sum over pieces of  strengths @ columns(motion; shapes)

Strengths, k, c and preload follow by linear least squares for given shapes (variable projection, Golub and Pereyra
1973), so that only one to three shapes per law are searched, initially on a grid.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass

import numpy as np

from sprung.model.diagnosis.force.motion import ElementMotion
from sprung.model.diagnosis.force.sizes import MotionSizes
from sprung.model.diagnosis.kinds import EffectKind, kind_of_law
from sprung.model.diagnosis.rules import ComponentRules
from sprung.model.laws import UNIT_ELEMENT, ElementLaw, SpringDamper, StructureLaw
from sprung.model.laws.along import force_along
from sprung.model.laws.base import RARE
from sprung.model.signals import FloatArray

Values = dict[str, tuple[float, str]]  # value and unit by name
Shape = Sequence[float]


@dataclass(frozen=True)
class FittedPiece:
    """Values of a fitted piece, for the test of their plausibility."""

    values: Mapping[str, float]  # of the law's parameters
    strengths: FloatArray
    shape: Shape
    element: SpringDamper
    deflection: FloatArray  # m, (T,)
    corner: float  # m/s, change of the rate per sample at a reversal: knees below it are not resolved
    rules: ComponentRules
    step: float  # s, between samples
    seconds: float  # of the record


@dataclass(frozen=True)
class PieceKind:
    """A group of similar pieces."""

    name: str
    dissipates: bool  # rate-independent hysteresis; at most one of a kind is used


STATIC = PieceKind("static", dissipates=False)
ELASTIC = PieceKind("elastic", dissipates=False)  # a curve over the deflection alone
FRICTION = PieceKind("friction", dissipates=True)
HYSTERESIS = PieceKind("hysteresis", dissipates=True)

LawParameters = Callable[[FloatArray, Shape, SpringDamper], tuple[float, ...]]
PlausibilityTest = Callable[[FittedPiece], bool]
QuotedValues = Callable[[FloatArray, Shape, SpringDamper], Values]


def no_shapes(seen: MotionSizes) -> FloatArray:
    """The grid of a piece without shapes: one trial of no values, (1, 0)."""
    return np.zeros((1, 0))


def no_limits(seen: MotionSizes) -> list[tuple[float, float]]:
    """The limits of a piece without shapes."""
    return []


@dataclass(frozen=True)
class Piece:
    """One law as a piece of a component's force.

    Functions of it take `a`, the strengths, `s`, the shapes, `e`, the element, and `p`, the law's parameters.
    """

    law: ElementLaw | StructureLaw
    _: KW_ONLY
    signs: tuple[int, ...]  # of the strengths: 1, -1, 0 for either
    parameters: LawParameters  # of the law, by strengths, shapes and element; linear in the strengths
    shapes: tuple[str, ...] = ()  # names of the nonlinear values
    grid: Callable[[MotionSizes], FloatArray] = no_shapes  # trial shapes, (trials, shapes)
    limits: Callable[[MotionSizes], list[tuple[float, float]]] = no_limits  # of every shape
    shape_of: Callable[[Sequence[float]], tuple[float, ...]] = lambda p: ()  # by the law's parameters
    quoted: QuotedValues = lambda a, s, e: {}
    kind: PieceKind = STATIC  # look-alikes are mostly of one kind
    rarer: int = 0  # than its law states, along a single motion: as `commoner`
    acting: ElementLaw | None = None  # law of the columns, if not the named one
    acting_parameters: LawParameters | None = None
    plausible: PlausibilityTest = lambda fitted: True  # whether values are plausible for the record
    imitates: bool = False  # so flexible that it must leave as little as several laws
    at_low_rates: Piece | None = None  # what acts like it where it changes at low rates (`low_valve`)
    yields_with_rate: bool = False  # a yield force above a rate, with a steep slope below it
    strengthened: bool = False  # whether its strength may follow a signal: by a valve, a temperature

    @property
    def dissipates(self) -> bool:
        """Whether its force is a rate-independent hysteresis."""
        return self.kind.dissipates

    @property
    def commoner(self) -> int:
        """Prior cost: number of commoner laws it contains or imitates, by the evidence that its law states to need."""
        return math.ceil(self.law.prior_cost / RARE) + self.rarer

    @property
    def effect(self) -> str:
        return self.law.name

    @property
    def effect_kind(self) -> EffectKind:
        """The kind of finding that it is."""
        return kind_of_law(self.law)

    @property
    def title(self) -> str:
        return self.law.title

    @property
    def key(self) -> str:
        """Distinguishes pieces of the same law."""
        return f"{self.law.name} {len(self.law.parameters)}"

    def columns(self, motion: ElementMotion, shape: Shape) -> FloatArray:
        """Force per strength along a motion, (T, m); deflections relative to the middle of the travel."""
        law, of = self.acting or self.law, self.acting_parameters or self.parameters
        assert isinstance(law, ElementLaw)
        follows = self.kind is HYSTERESIS and law.path is not None
        along, stride = (motion.followed, motion.stride) if follows else (motion, 1)
        d = along.deflection - motion.middle
        total, found = np.zeros(len(motion.time)), []
        for count in range(1, len(self.signs) + 1):
            strengths = (np.arange(len(self.signs)) < count).astype(float)
            values = of(strengths, shape, UNIT_ELEMENT)
            force = force_along(law, values, d, along.rate, along.time, UNIT_ELEMENT)[::stride]
            found.append(force - total)
            total = force
        return np.column_stack(found)

    def values(self, strengths: FloatArray, shape: Shape, element: SpringDamper) -> Values:
        """The law's parameters."""
        numbers = self.parameters(strengths, shape, element)
        return {spec.name: (float(x), spec.unit) for spec, x in zip(self.law.parameters, numbers, strict=True)}


@dataclass(frozen=True)
class InertiaPiece(Piece):
    """A mass that moves with the deflection: of a clamp between specimen and load cell, of a rod, of oil in a pipe."""

    def columns(self, motion: ElementMotion, shape: Shape) -> FloatArray:
        assert motion.acceleration is not None
        return motion.acceleration[:, None]


def admissible(law: ElementLaw, name: str) -> tuple[float, float]:
    """Limits of one of a law's parameters, as the law states them."""
    spec = next(one for one in law.parameters if one.name == name)
    return spec.low, spec.high


def wider_form(law: ElementLaw) -> ElementLaw:
    """The wider form of a law that has one."""
    assert law.wider is not None
    return law.wider

"""Pieces of a component's force: laws that are linear in their strengths at given shapes.

    F(t) = preload + k d + c v + sum over pieces of  strengths @ columns(motion; shapes)

Strengths, k, c and preload follow by linear least squares for given shapes (variable projection, Golub and Pereyra
1973), so that only one to three shapes per law are searched, initially on a grid.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, replace

import numpy as np

from sprung.model.diagnosis.force.motion import ElementMotion
from sprung.model.diagnosis.kinds import EffectKind, kind_of_law
from sprung.model.diagnosis.rules import RULES, ComponentRules
from sprung.model.laws import CLOCK_LEAD, UNIT_ELEMENT, ElementLaw, SpringDamper, StructureLaw, reversal_step
from sprung.model.laws.along import force_along
from sprung.model.laws.base import RARE
from sprung.model.laws.basis import UNKNOWN
from sprung.model.laws.channel import SensorResponse
from sprung.model.laws.following import Covariate
from sprung.model.laws.paths import stop_path
from sprung.model.laws.sensor_faults import SENSOR_LAG
from sprung.model.signals import FloatArray

Values = dict[str, tuple[float, str]]  # value and unit by name
Shape = Sequence[float]

_MEDIAN_OF_NORMAL = 0.6745  # of the magnitude, over the deviation


@dataclass(frozen=True)
class MotionSizes:
    """Sizes of a motion, which bound knees, gaps and yield displacements."""

    travel: float  # m, half of the range
    rate: FloatArray  # m/s, quantiles 0 .. 100 % of the magnitude, (101,)
    seconds: float
    step: float  # s
    lowest_knee: float  # m/s, of valves; with lower knees they act like friction
    reach: float  # factor about the typical size, search range of a formula's lengths and rates
    latest: float  # s, of the delay of a channel

    @classmethod
    def of(cls, motion: ElementMotion, rules: ComponentRules = RULES.component) -> MotionSizes:
        quantiles = np.quantile(np.abs(motion.rate), np.linspace(0, 1, 101))
        travel = 0.5 * float(np.ptp(motion.deflection))
        rate, seconds = np.maximum(quantiles, 1e-12), len(motion.time) * motion.step
        usual = max(float(rate[50]), _MEDIAN_OF_NORMAL * float(np.sqrt(np.mean(rate**2))))  # independent of rests
        knee = rules.lowest_knee * usual
        return cls(max(travel, 1e-12), rate, seconds, motion.step, knee, rules.formula_reach, rules.latest)

    @property
    def rate_rms(self) -> float:
        return float(np.sqrt(np.mean(self.rate**2)))

    def slowest_corner(self, motion: ElementMotion) -> float:
        """Change of the rate per sample at a reversal, m/s: knees below it are not resolved."""
        return reversal_step(motion.rate)


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

Parameters = Callable[[FloatArray, Shape, SpringDamper], tuple[float, ...]]
Plausible = Callable[[FittedPiece], bool]
Named = Callable[[FloatArray, Shape, SpringDamper], Values]


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
    parameters: Parameters  # of the law, by strengths, shapes and element; linear in the strengths
    shapes: tuple[str, ...] = ()  # names of the nonlinear values
    grid: Callable[[MotionSizes], FloatArray] = no_shapes  # trial shapes, (trials, shapes)
    limits: Callable[[MotionSizes], list[tuple[float, float]]] = no_limits  # of every shape
    shape_of: Callable[[Sequence[float]], tuple[float, ...]] = lambda p: ()  # by the law's parameters
    quoted: Named = lambda a, s, e: {}
    kind: PieceKind = STATIC  # look-alikes are mostly of one kind
    rarer: int = 0  # than its law states, along a single motion: as `commoner`
    acting: ElementLaw | None = None  # law of the columns, if not the named one
    acting_parameters: Parameters | None = None
    plausible: Plausible = lambda fitted: True  # whether values are plausible for the record
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


@dataclass(frozen=True)
class Following:
    """A law whose strengths depend linearly on a measured signal, about its mean.

    keeps_slope: its yield force does, and the steep slope at rates below yielding stays, as of a magnetorheological
    damper, whose fluid is as viscous at any current.  lagged: the dependence has a first-order lag (Spencer, Dyke, Sain
    and Carlson 1997).
    """

    piece: Piece
    signal: Covariate
    keeps_slope: bool = False
    lagged: bool = False

    @property
    def law(self) -> ElementLaw | StructureLaw:
        return self.piece.law

    @property
    def effect(self) -> str:
        return self.piece.effect

    @property
    def effect_kind(self) -> EffectKind:
        return self.piece.effect_kind

    @property
    def title(self) -> str:
        return f"{self.piece.title} that follows {self.signal.name}"

    @property
    def key(self) -> str:
        return f"{self.piece.key} {self.signal.name}"

    @property
    def kind(self) -> PieceKind:
        return self.piece.kind

    @property
    def dissipates(self) -> bool:
        return self.piece.dissipates

    def plausible(self, fitted: FittedPiece) -> bool:
        """Whether the law's own values are plausible."""
        return self.piece.plausible(replace(fitted, shape=fitted.shape[: len(self.piece.shapes)]))

    @property
    def commoner(self) -> int:
        return self.piece.commoner + 1 + self.lagged

    @property
    def shapes(self) -> tuple[str, ...]:
        of_slope, of_lag = ("slope",) * self.keeps_slope, ("lag",) * self.lagged
        return (*self.piece.shapes, *of_slope, *of_lag)

    @property
    def signs(self) -> tuple[int, ...]:
        return self.piece.signs if self.keeps_slope else (*self.piece.signs, *(0 for _ in self.piece.signs))

    @property
    def forms(self) -> tuple[Following, ...]:
        """Further forms of the plain one."""
        if self.keeps_slope or self.lagged:
            return ()
        forms = ((False, True), *(((True, False), (True, True)) if self.piece.yields_with_rate else ()))
        return tuple(replace(self, keeps_slope=keeps, lagged=late) for keeps, late in forms)

    def starts(self, strengths: FloatArray, shape: Shape) -> list[tuple[float, ...]]:
        """Shapes from which it is refined, by the strengths and shapes of the plain form."""
        count = len(self.piece.signs)
        slope = strengths[count] / strengths[0] if len(strengths) > count and strengths[0] != 0 else 1.0
        slopes = (float(np.clip(slope, *self._slopes)),) * self.keeps_slope
        lags = [(late * self.signal.step,) for late in _FIRST_LAGS] if self.lagged else [()]
        return [(*shape[: len(self.piece.shapes)], *slopes, *late) for late in lags]

    @property
    def _slopes(self) -> tuple[float, float]:
        """Relative changes per standard deviation of the signal, for which the yield force is never negative."""
        above = (self.signal.series - self.signal.reference) / self.signal.size
        return -1 / float(np.max(above)), -1 / float(np.min(above))

    def grid(self, seen: MotionSizes) -> FloatArray:
        return self.piece.grid(seen)

    def limits(self, seen: MotionSizes) -> list[tuple[float, float]]:
        lags = [(0.3 * self.signal.step, 0.1 * seen.seconds)] if self.lagged else []
        return [*self.piece.limits(seen), *([self._slopes] if self.keeps_slope else []), *lags]

    def columns(self, motion: ElementMotion, shape: Shape) -> FloatArray:
        own, lag = shape[: len(self.piece.shapes)], shape[-1] if self.lagged else 0.0
        above = self.signal.above(motion.time + CLOCK_LEAD, lag) / self.signal.size
        if self.keeps_slope:
            yields = np.maximum(1 + shape[len(own)] * above, _LEAST_YIELD)
            along = replace(motion, rate=motion.rate / yields, dense=None, stride=1)
            return self.piece.columns(along, own) * yields[:, None]
        steady = self.piece.columns(motion, own)
        return np.column_stack([steady, steady * above[:, None]])

    def values(self, strengths: FloatArray, shape: Shape, element: SpringDamper) -> Values:
        """The law's parameters at the signal's mean, and the relative change of its first strength per unit."""
        count = len(self.piece.signs)
        if self.keeps_slope:
            slope = float(shape[len(self.piece.shapes)] / self.signal.size)
        else:
            slope = float(strengths[count] / ((strengths[0] if strengths[0] != 0 else 1e-300) * self.signal.size))
        found = self.piece.values(strengths[:count], shape[: len(self.piece.shapes)], element)
        found = found | {f"{self.signal.name}_slope": (slope, self.signal.per_unit)}
        return found | ({f"{self.signal.name}_lag": (float(shape[-1]), "s")} if self.lagged else {})

    def quoted(self, strengths: FloatArray, shape: Shape, element: SpringDamper) -> Values:
        """What is quoted of the law, at the signal's mean and per unit of it."""
        count, own = len(self.piece.signs), shape[: len(self.piece.shapes)]
        change = (strengths * shape[len(own)] if self.keeps_slope else strengths[count:]) / self.signal.size
        steady = self.piece.quoted(strengths[:count], own, element)
        moved = self.piece.quoted(strengths[:count] + change, own, element)
        per = {
            f"{name}_per_{self.signal.name}": (moved[name][0] - value, f"{unit}/{self.signal.unit}")
            for name, (value, unit) in steady.items()
            if moved[name][0] != value
        }
        return steady | per


@dataclass(frozen=True)
class SliderSurface:
    """A smooth force over deflection and rate, and a family of sliders (Prandtl and Ishlinskii) for its memory."""

    effect: str = UNKNOWN
    effect_kind: EffectKind = EffectKind.UNLISTED
    title: str = "a force that no law explains"
    key: str = UNKNOWN
    kind: PieceKind = STATIC
    dissipates: bool = False
    plausible: Plausible = lambda fitted: True
    commoner: int = 0
    shapes: tuple[str, ...] = ()

    @property
    def signs(self) -> tuple[int, ...]:
        return (0,) * (len(_REACHES) + len(_RATES) + 6)

    def limits(self, seen: MotionSizes) -> list[tuple[float, float]]:
        return []

    def columns(self, motion: ElementMotion, shape: Shape) -> FloatArray:
        seen = MotionSizes.of(motion)
        x, v = (motion.deflection - motion.middle) / seen.travel, motion.rate / max(seen.rate_rms, 1e-12)
        path, stride = motion.followed.deflection, motion.stride
        columns = [stop_path(path, reach * seen.travel)[::stride] / (reach * seen.travel) for reach in _REACHES]
        columns += [np.clip(motion.rate, -knee, knee) / knee for knee in rates_at(seen, _RATES.tolist())]
        columns += [np.maximum(v, 0.0), x**2, x**3, x * v, x**2 * v, v * np.abs(v)]
        return np.column_stack(columns)

    def values(self, strengths: FloatArray, shape: Shape, element: SpringDamper) -> Values:
        return {}

    def quoted(self, strengths: FloatArray, shape: Shape, element: SpringDamper) -> Values:
        return {}


@dataclass(frozen=True)
class Lag:
    """Lag of the force channel relative to the motion: not a force, but a change of how all forces are shown.

    A pure delay of the node, or a first-order filter, which also attenuates high frequencies.
    """

    filters: bool = False  # whether its time is the time constant of a filter
    effect: str = SENSOR_LAG.name
    effect_kind: EffectKind = EffectKind.FAULT
    title: str = SENSOR_LAG.title
    kind: PieceKind = STATIC
    dissipates: bool = False
    plausible: Plausible = lambda fitted: (
        fitted.rules.late * fitted.step < abs(fitted.shape[0]) < fitted.rules.refined_latest * fitted.rules.latest
    )
    commoner: int = 0
    shapes: tuple[str, ...] = ("time",)
    signs: tuple[int, ...] = ()

    @property
    def key(self) -> str:
        """Distinguishes delay and filter."""
        return f"{self.effect} of a filter" if self.filters else self.effect

    def response(self, shape: Shape) -> SensorResponse:
        """Delay and filter of the channel."""
        return SensorResponse(lag=shape[0]) if self.filters else SensorResponse(delay=shape[0])

    def grid(self, seen: MotionSizes) -> FloatArray:
        late = np.geomspace(2e-4, seen.latest, 12)
        return (late if self.filters else np.concatenate([late, -late]))[:, None]

    def limits(self, seen: MotionSizes) -> list[tuple[float, float]]:
        return [(1e-5 if self.filters else -1.5 * seen.latest, 1.5 * seen.latest)]

    def columns(self, motion: ElementMotion, shape: Shape) -> FloatArray:
        return np.zeros((len(motion.deflection), 0))

    def values(self, strengths: FloatArray, shape: Shape, element: SpringDamper) -> Values:
        return {"time": (float(shape[0]), "s")}

    def quoted(self, strengths: FloatArray, shape: Shape, element: SpringDamper) -> Values:
        return {}


_REACHES = np.array([0.01, 0.03, 0.1, 0.25, 0.5, 0.9])  # of the travel, of a family of sliders
_FIRST_LAGS = (3.0, 30.0)  # samples of a signal, from which a lag is refined
_LEAST_YIELD = 0.02  # of the yield force at a signal's mean
_RATES = np.array([0.1, 0.3, 0.6, 0.85])  # quantiles of the rate, knots of a force over it
SURFACE = SliderSurface()
LAGS = (Lag(), Lag(filters=True))
LawPiece = Piece | Following | Lag  # candidates of the search
Part = LawPiece | SliderSurface


def admissible(law: ElementLaw, name: str) -> tuple[float, float]:
    """Limits of one of a law's parameters, as the law states them."""
    spec = next(one for one in law.parameters if one.name == name)
    return spec.low, spec.high


def rates_at(seen: MotionSizes, shares: Sequence[float]) -> FloatArray:
    """Rates, m/s, that so many shares (N,) of the time are not exceeded, (N,)."""
    return np.interp(shares, np.linspace(0, 1, 101), seen.rate)


def wider_form(law: ElementLaw) -> ElementLaw:
    """The wider form of a law that has one."""
    assert law.wider is not None
    return law.wider

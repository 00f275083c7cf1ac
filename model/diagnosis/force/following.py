"""A law as a piece whose strengths follow a measured signal, such as a current or a temperature."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sprung.model.diagnosis.force.motion import ElementMotion
from sprung.model.diagnosis.force.piece import FittedPiece, Piece, PieceKind, Shape, Values
from sprung.model.diagnosis.force.sizes import MotionSizes
from sprung.model.diagnosis.kinds import EffectKind
from sprung.model.laws import CLOCK_LEAD, ElementLaw, SpringDamper, StructureLaw
from sprung.model.laws.following import Covariate
from sprung.model.signals import FloatArray

_FIRST_LAGS = (3.0, 30.0)  # samples of a signal, from which a lag is refined
_LEAST_YIELD = 0.02  # of the yield force at a signal's mean


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

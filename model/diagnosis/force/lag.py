"""Lag of the force channel of a component test, among the candidates of its search."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sprung.model.diagnosis.force.motion import ElementMotion
from sprung.model.diagnosis.force.piece import STATIC, PieceKind, PlausibilityTest, Shape, Values
from sprung.model.diagnosis.force.sizes import MotionSizes
from sprung.model.diagnosis.kinds import EffectKind
from sprung.model.laws import SpringDamper
from sprung.model.laws.channel import SensorResponse
from sprung.model.laws.sensor_faults import SENSOR_LAG
from sprung.model.signals import FloatArray


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
    plausible: PlausibilityTest = lambda fitted: (
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


LAGS = (Lag(), Lag(filters=True))

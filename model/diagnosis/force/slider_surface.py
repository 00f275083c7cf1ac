"""A force of no law: a smooth surface over deflection and rate, with sliders for its memory."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sprung.model.diagnosis.force.motion import ElementMotion
from sprung.model.diagnosis.force.piece import STATIC, PieceKind, PlausibilityTest, Shape, Values
from sprung.model.diagnosis.force.sizes import MotionSizes, rates_at
from sprung.model.diagnosis.kinds import EffectKind
from sprung.model.laws import SpringDamper
from sprung.model.laws.basis import UNKNOWN
from sprung.model.laws.paths import stop_path
from sprung.model.signals import FloatArray

_REACHES = np.array([0.01, 0.03, 0.1, 0.25, 0.5, 0.9])  # of the travel, of a family of sliders
_RATES = np.array([0.1, 0.3, 0.6, 0.85])  # quantiles of the rate, knots of a force over it


@dataclass(frozen=True)
class SliderSurface:
    """A smooth force over deflection and rate, and a family of sliders (Prandtl and Ishlinskii) for its memory."""

    effect: str = UNKNOWN
    effect_kind: EffectKind = EffectKind.UNLISTED
    title: str = "a force that no law explains"
    key: str = UNKNOWN
    kind: PieceKind = STATIC
    dissipates: bool = False
    plausible: PlausibilityTest = lambda fitted: True
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


SURFACE = SliderSurface()

"""Slow drift of a load cell's zero: a nuisance of component tests, like the preload about which it wanders.

The zero of an instrument is followed, not predicted: a law must explain forces of a part of the record that no fit has
seen, but nobody can know how an amplifier warms up there (`fit.fitted`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.polynomial import legendre

from sprung.model.diagnosis.force.motion import ElementMotion
from sprung.model.diagnosis.force.piece import Shape, Values
from sprung.model.diagnosis.force.slider_surface import SliderSurface
from sprung.model.diagnosis.kinds import EffectKind
from sprung.model.laws import SpringDamper
from sprung.model.signals import FloatArray

_COURSE = np.linspace(-1.0, 1.0, 201)  # times over the record, of its smallest and largest value


@dataclass(frozen=True)
class ZeroDrift(SliderSurface):
    """A polynomial of the time without its mean, which is the preload's."""

    effect: str = "zero_drift"
    effect_kind: EffectKind = EffectKind.NUISANCE
    title: str = "a drift of the zero"
    key: str = "zero_drift"
    powers: int = 1

    @property
    def signs(self) -> tuple[int, ...]:
        return (0,) * self.powers

    def columns(self, motion: ElementMotion, shape: Shape) -> FloatArray:
        course = 2 * (motion.time - motion.time[0]) / (motion.time[-1] - motion.time[0]) - 1
        return np.asarray(legendre.legvander(course, self.powers)[:, 1:])

    def values(self, strengths: FloatArray, shape: Shape, element: SpringDamper) -> Values:
        """Largest less smallest value, and last less first, N."""
        course = legendre.legval(_COURSE, np.concatenate([[0.0], strengths]))
        return {"range": (float(np.ptp(course)), "N"), "change": (float(course[-1] - course[0]), "N")}

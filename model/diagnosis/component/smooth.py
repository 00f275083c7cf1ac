"""Comparison of laws over the deflection with a smooth spring, since sums of several can imitate any curve.

Stops, gaps and progressive springs are curves over the deflection.  A sum of them, or one with many parameters,
approximates any curve.  They are named only if they fit better than a polynomial with as many parameters, which has
no knees.  Several are not named either if most of what they leave is another curve.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sprung.model.diagnosis.force.fit import ComponentFit, fitted, refined
from sprung.model.diagnosis.force.motion import ElementMotion
from sprung.model.diagnosis.force.piece import ELASTIC, Piece, Shape
from sprung.model.diagnosis.force.sizes import MotionSizes
from sprung.model.diagnosis.force.slider_surface import SliderSurface
from sprung.model.diagnosis.selection.evidence import effective_count, level_gain
from sprung.model.signals import FloatArray

_CORNERS = 20  # of a polygon, evenly over the travel, and as many evenly over the samples


@dataclass(frozen=True)
class SmoothSpring(SliderSurface):
    """A polynomial of the deflection from the second order on; the spring is the linear part."""

    title: str = "a smooth spring"
    key: str = "smooth spring"
    powers: int = 1

    @property
    def signs(self) -> tuple[int, ...]:
        return (0,) * self.powers

    def columns(self, motion: ElementMotion, shape: Shape) -> FloatArray:
        x = (motion.deflection - motion.middle) / MotionSizes.of(motion).travel
        return np.column_stack([x**power for power in range(2, self.powers + 2)])


@dataclass(frozen=True)
class AnyCurve(SliderSurface):
    """A polygon over the deflection; the spring is its first side."""

    title: str = "a curve over the deflection"
    key: str = "any curve"

    @property
    def signs(self) -> tuple[int, ...]:
        return (0,) * (2 * _CORNERS)

    def columns(self, motion: ElementMotion, shape: Shape) -> FloatArray:
        shares, x = np.linspace(0, 1, _CORNERS + 2)[1:-1], motion.deflection
        corners = np.concatenate([x.min() + np.ptp(x) * shares, np.quantile(x, shares)])
        return np.asarray(np.maximum(x[:, None] - corners, 0.0) / max(float(np.ptp(x)), 1e-300))


def smooth_serves(fit: ComponentFit, first: int) -> bool:
    """Whether a smooth spring with as many parameters predicts as well as the laws over the deflection from `first` on,
    or several of them leave mostly a force over the deflection.

    Applies to several such laws, and to single flexible ones with knees; others have too few parameters, and a
    progressive spring off centre is a smooth spring itself.
    """
    model, rules = fit.model, fit.task.rules
    curves = [i for i in range(first, len(model.pieces)) if model.pieces[i].kind is ELASTIC]
    bent = [piece for i in curves if isinstance(piece := model.pieces[i], Piece) and piece.shapes]
    if not bent or (len(curves) < 2 and not bent[0].imitates):
        return False
    quick = fit.task.thinned(rules.search)
    laws, rest = refined(quick, model), model
    for index in reversed(curves):
        rest = rest.without(index)
    smooth = refined(quick, rest.plus(SmoothSpring(powers=sum(_numbers(fit, i) for i in curves)), ()))
    gain = level_gain(smooth.error, laws.error, effective_count(laws.residual[: quick.split]))
    if gain < rules.naming_margin or smooth.held_out <= laws.held_out:
        return True
    return len(curves) > 1 and _leave_a_curve(laws)


def _leave_a_curve(laws: ComponentFit) -> bool:
    """Whether most of what laws leave beyond noise is one more curve over the deflection: the true one is another."""
    most, noise = laws.task.rules.another_curve, laws.floor**2
    free = fitted(laws.task, laws.model.plus(AnyCurve(), ()))
    pairs = ((free.error, laws.error), (free.held_out, laws.held_out))
    return laws.leaves_more and all(here - noise < most * (there - noise) for here, there in pairs)


def _numbers(fit: ComponentFit, index: int) -> int:
    """Effective number of parameters of a law; a stop without contact has none."""
    strengths = fit.strengths_of(index)
    acting = int(np.sum(strengths != 0.0))
    return acting + max(0, len(fit.model.shapes[index]) - (len(strengths) - acting))

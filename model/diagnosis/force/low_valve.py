"""Friction with a wide transition and a valve that opens at low rates, which are often indistinguishable.

The search does not try valves with knees below usual rates, where they act like friction.  A friction that was found is
therefore compared with such a valve here.
"""

from __future__ import annotations

from sprung.model.diagnosis.force.fit import ComponentFit, fitted, refined
from sprung.model.diagnosis.force.piece import Piece

_KNEES = (0.9, 1.1, 1.3, 1.5, 1.7, 1.9, 2.2)  # over the rate at which tanh turns: it levels off at 1.5


def low_valve(fit: ComponentFit, index: int) -> ComponentFit | None:
    """The fit with the best valve in place of the friction at `index`; None without a friction or a plausible valve.

    Its knee lies above what the motion passes within a sample: a sharper one is indistinguishable from friction.
    """
    piece, task = fit.model.pieces[index], fit.task
    valve = piece.at_low_rates if isinstance(piece, Piece) else None
    if valve is None or not fit.strengths_of(index).any():
        return None
    least, (smoothing,) = task.rules.knees * task.seen.slowest_corner(task.motion), fit.model.shapes[index]
    knees = [factor * smoothing for factor in _KNEES if factor * smoothing > least]
    others = [fitted(task, fit.model.replaced(index, valve, (knee,))) for knee in knees]
    if not others:
        return None
    best = refined(task, min(others, key=lambda one: one.error).model)
    return best if best.model.shapes[index][0] > least else None

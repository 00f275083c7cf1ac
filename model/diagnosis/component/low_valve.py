"""Friction with a wide transition and a valve that opens at low rates, which are often indistinguishable.

The search does not try valves with knees below usual rates, where they act like friction.  A friction that was found is
therefore compared with such a valve here.
"""

from __future__ import annotations

import numpy as np

from sprung.model.diagnosis.force.fit import ComponentFit, fitted
from sprung.model.diagnosis.force.piece import Piece
from sprung.model.diagnosis.force.pieces import PIECES

_KNEES = (0.9, 1.1, 1.3, 1.5, 1.7, 1.9, 2.2)  # over the rate at which tanh turns: it levels off at 1.5


def low_valve(fit: ComponentFit, index: int) -> ComponentFit | None:
    """The fit with the best valve in place of the friction at `index`; None without a friction or a plausible valve."""
    piece, task = fit.model.pieces[index], fit.task
    rival = piece.at_low_rates if isinstance(piece, Piece) else None
    valve = next((other for other in PIECES if other.law is rival), None)
    if valve is None:
        return None
    corner, (smoothing,) = task.seen.slowest_corner(task.motion), fit.model.shapes[index]
    knees = [factor * smoothing for factor in _KNEES if factor * smoothing > corner]
    others = [fitted(task, fit.model.replaced(index, valve, (knee,))) for knee in knees]
    best = min(others, key=lambda one: one.error, default=None)
    return best if best is not None and np.any(best.strengths_of(index)) else None

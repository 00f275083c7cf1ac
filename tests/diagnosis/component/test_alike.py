"""What may stand for what in a component test."""

from __future__ import annotations

import numpy as np
import pytest

from sprung.model.diagnosis.component.alike import gives_way
from sprung.model.diagnosis.force.fit import NO_LAWS, ComponentTask, fitted
from sprung.model.diagnosis.force.lag import LAGS
from sprung.model.diagnosis.force.motion import element_motion
from sprung.model.diagnosis.force.piece import Piece
from sprung.model.diagnosis.force.pieces import PIECES
from sprung.model.diagnosis.force.pieces_damping import LOW_VALVE

STOP = next(piece for piece in PIECES if piece.key == "bump_stop 2")
RATE = 200.0
T = np.arange(3000) / RATE
SWEEP = 0.02 * np.sin(2 * np.pi * (0.5 + 0.1 * T) * T)


@pytest.mark.parametrize(
    ("piece", "shape", "either"), [(LOW_VALVE, 0.05, True), (STOP, 0.01, False), (None, 0.0, False)]
)
def test_a_late_force_beside_a_valve_may_be_oil_that_gives_way(piece: Piece | None, shape: float, either: bool) -> None:
    task = ComponentTask(element_motion(SWEEP, None, RATE), 1e3 * np.gradient(SWEEP, 1 / RATE), 2100)
    model = NO_LAWS.plus(LAGS[0], (5e-3,))
    fit = fitted(task, model if piece is None else model.plus(piece, (shape,)))
    assert gives_way(fit, LAGS[0]) == either
    assert piece is None or not gives_way(fit, piece)

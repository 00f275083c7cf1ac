"""What may stand for what in a component test."""

from __future__ import annotations

import numpy as np
import pytest

from sprung.model.diagnosis.component.alike import gives_way
from sprung.model.diagnosis.force.fit import NO_LAWS, ComponentTask, fitted
from sprung.model.diagnosis.force.motion import element_motion
from sprung.model.diagnosis.force.piece import LAGS
from sprung.model.diagnosis.force.pieces_damping import LOW_VALVE

RATE = 200.0
T = np.arange(3000) / RATE
SINE = 0.02 * np.sin(2 * np.pi * 1.1 * T)
SWEEP = 0.02 * np.sin(2 * np.pi * (0.5 + 0.1 * T) * T)


@pytest.mark.parametrize(
    ("deflection", "valve", "either"), [(SINE, True, True), (SINE, False, False), (SWEEP, True, False)]
)
def test_a_late_force_beside_a_valve_may_be_oil_that_gives_way_where_one_loop_repeats_itself(
    deflection: np.ndarray, valve: bool, either: bool
) -> None:
    task = ComponentTask(element_motion(deflection, None, RATE), 1e3 * np.gradient(deflection, 1 / RATE), 2100)
    model = NO_LAWS.plus(LAGS[0], (5e-3,))
    fit = fitted(task, model.plus(LOW_VALVE, (0.05,)) if valve else model)
    assert gives_way(fit, LAGS[0]) == either
    assert not gives_way(fit, LOW_VALVE)

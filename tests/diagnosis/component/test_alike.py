"""What may stand for what in a component test."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from sprung.model.diagnosis.component.alike import gives_way
from sprung.model.diagnosis.force.fit import NO_LAWS, ComponentTask, fitted
from sprung.model.diagnosis.force.lag import LAGS
from sprung.model.diagnosis.force.motion import element_motion
from sprung.model.diagnosis.force.piece import Piece
from sprung.model.diagnosis.force.pieces import PIECES
from sprung.model.diagnosis.force.pieces_damping import LOW_VALVE
from tests.diagnosis.component.rigs import C, K, diagnosed, moved, recorded
from tests.diagnosis.component.test_component import RATE as RIG_RATE
from tests.diagnosis.component.test_component import RigRecording

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


@pytest.mark.parametrize("mass", [0.4, 2.0])  # kg
@pytest.mark.parametrize("clamped", [True, False])
def test_a_light_clamp_and_a_force_that_comes_early_are_told_as_alternatives(mass: float, clamped: bool) -> None:
    """Beside a damper both are a force in proportion to the acceleration, to first order in the time."""
    motion, noise = moved("random", 3), 0.003
    time = np.arange(len(motion)) / RIG_RATE
    exact = CubicSpline(time, motion)
    values = recorded(lambda d, v: np.zeros_like(d), motion, noise).values
    if clamped:
        values[:, 1] += mass * exact(time, 2)
    else:
        early = K * exact(time + mass / C) + C * exact(time + mass / C, 1)
        values[:, 1] = early + noise * np.std(early) * np.random.default_rng(5).standard_normal(len(time))
    report = diagnosed(RigRecording(values), noise)
    (finding,) = report.findings
    told = set((finding.family or finding.effect).split(" or "))
    assert ("inerter" if clamped else "sensor_lag") in told, report.summary
    assert told <= {"inerter", "sensor_lag"}

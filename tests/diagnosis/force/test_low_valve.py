"""A valve that opens at low rates is told beside friction where it serves as well or better."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import chirp

from sprung.model.diagnosis.component.alike import look_alikes
from sprung.model.diagnosis.force.fit import ComponentTask
from sprung.model.diagnosis.force.motion import element_motion
from sprung.model.diagnosis.force.pieces import PIECES
from sprung.model.diagnosis.force.search import search
from sprung.model.signals import FloatArray

RATE, C, KNEE, BEYOND = 200.0, 1500.0, 0.025, 0.35
T = np.arange(3000) / RATE
D = 0.02 * np.minimum(T, 1.0) * chirp(T, 0.3, T[-1], 4.0, phi=-90)
V = np.gradient(D, 1 / RATE)


def _valve(v: FloatArray) -> FloatArray:
    return C * (np.clip(v, -KNEE, KNEE) + BEYOND * (v - np.clip(v, -KNEE, KNEE)))


def _friction(v: FloatArray) -> FloatArray:
    return C * BEYOND * v + 25.0 * np.tanh(v / 0.02)


@pytest.mark.parametrize(
    ("force", "told"), [(_valve, {"coulomb_friction", "damper_blowoff"}), (_friction, {"coulomb_friction"})]
)
def test_a_valve_that_opens_far_below_usual_rates_is_told_beside_friction(force: object, told: set[str]) -> None:
    assert callable(force)
    noise = 0.3
    measured = 2e4 * D + force(V) + noise * np.random.default_rng(5).standard_normal(len(T))
    task = ComponentTask(element_motion(D, None, RATE), measured, int(0.7 * len(T)), noise=noise)
    assert task.seen.lowest_knee > 1.5 * KNEE  # no valve is searched there
    pieces = tuple(p for p in PIECES if p.effect in ("damper_blowoff", "coulomb_friction") and p.commoner == 0)
    found = search(task, pieces, lags=())
    alike = look_alikes(found.final, found.steps, 0)
    assert {step.piece.effect for step in found.steps} | {one.effect for one in alike} == told
    for valve in (one for one in alike if one.effect == "damper_blowoff"):
        assert valve.fit.model.shapes[0][0] == pytest.approx(KNEE, rel=0.01)

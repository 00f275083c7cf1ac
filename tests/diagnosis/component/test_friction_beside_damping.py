"""Friction beside another law: its jumps are no noise of the load cell, and it hides what grows with the rate."""

from __future__ import annotations

import numpy as np
import pytest

from sprung.model.diagnosis.component.measured import component_records
from sprung.model.diagnosis.force.fit import NO_LAWS, fitted, refined
from sprung.model.diagnosis.force.pieces import PIECES
from sprung.model.signals import FloatArray
from tests.diagnosis.component.rigs import bench, diagnosed, found, moved, recorded

FRICTION, SQUARE = 120.0, 2.5e3  # N, N s^2/m^2


def both(d: FloatArray, v: FloatArray) -> FloatArray:
    return FRICTION * np.tanh(v / 5e-4) + SQUARE * v * np.abs(v)


@pytest.mark.parametrize(("kind", "seed"), [("sweep", 0), ("random", 3), ("random", 4), ("sines", 0)])
def test_friction_and_quadratic_damping_of_one_element_are_both_found(kind: str, seed: int) -> None:
    report = diagnosed(recorded(both, moved(kind, seed)))
    assert (report.verdict, found(report)) == ("missing_physics", {"coulomb_friction", "quadratic_damping"})
    values = {p.name: p for f in report.findings for p in f.parameters}
    assert values["force"].value == pytest.approx(FRICTION, rel=0.05)
    assert abs(values["c2"].value - SQUARE) < max(3 * values["c2"].std, 0.05 * SQUARE)


def test_friction_alone_gets_no_second_law() -> None:
    for kind in ("sweep", "random"):
        report = diagnosed(recorded(lambda d, v: FRICTION * np.tanh(v / 5e-4), moved(kind, 3)))
        assert (report.verdict, found(report)) == ("missing_physics", {"coulomb_friction"})


def test_what_friction_left_unmodelled_shakes_the_cell_with_is_no_noise_beside_it() -> None:
    record = recorded(lambda d, v: FRICTION * np.tanh(v / 5e-4), moved("random", 3))
    noise = 0.01 * float(np.std(record.values[:, 1]))
    (one,) = component_records(bench(noise), record.values, record.sample_rate)
    friction = next(piece for piece in PIECES if piece.key == "coulomb_friction 2")
    without = fitted(one.task, NO_LAWS)
    beside = refined(one.task, NO_LAWS.plus(friction, (5e-4,)))
    assert without.noise > 4 * noise
    assert beside.noise == pytest.approx(noise, rel=0.2)
    assert beside.floor < 0.5 * without.floor


def test_standstill_shows_noise_that_no_model_takes_away() -> None:
    record = recorded(lambda d, v: FRICTION * np.tanh(v / 5e-4), moved("random", 3))
    (one,) = component_records(bench(1.0), record.values, record.sample_rate)
    assert one.task.least_noise == 0.0
    rest, hum = np.zeros(400), 5.0 * np.sin(2 * np.pi * 3.0 * np.arange(400) / record.sample_rate)
    values = np.vstack([np.column_stack([rest, hum]), record.values])
    (after,) = component_records(bench(1.0), values, record.sample_rate)
    assert after.task.least_noise == pytest.approx(5.0 / np.sqrt(2), rel=0.1)
    assert fitted(after.task, NO_LAWS).noise >= after.task.least_noise

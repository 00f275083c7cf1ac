"""Forces that a measured motion needs, against a slide that is simulated."""

from __future__ import annotations

import numpy as np
import pytest

from sprung.benchmarks.inverse_dynamics import force_error

RATE = 500.0
TRUE = {"mass": 95.0, "viscous": 200.0, "coulomb": 20.0, "offset": -3.0}


def test_the_right_model_leaves_the_noise_and_a_missing_friction_its_force() -> None:
    t = np.arange(int(20 * RATE)) / RATE
    position = 0.1 * np.sin(2 * np.pi * 0.4 * t) + 0.02 * np.sin(2 * np.pi * 1.1 * t)
    v, a = np.gradient(position, t), np.gradient(np.gradient(position, t), t)
    force = TRUE["mass"] * a + TRUE["viscous"] * v + TRUE["coulomb"] * np.sign(v) + TRUE["offset"]
    assert force_error(force, position, RATE, TRUE) < 0.5
    without = {name: value for name, value in TRUE.items() if name != "coulomb"}
    assert force_error(force, position, RATE, without) == pytest.approx(20.0, rel=0.05)
    shifted = TRUE | {"offset": 0.0}
    assert force_error(force, position, RATE, shifted) == pytest.approx(3.0, rel=0.1)

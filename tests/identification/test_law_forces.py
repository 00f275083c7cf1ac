"""Forces of laws along windows: the motion between their samples."""

from __future__ import annotations

import numpy as np
import pytest

from sprung.model.identification.law_forces import Along
from sprung.model.laws import CATALOGUE

RATE = 100.0


@pytest.mark.parametrize(("frequency", "error"), [(15.0, 1e-4), (30.0, 2e-3), (40.0, 0.012)])
def test_rates_between_samples_are_those_of_motions_near_half_the_sample_rate(frequency: float, error: float) -> None:
    friction = next(law for law in CATALOGUE if law.name == "coulomb_friction")
    omega, time = 2 * np.pi * frequency, np.arange(100) / RATE
    deflection, rate = np.sin(omega * time)[None], omega * np.cos(omega * time)[None]
    along = Along(friction, deflection, rate, RATE)
    assert along.v.shape == along.d.shape == (1, 99 * along.parts + 1)
    np.testing.assert_allclose(along.v[:, :: along.parts], rate, atol=1e-9 * omega)
    truth = omega * np.cos(omega * along.time)
    assert np.sqrt(np.mean((along.v[0] - truth) ** 2)) < error * omega / np.sqrt(2)

"""Measured signals that laws follow: their first-order lag against its closed form."""

from __future__ import annotations

import numpy as np

from sprung.model.laws import CLOCK_LEAD
from sprung.model.laws.following import Covariate
from sprung.model.signals import FloatArray

STEP, LAG = 0.01, 0.07
TIME: FloatArray = np.arange(1000, dtype=np.float64) * STEP


def test_a_lag_of_a_ramp_is_exact() -> None:
    signal = Covariate.of("valve", "V", np.maximum(TIME - 1.0, 0.0), 1 / STEP)
    assert signal is not None
    since = np.maximum(TIME - 1.0, 0.0)
    expected = since - LAG * (1 - np.exp(-since / LAG))
    np.testing.assert_allclose(signal.above(TIME + CLOCK_LEAD, LAG) + signal.reference, expected, atol=1e-9)


def test_a_signal_was_constant_before_its_first_sample_and_without_lag_is_itself() -> None:
    series: FloatArray = np.where(TIME < 5, 2.0, 3.0)
    signal = Covariate.of("valve", "V", series, 1 / STEP)
    assert signal is not None
    shown = signal.above(TIME + CLOCK_LEAD, LAG) + signal.reference
    np.testing.assert_allclose(shown[TIME < 4.9], 2.0, atol=1e-12)
    np.testing.assert_allclose(signal.above(TIME + CLOCK_LEAD) + signal.reference, series, atol=1e-12)

"""Blocks of a profiled likelihood on records of any length."""

import numpy as np
import pytest

from sprung.model.diagnosis.selection.evidence import profile_gain


@pytest.mark.parametrize("bins", [2, 3, 19, 23, 24, 25, 100, 1000])
@pytest.mark.parametrize("sensors", [1, 3])
def test_gain_of_halved_white_noise_is_that_of_its_likelihood(bins: int, sensors: int) -> None:
    residual = np.random.default_rng(0).standard_normal(2 * bins * sensors)
    gain = profile_gain(residual, residual / np.sqrt(2), sensors, quiet=0.0)
    assert gain == pytest.approx(2 * bins * sensors * np.log(2))

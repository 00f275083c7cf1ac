"""The Bouc-Wen memory from reversal to reversal."""

import numpy as np
import pytest

from sprung.model.laws import SpringDamper
from sprung.model.laws.along import force_along
from sprung.model.laws.trajectory import along
from tests.named_laws import wider_law


@pytest.mark.parametrize("exponent", [1.0, 1.5, 2.0])
@pytest.mark.parametrize("gamma", [0.5, -1.4, -1.0, 0.0, 1.5])
def test_bouc_wen_from_reversal_to_reversal_agrees_with_integration(exponent: float, gamma: float) -> None:
    time = np.arange(6000) / 1000
    d = 3e-3 * np.sin(2 * np.pi * 1.3 * time) + 1e-3 * np.sin(2 * np.pi * 4.1 * time + 1)
    v = np.gradient(d, time)
    law, p = wider_law("bouc_wen"), (9e4, 300.0**exponent, exponent, gamma)
    element = SpringDamper(4e5, 2e4)
    fast = force_along(law, p, d, v, time, element)
    slow = along(law, p, d, v, sample_rate=1000.0, element=element)
    np.testing.assert_allclose(fast, slow, atol=3e-3 * np.abs(slow).max())

"""Forces of laws along trajectories: the fast path at its limits."""

import numpy as np
import pytest

from sprung.model.laws import SpringDamper
from sprung.model.laws.along import force_along
from sprung.model.laws.reversals import bouc_wen_memory
from sprung.model.laws.trajectory import along
from tests.named_laws import element_law


@pytest.mark.parametrize("exponent", [1.0, 1.5, 2.0, 5.3, 8.0])
@pytest.mark.parametrize("gamma", [-4.0, -1.375, 0.5, 4.0])
def test_bouc_wen_stays_finite_where_the_tabulated_way_stands_still(exponent: float, gamma: float) -> None:
    """Growing branches with large exponents end on a plateau of the table: far motions are cut there."""
    time = np.arange(2000) / 200
    deflection = 0.5 * np.sin(2 * np.pi * time) + 0.2 * np.sin(7 * time)
    memory = bouc_wen_memory(deflection, 300.0**exponent, exponent, gamma)
    assert np.isfinite(memory).all()


@pytest.mark.parametrize("exponent", [5.3, 8.0])
def test_large_exponents_agree_with_integration(exponent: float) -> None:
    time = np.arange(4000) / 1000
    d = 3e-3 * np.sin(2 * np.pi * 1.3 * time) + 1e-3 * np.sin(2 * np.pi * 4.1 * time + 1)
    v = np.gradient(d, time)
    law, p, element = element_law("bouc_wen"), (9e4, 300.0**exponent, exponent), SpringDamper(4e5, 2e4)
    fast = force_along(law, p, d, v, time, element)
    slow = along(law, p, d, v, sample_rate=1000.0, element=element)
    np.testing.assert_allclose(fast, slow, atol=1e-2 * np.abs(slow).max())

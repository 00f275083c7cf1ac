"""Forces of laws along trajectories: the fast path at its limits."""

import numpy as np
import pytest

from sprung.model.laws import SpringDamper
from sprung.model.laws.along import force_along
from sprung.model.laws.reversals import bouc_wen_memory
from sprung.model.laws.trajectory import MemoryStep, along, recall
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


@pytest.mark.parametrize(
    ("name", "p"), [("series_stiffness", (1e5,)), ("air_spring", (2e5, 0.1)), ("fractional_stiffness", (1e5, 0.3))]
)
def test_memories_that_decay_are_those_of_single_steps(name: str, p: tuple[float, ...]) -> None:
    """All steps at once, of three motions with values of their own, against one step after the other."""
    law, own = element_law(name), np.array([[0.8], [1.0], [1.2]])
    time = 5 + np.arange(300) / 400
    d, v = own * 1e-3 * np.sin(20 * time), own * 2e-2 * np.cos(20 * time)
    values, element = tuple(value * own for value in p), SpringDamper(1e6 * own, 1e4 * own)
    found = recall(law, values, d, v, time=time, element=element)
    h = 1 / 400
    step = MemoryStep(law, [value[:, 0] for value in values], SpringDamper(*(x[:, 0] for x in element)), h)
    d_half, v_half = (
        0.5 * (d[:, 1:] + d[:, :-1]) + h / 8 * (v[:, :-1] - v[:, 1:]),
        1.5 / h * np.diff(d) - 0.25 * (v[:, 1:] + v[:, :-1]),
    )
    z = found[:, :, 0]
    for i, t in enumerate(time[:-1]):
        ends = (d[:, i], v[:, i], t), (d_half[:, i], v_half[:, i], t + h / 2), (d[:, i + 1], v[:, i + 1], t + h)
        z = step.advance(z, *ends)
        np.testing.assert_allclose(found[:, :, i + 1], z, rtol=1e-11, atol=1e-12 * np.abs(found).max())

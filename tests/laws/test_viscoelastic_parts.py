"""The branches that stand for a fractional derivative, against it."""

from __future__ import annotations

import numpy as np
import pytest

from sprung.model.laws import CATALOGUE, SpringDamper, StructureLaw
from sprung.model.laws.expression import MOTION, parse
from sprung.model.laws.motion import Motion
from tests.named_laws import element_law

RUBBER = element_law("fractional_stiffness")


@pytest.mark.parametrize("order", [0.1, 0.2, 0.35, 0.5])
def test_branches_beside_a_spring_and_a_damper_are_the_power_of_the_frequency_within_a_percent(order: float) -> None:
    s = 2j * np.pi * np.geomspace(0.5, 25, 200)
    wanted = (s / (2 * np.pi)) ** order
    poles = RUBBER.memory_decay((np.array(1.0), np.array(order)), SpringDamper(0.0, 0.0)) if RUBBER.memory_decay else []
    states = np.eye(5)
    weights = [RUBBER.force(Motion(0.0, 0.0, 0.0, tuple(z)), (1.0, order), SpringDamper(0.0, 0.0)) for z in states]
    branches = sum(w * s / (s + pole) for w, pole in zip(weights, np.ravel(poles), strict=True))
    beside = np.column_stack([np.ones_like(s), s]) / np.abs(wanted)[:, None]
    left = (wanted - branches) / np.abs(wanted)
    own = np.linalg.lstsq(np.vstack([beside.real, beside.imag]), np.r_[left.real, left.imag], rcond=None)[0]
    assert np.abs(left - beside @ own).max() < 0.01


def test_the_text_of_the_parts_says_the_same() -> None:
    values = {"stiffness": 3e4, "order": 0.3, "v": 0.2}
    states = np.array([1e-3, 2e-3, -1e-3, 4e-4, 5e-5])
    motion = Motion(0.0, values["v"], 0.0, tuple(states))
    known = {*RUBBER.names, *MOTION}
    element = SpringDamper(0.0, 0.0)
    force = RUBBER.force(motion, (values["stiffness"], values["order"]), element)
    rates = RUBBER.memory_rate(motion, (values["stiffness"], values["order"]), element)
    told = [[parse(text, known)(**values, z=z) for text in part] for part, z in zip(RUBBER.parts, states, strict=True)]
    assert sum(f for f, _ in told) == pytest.approx(float(force), rel=1e-12)
    assert [rate for _, rate in told] == pytest.approx(rates.tolist(), rel=1e-12)


@pytest.mark.parametrize(("loss", "power"), [(0.02, 0.0), (0.1, 0.0), (0.2, 0.0), (0.1, 0.2)])
def test_material_damping_is_a_loss_factor_over_two_decades(loss: float, power: float) -> None:
    law = next(law for law in CATALOGUE if law.name == "structural_damping")
    assert isinstance(law, StructureLaw) and law.branches is not None
    s = 2j * np.pi * np.geomspace(0.5, 25, 60)
    parts = law.branches((loss, power), SpringDamper(3e5, 100.0))
    answer = 3e5 + np.sum([part.stiffness * s * part.time / (1 + s * part.time) for part in parts], axis=0)
    found = answer.imag / answer.real
    assert found[np.argmin(np.abs(np.abs(s) - 2 * np.pi))] == pytest.approx(loss, rel=0.03)
    if loss < 0.05 and not power:
        assert found == pytest.approx(np.full(60, loss), rel=0.1)  # the spring stiffens meanwhile
    assert found[-1] / found[0] == pytest.approx((25 / 0.5) ** power, rel=3 * loss + 0.1)

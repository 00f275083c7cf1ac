"""Formulas of the grammar: units, complexity, and forces that agree with their text."""

from __future__ import annotations

import numpy as np
import pytest

from sprung.model.laws import SpringDamper, observe
from sprung.model.laws.basis import trials
from sprung.model.laws.grammar import OF_DEFLECTION, OF_RATE, Factor, Shape, forms, formula_cost, law_of
from sprung.model.laws.motion import Motion
from sprung.model.laws.trajectory import along

TIME = np.arange(2000) / 400
D = 4e-3 * np.sin(2 * np.pi * 1.3 * TIME) + 1e-3 * np.sin(2 * np.pi * 5.1 * TIME)
V = np.gradient(D, TIME)
SEEN = observe(D, V, 400.0, 4e5, 2e4)


def test_every_shape_is_a_law_with_trials_along_a_motion() -> None:
    for form in forms():
        law = law_of((form,))
        trials = law.shapes(SEEN)
        assert trials.shape[1] == len(law.parameters) and len(trials) >= 1
        if not law.memory:
            force = law.force(Motion(D, V, TIME), trials[0], SpringDamper(4e5, 2e4))
            assert force.shape == D.shape and np.any(force)


def test_a_force_is_nothing_at_rest() -> None:
    """A constant would be a preload: it would move the equilibrium, and the stiffness around it."""
    rest = Motion(np.zeros(1), np.zeros(1), np.zeros(1))
    for form in forms():
        law = law_of((form,))
        if not law.memory:
            assert law.force(rest, law.shapes(SEEN)[0], SpringDamper(4e5, 2e4)) == pytest.approx(0.0)
    for name, basis in trials().items():
        assert np.array(basis(np.zeros(1), np.zeros(1))) == pytest.approx(0.0), name


def test_units_make_the_product_a_force() -> None:
    assert Shape(OF_DEFLECTION[0], OF_RATE[1]).unit == "N s/m^2"  # d |v|
    assert Shape(OF_DEFLECTION[3]).unit == "N/m^2"  # d^2
    assert Shape(Factor("sin(d / L)", inner="L")).unit == "N"
    assert Shape(OF_RATE[2]).unit == "N s^2/m^2"  # v |v|


def test_spring_and_damper_are_no_formulas() -> None:
    assert not {"d", "v"} & {form.text for form in forms()}


def test_more_parts_cost_more() -> None:
    assert formula_cost(1) < formula_cost(2) < formula_cost(4)


def test_a_sum_names_its_values_apart() -> None:
    one, other = Shape(Factor("sin(d / L)", inner="L")), Shape(Factor("max(d - L, 0)", 1, inner="L"))
    law = law_of((one, other))
    assert law.formula == "a * sin(d / L) + b * max(d - L2, 0)"
    assert law.names == ("a", "L", "b", "L2")


def test_the_hidden_state_is_filtered_as_it_is_integrated() -> None:
    law = law_of((Shape(Factor("z**2", 2), memory=True),))
    p = (3e7, 0.08)
    assert law.path is not None
    quick = law.path(Motion(D, V, TIME), p)
    slow = along(law, p, D, V, sample_rate=400.0, element=SpringDamper(0.0, 0.0))
    assert quick == pytest.approx(slow, abs=2e-3 * np.abs(slow).max())

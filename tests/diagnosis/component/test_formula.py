"""Formulas of a system file that component tests can fit: those that are linear in their amplitudes."""

from __future__ import annotations

import pytest

from sprung.model.diagnosis.component.formula import given_piece
from sprung.model.laws.formula import formula_law


@pytest.mark.parametrize(
    ("formula", "values"),
    [
        ("a * d**3", {"a": 1e9}),
        ("a * d**2 + b * d * abs(v)", {"a": 1e7, "b": 2e6}),
        ("a * max(d - L, 0)", {"a": 1e6, "L": 5e-3}),
        ("a * (exp(d / L) - 1)", {"a": 10.0, "L": 1e-5}),  # without a finite force at a centimetre
        ("a * tanh(v / U) + b", {"a": 300.0, "U": 0.01, "b": 50.0}),
        ("a * d / abs(d)", {"a": 300.0}),  # without a force at rest
    ],
)
def test_a_sum_of_amplitudes_times_shapes_is_fitted(formula: str, values: dict[str, float]) -> None:
    piece = given_piece(formula_law(formula, "", tuple(values)), tuple(values.values()))
    assert piece is not None
    assert piece.shape_of(tuple(values.values())) == tuple(v for name, v in values.items() if name not in "abc")


@pytest.mark.parametrize(
    ("formula", "values"),
    [
        ("tanh(a * v)", {"a": 100.0}),
        ("a * b * d", {"a": 100.0, "b": 3.0}),
        ("a * d**2 + a**2 * d", {"a": 3.0}),
        ("abs(a * d)", {"a": 1e5}),
        ("max(a * d - b, 0)", {"a": 1e6, "b": 1e3}),  # twice as large with both twice as large, though no sum
        ("max(a * d, b * v)", {"a": 1e6, "b": 1e5}),
        ("a * d / b", {"a": 1e6, "b": 2.0}),
        ("g * d**3", {"g": 1e9}),  # no amplitude's name
    ],
)
def test_a_formula_that_is_no_such_sum_is_not_fitted(formula: str, values: dict[str, float]) -> None:
    assert given_piece(formula_law(formula, "", tuple(values)), tuple(values.values())) is None


def test_a_formula_with_a_state_is_not_fitted() -> None:
    law = formula_law("a * z", "v - z / tau", ("a", "tau"))
    assert given_piece(law, (1e5, 0.1)) is None

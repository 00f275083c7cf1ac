"""Sensitivities of laws and motion: the Krylov solver of the harmonic balance's tangent."""

import numpy as np
import pytest

from sprung.model.diagnosis.fit.tangent import _gmres
from sprung.model.signals import FloatArray

RNG = np.random.default_rng(5)
COLUMNS, SIZE = 4, 30


def test_all_columns_are_solved_at_once_one_without_a_right_hand_side_included() -> None:
    matrix = np.eye(SIZE) + 0.3 * RNG.normal(size=(SIZE, SIZE)) / np.sqrt(SIZE)
    right = RNG.normal(size=(COLUMNS, SIZE))
    right[2] = 0.0

    found, steps = _gmres(lambda x: np.asarray(x @ matrix.T), right)
    assert steps < SIZE
    assert found == pytest.approx(
        right @ np.linalg.inv(matrix).T, abs=3e-3 * float(np.linalg.norm(right, axis=1).max())
    )
    assert not found[2].any()


def test_a_solution_in_few_directions_takes_as_few_steps() -> None:
    """A matrix of three eigenvalues has a minimal polynomial of degree three."""
    values = np.repeat([1.0, 2.0, 5.0], SIZE // 3)
    right = RNG.normal(size=(COLUMNS, SIZE))
    found, steps = _gmres(lambda x: np.asarray(x * values), right)
    assert steps <= 3
    assert found == pytest.approx(right / values, rel=1e-2, abs=1e-2)


def test_what_diverges_is_handed_back_as_such() -> None:
    def grows(x: FloatArray) -> FloatArray:
        return np.full_like(x, np.inf)

    with np.errstate(all="ignore"):
        found, _ = _gmres(grows, np.ones((1, SIZE)))
    assert not np.isfinite(found).any()

"""What a window says of gains, delays and loads, against the normal equations of a linear model."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from sprung.model.identification.refinement.refine import Refined
from sprung.model.identification.window_deviations import deviating_of
from sprung.model.signals import FloatArray

P, C, X, T = 3, 2, 1, 40  # parameters, channels, loads, numbers that are compared
H = 2 * C + X
SPREAD = np.array([0.3])  # standard deviation of the load's prior


class LinearWindow:
    """y = A x + B l + D h + e, e of unit variance: parameters x, a load l, gains and delays h."""

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        self.A, self.B, self.D = (rng.normal(size=(T, n)) for n in (P, X, 2 * C))
        self.y = rng.normal(size=T) + self.A @ rng.normal(size=P) + self.B @ [0.2]

    def refined(self, *, weighed: bool = True) -> Refined:
        """x and l refined together, with the prior of l; evidence on h beside them."""
        both = np.column_stack([self.A, self.B])
        covariance = np.linalg.inv(both.T @ both + np.diag([0.0] * P + [SPREAD[0] ** -2]))
        value = covariance @ both.T @ self.y
        cross, information, score = np.zeros((P + X, H)), np.zeros((H, H)), np.zeros(H)
        if weighed:
            cross[:, : 2 * C] = -covariance @ both.T @ self.D
            information[: 2 * C, : 2 * C] = self.D.T @ (np.eye(T) - both @ covariance @ both.T) @ self.D
            score[: 2 * C] = self.D.T @ (self.y - both @ value)
        fields: dict[str, Any] = {name: np.zeros(1) for name in Refined.__slots__}
        fields |= {"log_ratio": value[None], "covariance": covariance[None], "chi_square": np.ones(1)}
        fields |= {"cross": cross[None], "information": information[None], "score": score[None]}
        return Refined(**(fields | {"weighed": np.array([weighed]), "freedom": np.array([float(T)])}))


@pytest.mark.parametrize("seed", [1, 2])
def test_loads_are_deviations_beside_gains_and_delays_with_the_parameters_profiled_out(seed: int) -> None:
    made = LinearWindow(seed)
    refined = made.refined()
    found = deviating_of(refined, 0, P, C, SPREAD, None)
    assert found is not None and found.whole
    given = np.linalg.inv(made.A.T @ made.A)
    Z = np.column_stack([made.D, made.B])
    left = np.eye(T) - made.A @ given @ made.A.T
    load = refined.log_ratio[0, P:]
    np.testing.assert_allclose(found.given, given)
    np.testing.assert_allclose(found.cross, -given @ made.A.T @ Z, atol=1e-12)
    np.testing.assert_allclose(found.information, Z.T @ left @ Z, atol=1e-10)
    np.testing.assert_allclose(found.score, Z.T @ left @ (made.y - made.B @ load), atol=1e-10)
    np.testing.assert_array_equal(found.point, [0.0] * 2 * C + load.tolist())


def test_a_window_that_is_not_weighed_speaks_of_loads_alone() -> None:
    made = LinearWindow(3)
    found = deviating_of(made.refined(weighed=False), 0, P, C, SPREAD, None)
    assert found is not None and not found.whole
    assert not found.cross[:, : 2 * C].any() and not found.information[: 2 * C].any()
    left = np.eye(T) - made.A @ np.linalg.inv(made.A.T @ made.A) @ made.A.T
    np.testing.assert_allclose(found.information[2 * C :, 2 * C :], made.B.T @ left @ made.B)


def test_of_a_gain_that_was_taken_back_the_rest_counts_by_the_samples_that_are_left() -> None:
    """Samples were divided by 1.25: what is left of the gain moves them by as much less."""
    made, point = LinearWindow(4), np.zeros(H)
    point[0] = 0.25
    plain, corrected = (deviating_of(made.refined(), 0, P, C, SPREAD, at) for at in (None, point))
    assert plain is not None and corrected is not None
    scale: FloatArray = np.ones(H)
    scale[0] = 1 / 1.25
    np.testing.assert_allclose(corrected.cross, plain.cross * scale)
    np.testing.assert_allclose(corrected.information, plain.information * np.outer(scale, scale))
    np.testing.assert_allclose(corrected.score, plain.score * scale)
    assert corrected.point[0] == 0.25


def test_a_window_without_loads_and_weights_says_nothing() -> None:
    made = LinearWindow(5).refined(weighed=False)
    assert deviating_of(made, 0, P + X, C, SPREAD, None) is None

"""A window before it is fused: linear values, the weight of noise in its inputs, and whether anything is watched."""

from __future__ import annotations

import numpy as np
import pytest

from sprung.model.signals import FloatArray
from sprung.model.tracking import coverage
from sprung.model.tracking.filter import Belief
from sprung.model.tracking.median import median
from sprung.model.tracking.window import MAX_STD, TrackedWindow, in_linear_scale, is_covariance, noise_weight

STD = 0.08  # of a stiffness over its true value, of one window


def window(value: FloatArray, covariance: FloatArray) -> TrackedWindow:
    parameters = len(value)
    everything = np.ones(parameters, dtype=bool)
    return TrackedWindow(everything, 0, 0, 0.5, 1.0, value, covariance, np.ones((parameters, 1)), own_cross=True)


def belief(level: FloatArray, std: float) -> Belief:
    size = len(level)
    return Belief(np.concatenate([level, np.zeros(size)]), np.eye(2 * size) * std**2)


def test_windows_whose_stiffness_errs_symmetrically_are_averaged_without_a_bias() -> None:
    """A window that reads too large states too small an error of the logarithm: its weight is larger by (1 + e)^2."""
    errors = np.array([-2.0, -1.0, -0.5, 0.5, 1.0, 2.0]) * STD
    stated = np.diag((STD / (1 + errors)) ** 2)
    made = in_linear_scale(window(np.log1p(errors), stated), belief(np.zeros(6), 1e-9))
    np.testing.assert_allclose(made.value, errors, atol=1e-9)
    np.testing.assert_allclose(np.diag(made.covariance), STD**2, rtol=1e-9)
    weights = 1 / np.diag(stated)
    assert weights @ np.log1p(errors) / weights.sum() > 0.8 * STD**2  # as it would be of the logarithms
    assert np.mean(made.value) == pytest.approx(0.0, abs=1e-9)


def test_a_precise_window_and_one_at_the_believed_level_stay_as_they_are() -> None:
    for value, std in ((0.01, 0.01), (0.0, STD)):
        plain = window(np.array([value]), np.array([[std**2]]))
        assert in_linear_scale(plain, belief(np.zeros(1), 1e-9)) is plain


def test_a_window_too_imprecise_in_linear_scale_is_dropped_for_a_parameter_that_is_known() -> None:
    high = window(np.array([0.5]), np.array([[0.15**2]]))  # 0.15 of 1.6 times the value
    assert 0.15 * np.exp(0.5) > MAX_STD
    assert not in_linear_scale(high, belief(np.zeros(1), 1e-3)).mask.any()
    assert in_linear_scale(high, belief(np.zeros(1), 0.5)).mask.all()


def test_noise_in_the_inputs_costs_a_window_its_weight() -> None:
    weights = [noise_weight(share) for share in (0.0, 0.01, 0.05, 0.2, 0.6)]
    assert weights[0] == 1.0 and weights[1] > 0.95 and weights[-1] < 0.05
    assert weights == sorted(weights, reverse=True)


def test_a_covariance_is_finite_and_positive_definite() -> None:
    assert is_covariance(np.array([[2.0, 0.5], [0.5, 1.0]]))
    assert not is_covariance(np.array([[1.0, 2.0], [2.0, 1.0]]))
    assert not is_covariance(np.array([[np.nan, 0.0], [0.0, 1.0]]))


def test_a_vehicle_is_monitored_while_half_of_its_last_windows_could_be_used() -> None:
    seen = coverage.Coverage()
    assert not seen.monitored
    seen = coverage.update(seen, usable=True)
    assert seen.monitored and seen.share == 1.0
    for _ in range(coverage.MEMORY):
        seen = coverage.update(seen, usable=True)
    lost = 0
    while seen.monitored:
        seen, lost = coverage.update(seen, usable=False), lost + 1
    assert lost == pytest.approx(np.log(2) * coverage.MEMORY, abs=1.0)


@pytest.mark.parametrize("count", [1, 2, 5, 8])
def test_the_median_is_numpys(count: int) -> None:
    values = np.random.default_rng(count).normal(size=count)
    assert median(values) == np.median(values)

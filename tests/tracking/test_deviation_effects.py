"""Correction of windows for believed gains and loads, against least squares with those gains and loads known."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from sprung.model.identification.measurements.deviations import Deviation
from sprung.model.signals import Deviating, Estimate, FloatArray
from sprung.model.tracking import changes, deviation_record
from sprung.model.tracking.deviation_effects import DeviationEffects
from sprung.model.tracking.deviation_model import model_of
from sprung.model.tracking.deviation_record import DeviationRecord
from sprung.model.tracking.filter import Belief
from sprung.model.tracking.settings import TrackerSettings

P, H, SAMPLES = 2, 3, 40
SETTINGS = TrackerSettings()
MODEL = model_of(
    (Deviation("car_1l", "gain", 0.015, 0), Deviation("car_1r", "gain", 0.015, 1), Deviation("car", "load", 0.2, -1))
)
EFFECTS = DeviationEffects(SETTINGS, MODEL)
ALL = np.ones(P, dtype=bool)
RNG = np.random.default_rng(4)
DESIGN, DEVIATIONS = RNG.normal(size=(SAMPLES, P)), RNG.normal(size=(SAMPLES, H))  # measured = both, and noise of 1
MEASURED = DESIGN @ [0.3, -0.2] + DEVIATIONS @ [0.02, -0.01, 0.3] + RNG.normal(size=SAMPLES)
GIVEN = np.asarray(np.linalg.inv(DESIGN.T @ DESIGN), dtype=np.float64)
CROSS = -GIVEN @ DESIGN.T @ DEVIATIONS
BELIEVED = np.array([0.015, -0.02, 0.25])


def least_squares(deviations: FloatArray) -> FloatArray:
    """Log-ratios (P,) were the deviations (H,) known."""
    return np.asarray(GIVEN @ DESIGN.T @ (MEASURED - DEVIATIONS @ deviations))


def belief(std: float = 0.01) -> Belief:
    return Belief(np.concatenate([np.zeros(2 * P), BELIEVED]), np.eye(2 * P + H) * std**2, H)


def state_of(believed: Belief, record: DeviationRecord, learned: changes.Changes | None = None) -> Any:
    """As much of a tracker's state as is read."""
    return SimpleNamespace(belief=believed, calibration=record, changes=learned)


def window(point: FloatArray, *, whole: bool = True) -> Estimate:
    """A window refined at the deviations `point` (H,); not whole: it knows sensitivities to the load alone."""
    cross = CROSS if whole else CROSS * MODEL.cargo
    found = Deviating(point, GIVEN, cross, np.eye(H), np.zeros(H), SAMPLES - P, whole)
    return Estimate(least_squares(point), GIVEN, ALL, 0.1, np.zeros(SAMPLES), 1.0, True, True, 3, deviating=found)


@pytest.mark.parametrize("point", [np.zeros(H), np.array([0.01, 0.03, 0.1])])
def test_a_window_is_what_it_would_be_with_the_believed_deviations(point: FloatArray) -> None:
    estimate = window(point)
    record = deviation_record.start(P, MODEL)
    value, covariance, _ = EFFECTS.corrected(estimate, estimate.deviating, record, belief(), ALL)
    np.testing.assert_allclose(value, least_squares(BELIEVED))
    np.testing.assert_array_equal(covariance, GIVEN)


def test_what_a_window_does_not_measure_is_not_corrected() -> None:
    estimate, record = window(np.zeros(H)), deviation_record.start(P, MODEL)
    mask = np.array([True, False])
    value, _, _ = EFFECTS.corrected(estimate, estimate.deviating, record, belief(), mask)
    assert value[0] == pytest.approx(least_squares(BELIEVED)[0]) and value[1] == 0


def test_without_sensitivities_of_its_own_a_window_is_corrected_by_mean_ones_and_counts_for_less() -> None:
    estimate = replace(window(np.zeros(H)), deviating=None)
    record = replace(deviation_record.start(P, MODEL), cross=CROSS)
    value, covariance, _ = EFFECTS.corrected(estimate, None, record, belief(), ALL)
    of_channels = np.where(MODEL.refined, 0.0, BELIEVED)  # its load was estimated with it
    np.testing.assert_allclose(value, least_squares(of_channels))
    assert (covariance.diagonal() > GIVEN.diagonal()).all()
    correlation = covariance[0, 1] / np.sqrt(covariance.diagonal().prod())
    assert correlation == pytest.approx(GIVEN[0, 1] / np.sqrt(GIVEN.diagonal().prod()))


def test_uncertain_deviations_scatter_a_window_by_as_much_as_draws_of_them_do() -> None:
    covariance = np.array([[4.0, 1.0, 0.5], [1.0, 3.0, -1.0], [0.5, -1.0, 5.0]]) * 1e-4
    of_all = np.eye(2 * P + H)
    of_all[2 * P :, 2 * P :] = covariance
    prior = replace(belief(), covariance=of_all)
    chosen = np.array([True, False, True])
    drawn = np.random.default_rng(6).multivariate_normal(np.zeros(H), covariance, 40_000) * chosen
    expected = np.var(drawn @ CROSS.T, axis=0)
    np.testing.assert_allclose(EFFECTS.variance(prior, CROSS, chosen), expected, rtol=0.03)
    assert not EFFECTS.variance(prior, CROSS, np.zeros(H, dtype=bool)).any()


def test_the_baseline_has_the_mean_sensitivity_of_the_windows_that_it_was_learned_from() -> None:
    rng, state, record = np.random.default_rng(8), changes.start((P,)), deviation_record.start(P, MODEL)
    crosses, variances = rng.normal(size=(5, P, H)), rng.uniform(0.5, 3.0, (5, P))
    for cross, variance in zip(crosses, variances, strict=True):
        after = changes.update(state, np.zeros(P), variance, ALL, seconds=1.0, time=0, settings=SETTINGS)
        record = EFFECTS.learned(state_of(belief(), record, state), after, record, cross)
        state = after
    weights = 1 / variances
    expected = (weights[:, :, None] * crosses).sum(axis=0) / weights.sum(axis=0)[:, None]
    np.testing.assert_allclose(record.base_cross, expected)


@pytest.mark.parametrize(("stds", "too_large"), [(3.0, False), (5.0, True)])
def test_mean_sensitivities_correct_no_window_that_they_shift_far(stds: float, too_large: bool) -> None:
    per_gain = float(np.max(np.abs(CROSS[:, 0]) / np.sqrt(GIVEN.diagonal())))  # in a window's standard deviations
    far = Belief(np.concatenate([np.zeros(2 * P), [stds / per_gain, 0.0, 0.0]]), np.eye(2 * P + H), H)
    record = replace(deviation_record.start(P, MODEL), cross=CROSS)
    state = state_of(far, record)
    assert EFFECTS.too_large(state, window(np.zeros(H), whole=False)) == too_large
    assert not EFFECTS.too_large(state, window(np.zeros(H)))  # it has sensitivities of its own

"""Loads in the belief against Bayes' rule in information form, and windows drawn with and without a change of load."""

from __future__ import annotations

import numpy as np
import pytest

from sprung.model.identification.measurements.deviations import Deviation
from sprung.model.signals import Deviating, FloatArray
from sprung.model.tracking import loads
from sprung.model.tracking.deviation_model import DeviationModel, model_of
from sprung.model.tracking.filter import Belief

P = 3
DEVIATIONS = (
    Deviation("car_1l", "gain", 0.015, 0),
    Deviation("car", "load", 0.2, -1),
    Deviation("car", "roll_inertia", 0.2, -1),
)
H = len(DEVIATIONS)
LOAD = 1  # of the deviations


@pytest.fixture(scope="module")
def model() -> DeviationModel:
    return model_of(DEVIATIONS)


def belief(seed: int) -> Belief:
    """Levels, rates and deviations, all correlated."""
    rng = np.random.default_rng(seed)
    factor = rng.normal(size=(2 * P + H, 2 * P + H)) * 0.03
    return Belief(rng.normal(size=2 * P + H) * 0.02, factor @ factor.T, H)


def window(truth: FloatArray, rng: np.random.Generator, strength: float = 4e3) -> Deviating:
    """What a window says of deviations (H,), of which it knows loads and inertias; refined at a point beside them."""
    root = np.zeros((H, H))
    root[1:, 1:] = np.linalg.cholesky(strength * np.array([[1.0, 0.4], [0.4, 0.6]]))
    information, point = root @ root.T, np.array([0.0, 0.01, -0.02])
    score = information @ (truth - point) + root @ rng.normal(size=H)
    return Deviating(point, np.eye(P), np.zeros((P, H)), information, score, 500.0, whole=False)


@pytest.mark.parametrize("share", [1.0, 0.5])
def test_a_window_updates_everything_by_bayes_rule(model: DeviationModel, share: float) -> None:
    prior, found = belief(1), window(np.array([0.0, 0.1, 0.05]), np.random.default_rng(2))
    after = loads.update(prior, model, found, share)
    E = np.zeros((2 * P + H, H))
    E[2 * P :] = np.eye(H)
    information = np.linalg.inv(prior.covariance) + share * E @ found.information @ E.T
    expected = np.linalg.inv(information)
    pull = share * (found.score - found.information @ (prior.mean[2 * P :] - found.point))
    np.testing.assert_allclose(after.covariance, expected, rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(after.mean, prior.mean + expected @ E @ pull, rtol=1e-6, atol=1e-12)


def test_after_a_stop_loads_are_unknown_and_nothing_else_has_changed(model: DeviationModel) -> None:
    before = belief(3)
    after, at = loads.reset(before, model), 2 * P + np.flatnonzero(model.cargo)
    rest = np.setdiff1d(np.arange(2 * P + H), at)
    np.testing.assert_array_equal(after.mean[at], 0.0)
    np.testing.assert_array_equal(after.covariance[np.ix_(at, at)], np.diag(model.prior.diagonal()[model.cargo]))
    assert not after.covariance[np.ix_(at, rest)].any()
    np.testing.assert_array_equal(after.mean[rest], before.mean[rest])
    np.testing.assert_array_equal(after.covariance[np.ix_(rest, rest)], before.covariance[np.ix_(rest, rest)])


def test_after_a_stop_a_load_known_from_a_pressure_is_as_certain_as_that(model: DeviationModel) -> None:
    after = loads.reset(belief(3), model, np.array([0.12]), np.array([0.02**2]))
    assert after.mean[2 * P + LOAD] == 0.12
    assert after.covariance[2 * P + LOAD, 2 * P + LOAD] == 0.02**2
    assert after.mean[2 * P + 2] == 0.0  # of the inertia the pressure says nothing


def test_windows_contradict_a_load_that_has_changed_and_hardly_ever_one_that_has_not(model: DeviationModel) -> None:
    rng, before = np.random.default_rng(5), belief(6)
    root = np.linalg.cholesky(before.covariance)[2 * P :]
    same = [before.mean[2 * P :] + root @ rng.normal(size=2 * P + H) for _ in range(400)]
    chance = np.mean([loads.contradicted(before, model, window(truth, rng)) for truth in same])
    assert chance < 0.02
    moved = np.array([0.0, 0.6, 0.0])
    assert np.mean([loads.contradicted(before, model, window(truth + moved, rng)) for truth in same]) > 0.9


def test_a_vehicle_without_loads_has_none_that_a_window_could_contradict() -> None:
    without = model_of(DEVIATIONS[:1])
    nothing = Deviating(np.zeros(1), np.eye(P), np.zeros((P, 1)), np.eye(1), np.ones(1) * 1e3, 500.0)
    assert not loads.contradicted(Belief(np.zeros(2 * P + 1), np.eye(2 * P + 1), 1), without, nothing)

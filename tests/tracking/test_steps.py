"""Steps of parameters: for the seconds until the filter has found one, its stated deviation contains it."""

from __future__ import annotations

import numpy as np
import pytest

from sprung.model.signals import FloatArray
from sprung.model.tracking import innovation
from sprung.model.tracking.tracker import Tracker, TrackerState
from tests.tracker_windows import EPOCH, TrackedParameter, correlated, windows

AT = 60.0  # s
DAMPERS = slice(12, 24)
NAMES = [f"element_{i}.{kind}" for kind in ("stiffness", "damping") for i in range(12)]


def errors(seed: int, changed: slice, change: float, seconds: float = 75.0) -> tuple[FloatArray, FloatArray]:
    """Errors over stated deviations after every window (K, P), and stated deviations over the belief's own (K, P)."""
    rng, tracker = np.random.default_rng(seed), Tracker([TrackedParameter(name) for name in NAMES])

    def truth(time: float) -> FloatArray:
        value = np.zeros(24)
        value[changed] = np.log1p(change) * (time >= AT)
        return value

    state: TrackerState = tracker.initial_state()
    found, wider = [], []
    for estimate, start in windows(rng, truth, seconds, correlated(rng)):
        state = tracker.update(state, estimate, start)
        level, std = tracker.posterior(state)
        found.append((level - truth((start - EPOCH) * 1e-9 + 0.5)) / std)
        wider.append(std / np.sqrt(state.belief.level_variance))
        report = tracker.report(state)
        np.testing.assert_allclose([r.log_std for r in report], std)
    return np.array(found), np.array(wider)


@pytest.mark.parametrize("change", [-0.12, -0.05, pytest.param(0.2, marks=pytest.mark.slow)])
def test_a_step_of_all_dampers_is_within_the_stated_deviations_from_its_first_window_on(change: float) -> None:
    of_steps = np.array([errors(seed, DAMPERS, change)[0][119:131, DAMPERS] for seed in (31, 32)])  # 6 s
    assert np.abs(of_steps).max() < 4
    assert np.mean(np.abs(of_steps) < 3) > 0.99


@pytest.mark.parametrize(
    ("element", "change"),
    [
        (3, -0.3),
        pytest.param(14, -0.3, marks=pytest.mark.slow),
        (22, -0.15),
        pytest.param(9, 0.08, marks=pytest.mark.slow),
    ],
)
def test_a_step_of_one_element_is_within_them_from_its_first_window_on(element: int, change: float) -> None:
    of_steps = np.array(
        [errors(seed, slice(element, element + 1), change)[0][119:131, element] for seed in range(33, 39)]
    )
    assert np.abs(of_steps).max() < 3.5
    assert np.mean(np.abs(of_steps) < 3) > 0.98


def test_stationary_deviations_are_hardly_wider_and_errors_are_as_stated() -> None:
    found, wider = errors(36, DAMPERS, 0.0)
    assert np.sqrt(np.mean(wider[60:] ** 2)) < 1.05
    assert 0.6 < np.sqrt(np.mean(found[60:] ** 2)) < 1.1


def test_a_kind_that_steps_together_is_seen_where_noise_hides_it_in_one() -> None:
    """Deviations of one window: each of eight by two, and one of them by nothing."""
    group = np.array([0] * 8 + [-1])
    residual = np.array([2.0] * 7 + [0.0, 2.0])
    one = np.ones(9)
    cusum, _ = innovation.update(innovation.start(9), residual, one, one > 0)
    cusum, _ = innovation.update(cusum, residual, one, one > 0)
    variance = cusum.pending_variance(group)
    common = (residual[:8].mean()) ** 2
    together = 0.5 * 2 * 14.0**2 / (8 * (1 + 7 * innovation.ALIKE))
    assert variance[7] == pytest.approx(common / (1 + np.exp(innovation.DOUBT_OF_KIND - together)))
    assert variance[8] == pytest.approx(4.0 / (1 + np.exp(innovation.DOUBT - 4.0)))  # a log-likelihood ratio of 4
    assert variance[7] > 5 * variance[8]

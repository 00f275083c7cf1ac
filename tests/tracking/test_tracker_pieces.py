"""The tracker's pieces against closed forms: transition, Bayes' rule, thresholds, and the batched test."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import block_diag, expm

from sprung.benchmarks.drift import CorrelatedErrors, Fleet, step_delays
from sprung.model.tracking import changes as change_test
from sprung.model.tracking import filter as kalman
from sprung.model.tracking import inflation, innovation, misfit
from sprung.model.tracking.settings import SECONDS_PER_MONTH, ProcessNoise, design
from sprung.model.tracking.tracker import Tracker, TrackerSettings
from sprung.model.tracking.weather import WeatherModel
from tests.tracker_windows import TrackedParameter, correlated, estimate


def test_prediction_is_the_exact_integral_of_the_process() -> None:
    """Van Loan's matrix exponential gives transition and noise of any linear process."""
    rng = np.random.default_rng(0)
    process = ProcessNoise(drift_rate=3e-3, drift_time=20.0, wander=5e-3)
    factor = rng.normal(size=(4, 4)) * 0.01
    belief = kalman.Belief(rng.normal(size=4), factor @ factor.T)
    dt = 13.0
    drive = np.array([[0.0, 1.0], [0.0, -1 / 20.0]])
    noise = np.diag([5e-3**2, 2 * 3e-3**2 / 20.0])
    loan = expm(np.block([[-drive, noise], [np.zeros((2, 2)), drive.T]]) * dt)
    transition = loan[2:, 2:].T
    added = transition @ loan[:2, 2:]
    order = [0, 2, 1, 3]  # (level, rate) pairs to levels, then rates
    F = block_diag(transition, transition)[np.ix_(order, order)]
    Q = block_diag(added, added)[np.ix_(order, order)]
    after = kalman.predict(belief, dt, process, std=10.0)
    np.testing.assert_allclose(after.mean, F @ belief.mean, rtol=1e-10)
    np.testing.assert_allclose(after.covariance, F @ belief.covariance @ F.T + Q, rtol=1e-8, atol=1e-14)


def test_correction_is_bayes_rule_with_the_full_covariance() -> None:
    rng = np.random.default_rng(1)
    prior = kalman.prior(5, 0.3, ProcessNoise())
    covariance = correlated(rng, np.full(5, 0.02))
    value = rng.normal(size=5) * 0.1
    mask = np.array([True, True, False, True, True])
    after, _ = kalman.correct(prior, value, covariance, mask, share=0.5, bound=1e9)
    H = np.eye(10)[:5][mask]
    noise = covariance[np.ix_(mask, mask)] / 0.5
    information = np.linalg.inv(prior.covariance) + H.T @ np.linalg.inv(noise) @ H
    expected = np.linalg.inv(information)
    np.testing.assert_allclose(after.covariance, expected, rtol=1e-6, atol=1e-15)
    np.testing.assert_allclose(after.mean, expected @ H.T @ np.linalg.solve(noise, value[mask]), atol=1e-12)


def test_influence_of_one_component_is_bounded() -> None:
    prior = kalman.Belief(np.zeros(4), np.diag([1e-4, 1e-4, 1e-9, 1e-9]))
    everything = np.ones(2, dtype=bool)

    def moved(value: float) -> float:
        after, _ = kalman.correct(prior, np.array([value, 0.0]), 1e-4 * np.eye(2), everything, share=1.0, bound=3.0)
        return float(after.mean[0])

    assert moved(0.01) == pytest.approx(0.005)
    assert moved(10.0) < 0.05


def test_reopened_level_forgets_only_itself() -> None:
    rng = np.random.default_rng(2)
    factor = rng.normal(size=(6, 6))
    belief = kalman.Belief(rng.normal(size=6), factor @ factor.T)
    after = kalman.reopen(belief, np.array([0.0, 4.0, 0.0]), ProcessNoise())
    assert after.covariance[1, 1] == pytest.approx(belief.covariance[1, 1] + 4.0)
    keep = np.ix_([0, 2, 3, 5], [0, 2, 3, 5])
    np.testing.assert_array_equal(after.covariance[keep], belief.covariance[keep])
    assert np.all(np.linalg.eigvalsh(after.covariance) > 0)


def test_design_keeps_the_false_alarm_rate_for_every_quality_of_baseline() -> None:
    """E exp(-h (1 - 2 o / size)) over o ~ N(0, B) equals exp(-evidence), by numerical integration."""
    evidence = 20.0
    variance = np.array([0.0, 1e-6, 4e-6, 9e-6, 1e-4])
    size, threshold = design(evidence, 0.05, variance)
    assert size[0] == 0.05
    assert threshold[0] == pytest.approx(evidence)
    assert size[-1] > 0.1
    grid = np.linspace(-14, 14, 20001)
    for s, h, b in zip(size[1:], threshold[1:], variance[1:], strict=True):
        log_rate = -h * (1 - 2 * grid * np.sqrt(b) / s) - grid**2 / 2 - 0.5 * np.log(2 * np.pi)
        rate = np.trapezoid(np.exp(log_rate), grid)
        assert np.log(rate) == pytest.approx(-evidence, abs=1e-3)


@pytest.mark.parametrize("std", [0.02, 0.035, 0.06])
def test_false_alarms_do_not_exceed_the_stated_rate(std: float) -> None:
    """Thresholds as for one false alarm in 3000 windows, so that a minute of Monte Carlo counts many."""
    windows, vehicles, size = 600, 400, 4
    rate = SECONDS_PER_MONTH / (3000 * 0.5)
    settings = TrackerSettings(learning=300.0, baseline_std=1e-3, false_alarms_per_month=rate)
    fleet = Fleet(vehicles, size, settings)
    errors = CorrelatedErrors(np.eye(size)[None] * std**2, vehicles, np.random.default_rng(3))
    opened = 0
    for k in range(600 + windows):
        before = fleet.changes.active
        fleet.update(*errors.draw())
        if k >= 600:
            opened += int(np.count_nonzero((fleet.changes.active != 0) & (before == 0)))
    allowed = windows * vehicles / 3000
    assert 0 < opened < 1.2 * allowed


def test_batched_change_test_alarms_exactly_when_the_tracker_does() -> None:
    rng = np.random.default_rng(4)
    size, vehicles = 5, 3
    covariance = correlated(rng, np.array([0.003, 0.01, 0.02, 0.03, 0.03]))
    errors = CorrelatedErrors(covariance[None], vehicles, rng)
    none, kinds = np.zeros((size, 4)), np.zeros((0, 4))  # nothing in common, no slopes
    alone = WeatherModel(np.full(size, -1), none, none, kinds, kinds, np.zeros(0))
    tracker = Tracker([TrackedParameter(f"element_{i}.damping") for i in range(size)], weather=alone)
    states = [tracker.initial_state() for _ in range(vehicles)]
    fleet = Fleet(vehicles, size, tracker.settings)
    jump = np.array([[0.06, 0, 0, 0, 0], [0, 0, -0.08, 0, 0], [0, 0, 0, 0.1, 0]])
    for k in range(260):
        value = errors.draw()[0] + jump * (120 <= k < 200)
        fleet.update(value, covariance)
        for v in range(vehicles):
            states[v] = tracker.update(states[v], estimate(value[v], covariance), k * 500_000_000)
        active = np.array([state.changes.active for state in states])
        np.testing.assert_array_equal(active, fleet.changes.active)
    np.testing.assert_allclose([state.changes.up for state in states], fleet.changes.up)
    assert [len(state.alarms) for state in states] == [1, 1, 1]


def test_steps_are_alarmed_in_time_by_windows_as_the_vehicle_gives_them() -> None:
    covariance = np.diag(np.repeat([0.004, 0.008, 0.016, 0.01], [2, 2, 2, 2]) ** 2)[None]
    for index in (0, 5):
        delay, others = step_delays(covariance, index, 0.05, 100, np.random.default_rng(index))
        assert delay.max() < 30.0
        assert others == 0


def test_variance_inflation_is_measured_through_a_drift() -> None:
    rng = np.random.default_rng(5)
    running = inflation.start((200, 1))
    everything = np.ones((200, 1), dtype=bool)
    for k in range(300):
        value = 0.001 * k + 1.5 * 0.02 * rng.normal(size=(200, 1))
        running = inflation.update(running, value, np.full((200, 1), 0.02**2), everything, time=k, window=1)
    assert running.square.mean() == pytest.approx(1.5**2, rel=0.1)


def test_the_innovation_cusum_fires_for_a_lasting_offset_and_hardly_ever_without() -> None:
    rng = np.random.default_rng(6)
    size = 500
    everything, unit = np.ones(size, dtype=bool), np.ones(size)
    quiet = innovation.start(size)
    fired = 0
    for _ in range(400):
        quiet, reopened = innovation.update(quiet, rng.normal(size=size), unit, everything)
        fired += int(np.count_nonzero(reopened))
    assert fired <= 3
    lost, seen = innovation.start(size), np.zeros(size, dtype=bool)
    for _ in range(20):
        lost, reopened = innovation.update(lost, 2.0 + rng.normal(size=size), unit, everything)
        seen |= reopened > 0
    assert seen.mean() > 0.95


def test_one_bad_window_is_no_misfit() -> None:
    fit = misfit.MisfitFloor()
    for k in range(50):
        fit = misfit.update(fit, 1.0, adequate=True, inflation=1.0, time=k)
    fit = misfit.update(fit, 50.0, adequate=False, inflation=1.0, time=50)
    fit = misfit.update(fit, float("nan"), adequate=False, inflation=1.0, time=51)
    assert fit.misfit_since is None
    for k in range(20):
        fit = misfit.update(fit, 1.0, adequate=True, inflation=1.0, time=52 + k)
    assert fit.statistic == 0.0


def test_a_jump_of_a_sensor_ends_what_it_may_have_done_and_no_older_alarm() -> None:
    changes = change_test.start((4,))
    changed = replace(
        changes,
        up=np.array([30.0, 30.0, 8.0, 30.0]),
        up_since=np.array([10, 70, 60, 10]),
        active=np.array([1, 1, 0, 1], dtype=np.int8),
    )
    after = change_test.restarted(changed, 50, np.array([True, True, False, False]))
    assert list(after.active) == [1, 0, 0, 0]
    assert list(after.up) == [30.0, 0.0, 0.0, 0.0]

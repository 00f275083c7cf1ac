"""The tracker against truth: windows are drawn with known parameters and the errors that their covariances state."""

from __future__ import annotations

import json

import numpy as np
import pytest

from sprung.model.signals import FloatArray
from sprung.model.tracking.tracker import (
    Tracker,
    TrackerSettings,
    TrackerSettingsError,
    TrackerState,
    TrackerStateError,
)
from tests.tracker_windows import (
    EPOCH,
    WINDOW_STD,
    TrackedParameter,
    constant,
    correlated,
    estimate,
    make_tracker,
    step,
    windows,
)


def test_posterior_intervals_of_a_healthy_vehicle_cover_the_truth() -> None:
    rng = np.random.default_rng(1)
    tracker = make_tracker()
    scores = []
    for _ in range(5):
        truth = rng.normal(scale=0.2, size=24)
        state = tracker.update_many(tracker.initial_state(), windows(rng, constant(truth), 120, correlated(rng)))
        mean, std = tracker.posterior(state)
        scores.append((mean - truth) / std)
        assert state.alarms == ()
        assert np.all(std < 0.6 * WINDOW_STD)
    assert np.mean(np.abs(scores) < 1.96) > 0.93
    assert np.max(np.abs(scores)) < 4.0
    assert 0.7 < np.sqrt(np.mean(np.square(scores))) < 1.1


@pytest.mark.parametrize("per_window", [1, 2, 5])
def test_overlap_adds_no_certainty_and_intervals_stay_right(per_window: int) -> None:
    rng = np.random.default_rng(2)
    tracker = make_tracker(8)
    covariance = correlated(rng, np.full(8, 0.02))
    scores, stds = [], []
    for _ in range(10):
        stream = windows(rng, constant(np.zeros(8)), 30, covariance, per_window=per_window)
        mean, std = tracker.posterior(tracker.update_many(tracker.initial_state(), stream))
        scores.append(mean / std)
        stds.append(std.mean())
    alone = windows(rng, constant(np.zeros(8)), 30, covariance, per_window=1)
    reference = tracker.posterior(tracker.update_many(tracker.initial_state(), alone))[1].mean()
    assert np.mean(stds) == pytest.approx(reference, rel=0.15)
    assert 0.75 < np.sqrt(np.mean(np.square(scores))) < 1.15


def test_a_drifting_parameter_is_followed_within_its_interval() -> None:
    rng = np.random.default_rng(3)
    tracker = make_tracker()

    def truth(time: float) -> FloatArray:
        value = np.zeros(24)
        value[22] = np.log(1 - 0.45 * (1 - np.exp(-time / 250)))
        value[3] = np.log(1 - 0.2 * (1 - np.exp(-time / 300)))
        return value

    state, errors, scores = tracker.initial_state(), [], []
    for window, time in windows(rng, truth, 300, correlated(rng)):
        state = tracker.update(state, window, time)
        seconds = (time - EPOCH) * 1e-9 + 0.5
        if seconds > 60:
            mean, std = tracker.posterior(state)
            errors.append(np.expm1(mean - truth(seconds))[[3, 22]])
            scores.append(((mean - truth(seconds)) / std)[[3, 22]])
    assert np.max(np.abs(errors)) < 0.02
    assert np.sqrt(np.mean(np.square(scores))) < 1.4
    assert {alarm.parameter for alarm in state.alarms} == {tracker.names[3], tracker.names[22]}
    severity = {alarm.parameter: alarm.severity for alarm in state.alarms}
    assert severity == {tracker.names[3]: "warning", tracker.names[22]: "alarm"}
    assert tracker.health(state) == "out_of_specification"


@pytest.mark.parametrize("index", [0, 9, 14, 21])
@pytest.mark.parametrize("change", [-0.05, 0.05])
def test_a_step_of_five_percent_is_alarmed_within_thirty_seconds_and_alone(index: int, change: float) -> None:
    rng = np.random.default_rng(100 + index)
    tracker = make_tracker()
    stream = windows(rng, step(24, index, change, at=90.0), 135, correlated(rng))
    state = tracker.update_many(tracker.initial_state(), stream)
    (alarm,) = state.alarms
    assert alarm.parameter == tracker.names[index]
    assert 0 < (alarm.opened - EPOCH) * 1e-9 - 90.0 < 30.0
    assert abs((alarm.onset - EPOCH) * 1e-9 - 90.0) < 10.0
    assert alarm.change is not None
    assert alarm.std is not None
    assert alarm.change == pytest.approx(change, abs=4 * alarm.std)
    assert alarm.std < 0.01
    assert tracker.health(state) == "maintenance_required"


def test_a_large_jump_leaves_its_neighbours_where_they_were() -> None:
    rng = np.random.default_rng(5)
    tracker = make_tracker()
    stream = windows(rng, step(24, 2, -0.5, at=60.0), 90, correlated(rng))
    state = tracker.update_many(tracker.initial_state(), stream)
    mean, std = tracker.posterior(state)
    others = np.arange(24) != 2
    assert np.all(np.abs(mean[others]) < 4 * std[others])
    assert mean[2] == pytest.approx(np.log(0.5), abs=4 * std[2])
    assert [alarm.parameter for alarm in state.alarms] == [tracker.names[2]]
    assert tracker.health(state) == "failure" or state.alarms[0].severity == "alarm"


def test_an_alarm_closes_after_recovery_and_does_not_flap() -> None:
    rng = np.random.default_rng(6)
    tracker = make_tracker(4)
    covariance = correlated(rng, np.full(4, 0.01))
    stream = windows(rng, step(4, 1, 0.1, at=60.0, until=120.0), 240, covariance)
    state = tracker.update_many(tracker.initial_state(), stream)
    (alarm,) = state.alarms
    assert alarm.closed is not None
    assert 120 < (alarm.closed - EPOCH) * 1e-9 < 180
    assert alarm.peak is not None
    assert alarm.peak == pytest.approx(0.1, abs=0.03)
    assert tracker.health(state) == "ok"


@pytest.mark.parametrize("change", [0.015, 0.025])
def test_a_change_near_the_limit_of_detection_opens_at_most_one_alarm(change: float) -> None:
    tracker = make_tracker(4)
    for seed in range(2):
        rng = np.random.default_rng(seed)
        covariance = correlated(rng, np.array([0.003, 0.01, 0.02, 0.03]))
        state = tracker.initial_state()
        stream = windows(rng, lambda t: np.full(4, change * (t > 60)), 300, covariance)
        state = tracker.update_many(state, stream)
        names = [alarm.parameter for alarm in state.alarms]
        assert len(names) == len(set(names))


def test_outlying_windows_neither_move_the_posterior_nor_alarm() -> None:
    rng = np.random.default_rng(7)
    tracker = make_tracker()
    stream = windows(rng, constant(np.zeros(24)), 120, correlated(rng))
    for k in range(15, 240, 20):
        window, time = stream[k]
        stream[k] = (estimate(window.log_ratio + rng.normal(size=24), window.covariance), time)
    state = tracker.update_many(tracker.initial_state(), stream)
    mean, std = tracker.posterior(state)
    assert state.outliers >= 12
    assert np.all(np.abs(mean) < 4 * std)
    assert np.all(np.abs(state.changes.baseline) < 4 * np.sqrt(state.changes.baseline_variance))
    assert state.alarms == ()


def test_windows_that_do_not_fit_are_not_fused_and_raise_an_alarm_that_recovers() -> None:
    rng = np.random.default_rng(8)
    tracker = make_tracker(4)
    covariance = correlated(rng, np.full(4, 0.01))
    state = tracker.update_many(tracker.initial_state(), windows(rng, constant(np.zeros(4)), 60, covariance))
    before = tracker.posterior(state)
    for window, time in windows(rng, constant(np.ones(4)), 20, covariance, start=60.0):
        wrong = estimate(window.log_ratio, covariance, adequate=False, chi_square=9.0)
        state = tracker.update(state, wrong, time)
    np.testing.assert_array_equal(tracker.posterior(state), before)
    assert state.rejected == 40
    assert state.misfit_since is not None
    assert (state.misfit_since - EPOCH) * 1e-9 == pytest.approx(60.5, abs=1.5)
    assert [alarm.kind for alarm in state.active] == ["misfit"]
    assert tracker.health(state) == "check_function"
    state = tracker.update_many(state, windows(rng, constant(np.zeros(4)), 30, covariance, start=80.0))
    assert state.misfit_since is None
    assert state.active == ()
    assert tracker.health(state) == "ok"


def test_residual_power_above_the_vehicles_own_floor_is_a_misfit_though_each_window_passes() -> None:
    rng = np.random.default_rng(9)
    tracker = make_tracker(2)
    covariance = correlated(rng, np.full(2, 0.01))
    state = tracker.update_many(tracker.initial_state(), windows(rng, constant(np.zeros(2)), 60, covariance))
    for window, time in windows(rng, constant(np.zeros(2)), 20, covariance, start=60.0):
        state = tracker.update(state, estimate(window.log_ratio, covariance, chi_square=1.6), time)
    assert state.misfit_since is not None


def test_windows_that_contradict_each_other_are_a_misfit_though_each_fits() -> None:
    rng = np.random.default_rng(19)
    tracker = make_tracker(4)
    covariance = correlated(rng, np.full(4, 0.01))
    wild = windows(rng, constant(np.zeros(4)), 120, covariance, scatter=2.2)
    state = tracker.update_many(tracker.initial_state(), wild)
    assert [alarm.kind for alarm in state.active] == ["misfit"]
    calm = windows(rng, constant(np.zeros(4)), 240, covariance, start=120.0)
    assert tracker.update_many(state, calm).active == ()


def test_wear_that_takes_a_quarter_of_an_hour_alarms() -> None:
    rng = np.random.default_rng(20)
    tracker = make_tracker(4)
    covariance = correlated(rng, np.array([0.004, 0.016, 0.01, 0.008]))

    def truth(time: float) -> FloatArray:
        return np.array([0.0, -1e-4 * max(0.0, time - 60.0), 0.0, 0.0])

    state = tracker.update_many(tracker.initial_state(), windows(rng, truth, 900, covariance))
    (alarm,) = state.alarms
    assert alarm.parameter == tracker.names[1]
    assert alarm.change is not None
    assert alarm.std is not None
    assert alarm.change == pytest.approx(np.expm1(-0.084), abs=4 * alarm.std)
    assert 0.015 < 1e-4 * ((alarm.opened - EPOCH) * 1e-9 - 60.0) < 0.06


def test_components_that_a_window_does_not_determine_keep_their_prior_and_leave_others_alone() -> None:
    rng = np.random.default_rng(10)
    tracker = make_tracker(6)
    std = np.full(6, 0.01)
    covariance = correlated(rng, std)
    blind = covariance.copy()
    blind[2, :] = blind[:, 2] = 0.0
    blind[2, 2] = 0.25
    seeing = np.arange(6) != 2
    full, partial = tracker.initial_state(), tracker.initial_state()
    for window, time in windows(rng, constant(np.full(6, 0.1)), 30, covariance):
        value = np.where(seeing, window.log_ratio, 0.0)
        partial = tracker.update(partial, estimate(value, blind, identifiable=seeing), time)
        full = tracker.update(full, window, time)
    mean, std = tracker.posterior(partial)
    assert mean[2] == 0.0
    assert std[2] == pytest.approx(tracker.settings.prior, rel=0.01)
    report = tracker.report(partial)[2]
    assert not report.identifiable
    assert report.baseline is None
    assert np.all(np.abs(mean[seeing] - 0.1) < 4 * std[seeing])
    np.testing.assert_allclose(std[seeing], tracker.posterior(full)[1][seeing], rtol=0.05)


def test_windows_that_scatter_more_than_they_say_widen_the_posterior() -> None:
    rng = np.random.default_rng(11)
    tracker = make_tracker()
    scores = []
    for _ in range(3):
        stream = windows(rng, constant(np.zeros(24)), 150, correlated(rng), scatter=1.4)
        state = tracker.update_many(tracker.initial_state(), stream)
        mean, std = tracker.posterior(state)
        scores.append(mean / std)
        assert np.sqrt(state.inflation.factor.mean()) == pytest.approx(1.4, rel=0.1)
        assert all(alarm.kind == "misfit" for alarm in state.alarms)
    assert np.sqrt(np.mean(np.square(scores))) < 1.15


def test_a_gap_makes_the_posterior_less_certain_but_never_less_than_the_prior() -> None:
    rng = np.random.default_rng(12)
    tracker = make_tracker(3)
    covariance = correlated(rng, np.full(3, 0.01))
    state = tracker.update_many(tracker.initial_state(), windows(rng, constant(np.full(3, 0.2)), 60, covariance))
    later = windows(rng, constant(np.full(3, 0.3)), 1, covariance, start=30 * 86400.0)
    resumed = tracker.update(state, *later[0])
    mean, std = tracker.posterior(resumed)
    assert np.all(np.abs(mean - 0.3) < 4 * std)
    np.testing.assert_allclose(std, 0.01, rtol=0.25)  # the vehicle scatters a little more than it says


def test_state_survives_json_bit_for_bit_and_goes_on_the_same() -> None:
    rng = np.random.default_rng(13)
    tracker = make_tracker()
    stream = windows(rng, step(24, 4, 0.3, at=50.0), 90, correlated(rng))
    state = tracker.update_many(tracker.initial_state(), stream[:150])
    assert state.alarms
    text = json.dumps(state.to_dict())
    restored = TrackerState.from_dict(json.loads(text))
    assert json.dumps(restored.to_dict()) == text
    assert len(text) < 40_000
    assert tracker.update_many(restored, stream[150:]).to_dict() == tracker.update_many(state, stream[150:]).to_dict()
    fresh = tracker.initial_state()
    assert TrackerState.from_dict(json.loads(json.dumps(fresh.to_dict()))).to_dict() == fresh.to_dict()


def test_a_window_counts_once_and_the_old_state_is_untouched() -> None:
    rng = np.random.default_rng(14)
    tracker = make_tracker(3)
    stream = windows(rng, constant(np.zeros(3)), 10, correlated(rng, np.full(3, 0.01)))
    state = tracker.update_many(tracker.initial_state(), stream)
    before = json.dumps(state.to_dict())
    assert tracker.update(state, *stream[-1]) is state
    assert tracker.update(state, *stream[3]) is state
    tracker.update(state, stream[0][0], stream[-1][1] + 500_000_000)
    assert json.dumps(state.to_dict()) == before


def test_a_repaired_vehicle_learns_a_new_baseline() -> None:
    rng = np.random.default_rng(15)
    tracker = make_tracker(3)
    covariance = correlated(rng, np.full(3, 0.01))
    state = tracker.update_many(tracker.initial_state(), windows(rng, step(3, 1, 0.3, at=40.0), 80, covariance))
    assert len(state.active) == 1
    state = tracker.relearn(state, [tracker.names[1]])
    assert state.active == ()
    truth = step(3, 1, 0.3, at=0.0)
    state = tracker.update_many(state, windows(rng, truth, 60, covariance, start=80.0))
    assert state.active == ()
    report = tracker.report(state)[1]
    assert report.baseline == pytest.approx(1.3e6, rel=0.02)
    assert report.drift == pytest.approx(0.0, abs=0.02)
    with pytest.raises(TrackerStateError, match="no_such"):
        tracker.relearn(state, ["no_such"])


def test_report_is_in_physical_units_and_relative_to_both_references() -> None:
    rng = np.random.default_rng(16)
    tracker = Tracker(
        [TrackedParameter("spring.stiffness", "N/m", 4e5), TrackedParameter("spring.damping", "N s/m", 2e4)]
    )
    truth = np.log([1.1, 0.8])
    covariance = np.diag([1e-5, 1e-4])
    state = tracker.update_many(tracker.initial_state(), windows(rng, constant(truth), 60, covariance))
    stiffness, damping = tracker.report(state)
    assert (stiffness.name, stiffness.unit) == ("spring.stiffness", "N/m")
    assert stiffness.value == pytest.approx(4.4e5, rel=0.01)
    assert damping.value == pytest.approx(1.6e4, rel=0.03)
    assert damping.ratio == pytest.approx(0.8, rel=0.03)
    assert damping.std == pytest.approx(damping.value * damping.log_std)
    assert damping.baseline == pytest.approx(1.6e4, rel=0.01)
    assert damping.baseline is not None and damping.drift == pytest.approx(damping.value / damping.baseline - 1)


def test_unusable_estimates_and_foreign_states_are_refused_in_plain_words() -> None:
    tracker = make_tracker(3)
    state = tracker.initial_state()
    broken = estimate(np.zeros(3), np.full((3, 3), np.nan))
    assert tracker.update(state, broken, EPOCH).rejected == 1
    assert tracker.update(state, estimate(np.zeros(3), np.eye(3), converged=False), EPOCH).rejected == 1
    with pytest.raises(TrackerStateError, match="start a new state"):
        make_tracker(2).update(state, estimate(np.zeros(2), np.eye(2)), EPOCH)
    with pytest.raises(TrackerStateError, match="format"):
        TrackerState.from_dict({"format": 99})
    damaged = state.to_dict()
    del damaged["belief"]
    with pytest.raises(TrackerStateError, match="belief"):
        TrackerState.from_dict(damaged)
    with pytest.raises(TrackerSettingsError, match="change"):
        TrackerSettings(change=0.3)
    with pytest.raises(TrackerSettingsError, match="learning"):
        TrackerSettings(learning=-1.0)

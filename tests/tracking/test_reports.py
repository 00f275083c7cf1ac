"""Health by NAMUR NE 107, and parameters in physical units: what is stated of a state that was put together."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sprung.model.tracking.coverage import Coverage
from sprung.model.tracking.drift import Drift
from sprung.model.tracking.reports import health_of, reported
from sprung.model.tracking.settings import TrackerSettings
from sprung.model.tracking.state import Alarm, TrackerState
from tests.tracker_windows import EPOCH, TrackedParameter, make_tracker

SETTINGS = TrackerSettings()
LARGE = SETTINGS.failure_change
CHANGE = Alarm("change", "element_0.stiffness", EPOCH, EPOCH, "warning", change=-0.05)
SERIOUS = replace(CHANGE, severity="alarm", change=-0.9 * LARGE)
FAILED = replace(CHANGE, severity="alarm", change=-LARGE)
GAIN = Alarm("sensor", "car_1l.gain", EPOCH, EPOCH, "warning", change=0.05)
FROZEN = Alarm("sensor", "car_1l.frozen", EPOCH, EPOCH, "alarm")
WATCHED = Coverage(100, 1.0)
MISFIT = Alarm("misfit", None, EPOCH, EPOCH, "alarm")


def state_with(*alarms: Alarm, coverage: Coverage = WATCHED) -> TrackerState:
    return replace(make_tracker(2).initial_state(), alarms=alarms, coverage=coverage)


@pytest.mark.parametrize(
    ("alarms", "health"),
    [
        ((), "ok"),
        ((replace(FAILED, closed=EPOCH),), "ok"),
        ((CHANGE,), "maintenance_required"),
        ((GAIN,), "maintenance_required"),
        ((CHANGE, SERIOUS), "out_of_specification"),
        ((SERIOUS, FROZEN), "check_function"),
        ((SERIOUS, MISFIT), "check_function"),
        ((MISFIT, FROZEN, FAILED), "failure"),
    ],
)
def test_health_is_the_worst_of_what_is_active(alarms: tuple[Alarm, ...], health: str) -> None:
    assert health_of(state_with(*alarms), SETTINGS) == health


@pytest.mark.parametrize("coverage", [Coverage(), Coverage(50, 0.2)])
def test_a_vehicle_that_nobody_watches_is_to_be_checked(coverage: Coverage) -> None:
    assert health_of(state_with(SERIOUS, coverage=coverage), SETTINGS) == "check_function"
    assert health_of(state_with(FAILED, coverage=coverage), SETTINGS) == "failure"


def test_values_and_drifts_are_stated_in_units_once_their_baseline_is_learned() -> None:
    tracker = make_tracker(2)
    state = tracker.initial_state()
    mean, covariance = state.belief.mean.copy(), state.belief.covariance.copy()
    mean[0], covariance[0, 0] = np.log(1.2), 0.01**2
    learned = state.changes.learned.copy()
    learned[0] = tracker.settings.learning
    weight = np.array([0.002**-2, 0.0])  # 1 / variance of the baseline
    state = replace(
        state,
        belief=replace(state.belief, mean=mean, covariance=covariance),
        changes=replace(state.changes, learned=learned, weight=weight),
    )
    drift = Drift(np.array([0.2, 0.0]), np.array([0.011, 0.0]), np.array([0.2, 0.0]))
    parameters = [TrackedParameter("a.stiffness", nominal=2e6), TrackedParameter("b.stiffness", nominal=2e6)]
    doubt = np.array([0.02**2, 0.0])
    first, second = reported(parameters, state, tracker.settings, np.zeros(2), drift, doubt, {"b.stiffness": "car_1l"})
    std = np.hypot(0.01, 0.02)  # of the belief, and of what is the same in all windows
    assert (first.value, first.ratio, first.std) == pytest.approx((2.4e6, 1.2, 2.4e6 * std))
    assert (first.baseline, first.baseline_std) == pytest.approx((2e6, 2e6 * 0.002))
    assert (first.drift, first.drift_std, first.identifiable) == (0.2, 0.011, True)
    assert second.baseline is second.drift is None and not second.identifiable and second.lost_with == "car_1l"

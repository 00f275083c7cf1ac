"""A vehicle whose clock was wrong: a state whose times are shifted goes on as after windows that came as much later."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sprung.model.signals import MeasurementFault
from sprung.model.tracking.state import TrackerState
from sprung.model.tracking.tracker import Tracker
from tests.tracker_windows import Stream, correlated, make_tracker, step, windows

DAY = 24 * 3600 * 1_000_000_000
SHIFTED = 330  # windows, when the clock is put right: two seconds after a change that is no alarm yet


def followed(tracker: Tracker, state: TrackerState, stream: Stream, by: int) -> TrackerState:
    return tracker.update_many(state, [(one, time + by) for one, time in stream])


@pytest.mark.parametrize("by", [DAY, -DAY, 500_000_000])
def test_alarms_after_the_clock_was_put_right_are_those_of_windows_that_were_always_right(by: int) -> None:
    rng, tracker = np.random.default_rng(17), make_tracker(6)
    covariance = correlated(rng, np.full(6, 0.01))
    stream = windows(rng, step(6, 2, -0.06, at=SHIFTED / 2 - 2.0), 260.0, covariance)
    frozen = (MeasurementFault("car_1l", "frozen", 0.3),)
    stream = [(replace(one, faults=frozen) if k > SHIFTED - 20 else one, time) for k, (one, time) in enumerate(stream)]
    wrong = followed(tracker, tracker.initial_state(), stream[:SHIFTED], 0)
    assert not any(alarm.kind == "change" for alarm in wrong.alarms)
    put_right = followed(tracker, wrong.shifted(by), stream[SHIFTED:], by)
    always = followed(tracker, tracker.initial_state(), stream, by)
    changes = [[alarm for alarm in state.alarms if alarm.kind == "change"] for state in (put_right, always)]
    assert changes[0] == changes[1] and changes[0][0].parameter == "element_2.stiffness"
    assert put_right.time == always.time and put_right.stuck == always.stuck
    np.testing.assert_array_equal(put_right.belief.mean, always.belief.mean)
    np.testing.assert_array_equal(put_right.inflation.square, always.inflation.square)
    reported = [alarm.opened for alarm in wrong.alarms]
    assert [alarm.opened for alarm in wrong.shifted(by).alarms] == reported  # what was said stays said


def test_a_state_without_windows_has_no_time_to_shift() -> None:
    state = make_tracker(2).initial_state().shifted(DAY)
    assert state.time is None and state.last is None

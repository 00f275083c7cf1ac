"""Every deciding number of the tracker has a reason and a range that it stands in; a tracker uses those it is given."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
import pytest

from sprung.model.tracking.misfit import MisfitFloor, update
from sprung.model.tracking.rules import TRACKING_RULES, reason
from sprung.model.tracking.tracker import TrackerSettings
from tests.tracker_windows import WINDOW_STD, constant, correlated, make_tracker, windows


@pytest.mark.parametrize(("stage", "name"), [(stage, one.name) for stage, one in TRACKING_RULES.constants()])
def test_a_number_says_why_it_is_what_it_is(stage: str, name: str) -> None:
    one = next(f for f in fields(getattr(TRACKING_RULES, stage)) if f.name == name)
    low, high = one.metadata["range"]
    assert low <= one.default <= high and low < high
    assert ("derived" in one.metadata["reason"]) != ("chosen" in one.metadata["reason"])
    assert "insensitive from" in reason(stage, one) or "changes at" in reason(stage, one)
    assert TRACKING_RULES.varied(stage, name, high).varied(stage, name, one.default) == TRACKING_RULES


def test_a_lower_threshold_finds_a_misfit_earlier() -> None:
    rules = TRACKING_RULES.varied("misfit", "threshold", 8.0).misfit
    fits = [MisfitFloor(), MisfitFloor()]
    for k in range(7):
        fits = [
            update(fits[0], 1.0, adequate=False, inflation=1.0, time=k),
            update(fits[1], 1.0, adequate=False, inflation=1.0, time=k, rules=rules),
        ]
    assert [fit.misfit_since is None for fit in fits] == [True, False]


def test_a_tracker_follows_the_rules_of_its_settings() -> None:
    rng = np.random.default_rng(3)
    covariance = correlated(rng)
    size = len(WINDOW_STD)
    stream = windows(rng, constant(np.zeros(size)), 60, covariance)
    stream += windows(rng, constant(np.full(size, np.log(0.9))), 60, covariance, start=60)
    counts = []
    for fewest in (4, 100):
        rules = TRACKING_RULES.varied("alarms", "fewest", fewest)
        tracker = make_tracker(size, TrackerSettings(rules=rules))
        state = tracker.update_many(tracker.initial_state(), stream)
        counts.append(len({alarm.parameter for alarm in state.active}))
    assert counts[0] < counts[1]

"""The benchmark that varies every deciding number of the tracker."""

from __future__ import annotations

from dataclasses import fields
from typing import Any, cast

from sprung.benchmarks.tracking_rules import FOLLOWINGS, Followed, vary
from sprung.model.tracking.rules import TRACKING_RULES, TrackingRules


class ObedientVehicle:
    """A vehicle whose alarm follows one number."""

    name = "made"

    def alarms(self, rules: TrackingRules) -> tuple[list[tuple[str, str]], int]:
        threshold = rules.misfit.threshold
        return ([], -1) if threshold > 25 else ([("all windows", "misfit")], int(threshold))


def test_another_alarm_is_reported_with_the_value_that_made_it() -> None:
    number = next(one for one in fields(TRACKING_RULES.misfit) if one.name == "threshold")  # 12 to 30
    subject = cast(Followed, ObedientVehicle())
    told: dict[str, Any] = vary(subject, "misfit", number, subject.alarms(TRACKING_RULES))
    (change,) = told["changed"]
    assert change["at"] == 30.0 and change["findings"] == [[("all windows", "misfit")], []]
    assert told["rides"] == 8  # at 12, where the alarm is the same


def test_vehicles_are_told_apart_and_one_is_healthy() -> None:
    assert len({one.name for one in FOLLOWINGS}) == len(FOLLOWINGS)
    assert FOLLOWINGS[0].name == "healthy"

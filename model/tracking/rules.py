"""Numbers that decide whether a tracker opens, delays, explains or closes an alarm, by stage, each with its reason.

Time scales, designed changes and the rate of false alarms are settings of a vehicle (`TrackerSettings`); the numbers
here are the same for all, and part of its settings so that a program may change them.  `sprung bench tracking-rules`
varies every one over its range.  What estimates values (walks, memories, linearisation) stays beside its code.
"""

from __future__ import annotations

import json
from dataclasses import Field, dataclass
from functools import cache
from pathlib import Path
from typing import Any

from sprung.model.rule import RuleTable, reason_of, rule

VARIED = Path(__file__).with_name("varied.json")  # made by `sprung bench tracking-rules --write`


def reason(stage: str, number: Field[Any]) -> str:
    """Reason for a number's value, and what the benchmark found for other values."""
    return reason_of(stage, number, _varied())


@cache
def _varied() -> dict[str, Any]:
    found: dict[str, Any] = json.loads(VARIED.read_text(encoding="utf-8"))
    return found


@dataclass(frozen=True)
class ChangeRules:
    """Sequential tests for a change of a parameter."""

    steps: float = rule(6.0, "windows of an alarm at least; chosen: two of them overlap", 4.0, 10.0)
    quiet: float = rule(0.25, "of the threshold, up to which a baseline is refined; chosen", 0.1, 0.4)
    recovery: float = rule(1 / 3, "of the designed change, against which 0 is tested; chosen: a dead zone", 0.2, 0.5)


@dataclass(frozen=True)
class MisfitRules:
    """Test whether windows still fit."""

    reference: float = rule(2.0, "deviations above the floor that are normal; derived: one window in 44", 1.5, 2.5)
    most: float = rule(4.0, "score of one window at most, less the reference; derived: ten windows in a row", 3.0, 6.0)
    threshold: float = rule(20.0, "of the statistic; derived: 2 h k = 80, never by chance", 12.0, 30.0)
    contradiction: float = rule(
        2.5, "variance over the stated one; derived: 1 and 6 deviations of a mean over 60 pairs", 2.0, 3.5
    )
    agreement: float = rule(1.8, "the same, below which windows agree again; chosen: half way", 1.4, 2.2)
    windows: int = rule(60, "that the floor is learned from; derived: its spread is known to a tenth", 30, 120)
    spread: float = rule(0.1, "of log chi-square at least; chosen: one vehicle over speeds and tracks", 0.05, 0.2)


@dataclass(frozen=True)
class JumpRules:
    """Test for jumps and drifts of gains, delays and loads."""

    forgetting: float = rule(0.975, "of the evidence, from window to window; chosen: a memory of 40 s", 0.95, 0.99)
    evidence: float = rule(22.0, "log-likelihood ratio of a jump; derived: one false in ten months", 18.0, 26.0)
    most: float = rule(5.0, "deviations of one window at most; derived: a jump takes two windows", 4.0, 6.5)
    restart: float = rule(1.0, "log-likelihood ratio below which evidence is dropped; chosen: chance", 0.5, 2.0)
    suspected: float = rule(
        6.0, "log-likelihood ratio from which alarms wait; derived: by chance in one window of ten", 4.0, 9.0
    )
    doubt: float = rule(6.0, "log-likelihood ratio at which half of a jump is uncertainty; chosen: as above", 4.0, 9.0)
    drifting: float = rule(
        3.0, "log-likelihood ratio from which a channel is followed faster; derived: by chance in one of 70", 2.0, 4.5
    )
    onset: float = rule(3.0, "log-likelihood ratio that dates a jump; chosen: above chance", 2.0, 5.0)
    rival: float = rule(
        3.0, "log-likelihood ratio within which another jump is named, too; derived: one in 20", 2.0, 4.5
    )
    gain: float = rule(0.01, "jump of a gain without an alarm; chosen: electronics", 0.005, 0.02)
    delay: float = rule(3e-4, "s, jump of a delay without an alarm; chosen: a third of a sample at 1 kHz", 1e-4, 6e-4)
    gain_drift: float = rule(0.03, "of a gain, slow, without an alarm; chosen: 2 % a month are usual", 0.02, 0.05)
    delay_drift: float = rule(2e-3, "s, of a delay, the same; chosen: clocks of nodes", 1e-3, 4e-3)
    reported_gain: float = rule(0.012, "of a gain, that is reported; chosen: tolerance of electronics", 0.008, 0.02)
    reported_delay: float = rule(6e-4, "s, of a delay, the same; chosen", 4e-4, 1e-3)
    known: float = rule(0.2, "of the drift's limit, deviation of a value that is known; chosen", 0.1, 0.3)
    drifted: float = rule(0.5, "of the drift's limit, beyond which a reference is another; chosen", 0.3, 0.7)
    constants: float = rule(0.01, "of a body's constant, that is reported; chosen: drawings", 0.005, 0.02)
    load: float = rule(6.0, "deviations of a window from the believed load; derived: no chance", 4.0, 8.0)


@dataclass(frozen=True)
class WeatherRules:
    """Changes of a kind that weather does not explain."""

    damping: float = rule(0.2, "log-ratio by weather at most; chosen: oil from -20 to 40 degrees", 0.15, 0.3)
    stiffness: float = rule(0.12, "the same; chosen: rubber", 0.08, 0.18)
    others: float = rule(0.1, "the same of other quantities; chosen", 0.07, 0.15)
    fast: float = rule(0.05, "log-ratio off the settled level; chosen: oil that warms up", 0.03, 0.08)
    certain: float = rule(4.0, "deviations besides; derived: one in 16 000", 3.0, 6.0)


@dataclass(frozen=True)
class AlarmRules:
    """Opening, isolation and closing of alarms."""

    certain: float = rule(2.5, "deviations within which two explanations are equally good; derived: 1 %", 2.0, 3.5)
    largest_gain: float = rule(0.3, "gain that may explain a change; chosen: larger ones jump", 0.15, 0.5)
    largest_delay: float = rule(0.03, "s, delay that may; chosen: the same", 0.015, 0.06)
    patience: float = rule(20.0, "s that an alarm waits for information on deviations; chosen", 10.0, 40.0)
    alike: float = rule(0.35, "of the common change, within which an element goes along; chosen", 0.2, 0.5)
    most_of: float = rule(0.75, "of the elements of a kind that go along; chosen: one of four may not", 0.6, 0.9)
    fewest: int = rule(4, "elements that are compared; derived: a median of three is one of them", 3, 6)
    common: float = rule(0.25, "of the designed change, of all of a kind; derived: a median is more precise", 0.15, 0.5)
    recovered: float = rule(0.6, "of the change of a kind, below which its alarm closes; chosen", 0.4, 0.8)
    sensor_recovered: float = rule(0.2, "of the largest deviation, the same of a sensor; chosen", 0.1, 0.35)
    load_known: float = rule(0.02, "deviation of a load that is compared with its limits; chosen", 0.01, 0.04)
    hard: int = rule(6, "windows of a frozen or reversed channel; chosen: three seconds", 4, 10)


@dataclass(frozen=True)
class TrackingRules(RuleTable):
    """The rules of a tracker."""

    changes: ChangeRules = ChangeRules()
    misfit: MisfitRules = MisfitRules()
    jumps: JumpRules = JumpRules()
    weather: WeatherRules = WeatherRules()
    alarms: AlarmRules = AlarmRules()


TRACKING_RULES = TrackingRules()

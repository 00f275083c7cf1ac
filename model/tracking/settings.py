"""Settings of the tracker: the vehicle's time scales and the false alarms that are allowed."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from sprung.model.signals import FloatArray
from sprung.model.tracking.rules import TRACKING_RULES, TrackingRules

SECONDS_PER_MONTH = 365.25 / 12 * 86400.0


class TrackerSettingsError(ValueError):
    """A setting out of its range; the message names it, the value and the range."""


@dataclass(frozen=True, slots=True)
class ProcessNoise:
    """How suspension parameters move: level and rate of the log-ratio, in continuous time.

        d level = rate dt + wander dW1,     d rate = -rate / drift_time dt + sqrt(2 / drift_time) drift_rate dW2

    The rate is an Ornstein-Uhlenbeck process (a damped local linear trend): a parameter that drifts is followed
    without lag, and a gap in the data does not extrapolate a slope for ever.  The defaults are those of a failure
    that develops while one watches (oil loss of a damper, heating, a rubber spring that tears): 5e-4/s is 15 % in
    `drift_time`; slower wear is inside.  `wander` covers temperature: 1.2 % in an hour.
    """

    drift_rate: float = 5e-4  # 1/s, standard deviation of the rate
    drift_time: float = 300.0  # s, how long a rate lasts
    wander: float = 2e-4  # 1/sqrt(s), random walk of the level


@dataclass(frozen=True, slots=True)
class TrackerSettings:
    """Time scales in seconds, changes as fractions, thresholds in what they mean (rates, not raw numbers)."""

    window: float = 1.0  # s, length of one window
    hop: float = 0.5  # s, usual step between windows; only the false-alarm arithmetic uses it
    prior: float = 0.5  # standard deviation of the log-ratio before any window
    process: ProcessNoise = field(default_factory=ProcessNoise)
    learning: float = 30.0  # s of used windows before the baseline is fixed and alarms are armed
    baseline_std: float = 0.0025  # a baseline less certain than this is refined while its parameter is quiet
    change: float = 0.05  # the change that the detector is designed for
    alarm_change: float = 0.20  # severity rises from "warning" to "alarm"
    failure_change: float = 0.50  # health becomes "failure"
    hysteresis: float = 0.8  # a severity falls only below this share of its threshold
    false_alarms_per_month: float = 0.1  # allowed for one vehicle that runs without pause, all parameters together
    recovery_evidence: float = 12.0  # log-likelihood ratio for "healthy again" that closes an alarm
    outlier: float = 3.0  # standard deviations; beyond, influence no longer grows
    kept_alarms: int = 32  # closed alarms kept in the state; the store has them all
    rules: TrackingRules = TRACKING_RULES  # the same for all vehicles

    def __post_init__(self) -> None:
        positive = ("window", "hop", "prior", "learning", "baseline_std", "change", "false_alarms_per_month")
        for name in positive:
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise TrackerSettingsError(f"tracker setting {name!r} is {value}; it must be a positive number")
        if not self.change < self.alarm_change < self.failure_change < 1:
            raise TrackerSettingsError(
                "tracker settings must satisfy change < alarm_change < failure_change < 1; they are "
                f"{self.change}, {self.alarm_change}, {self.failure_change}"
            )

    @property
    def holding(self) -> float:
        """s for which the estimate of the last window holds: no failure of the usual pace makes a change meanwhile."""
        return self.change / self.process.drift_rate

    def evidence(self, parameters: int) -> float:
        """Log-likelihood ratio that one side of one parameter must reach, baseline known exactly.

        Page's test on Gaussian increments of mean -m and variance 2m has, by Siegmund's corrected diffusion
        approximation, (exp(h') - h' - 1) / m windows between false alarms, h' = h + 1.166 sqrt(2 m) (Siegmund,
        Sequential Analysis, 1985, ch. 10).  m exp(-1.166 sqrt(2 m)) never exceeds 0.199, so that per window and side
        the rate is at most 0.199 exp(-h), whatever the windows' noise.
        """
        tests = 2 * parameters * SECONDS_PER_MONTH / self.hop
        return math.log(0.199 * tests / self.false_alarms_per_month)


def design(evidence: float, change: float, baseline_variance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Design change and threshold of each parameter, given how well its baseline is known.

    With a baseline wrong by o the exponent of the false-alarm rate falls from h to h (1 - 2 o / change).  Averaged
    over o ~ N(0, B) the rate keeps its value when h - 2 h^2 B / change^2 = evidence.  Where no h does (B too large)
    the design change is raised until one does with a margin: a parameter that is poorly known alarms later, not
    falsely.
    """
    size = np.maximum(change, np.sqrt(8.0 * evidence * baseline_variance / 0.75))
    threshold = 2.0 * evidence / (1.0 + np.sqrt(1.0 - 8.0 * evidence * baseline_variance / size**2))
    return size, threshold

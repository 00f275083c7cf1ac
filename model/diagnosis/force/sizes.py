"""Sizes of a component's motion: travel, quantiles of the rate, steps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sprung.model.diagnosis.force.motion import ElementMotion
from sprung.model.diagnosis.rules import RULES, ComponentRules
from sprung.model.laws import reversal_step
from sprung.model.signals import FloatArray

_MEDIAN_OF_NORMAL = 0.6745  # of the magnitude, over the deviation


@dataclass(frozen=True)
class MotionSizes:
    """Sizes of a motion, which bound knees, gaps and yield displacements."""

    travel: float  # m, half of the range
    rate: FloatArray  # m/s, quantiles 0 .. 100 % of the magnitude, (101,)
    seconds: float
    step: float  # s
    lowest_knee: float  # m/s, of valves; with lower knees they act like friction
    reach: float  # factor about the typical size, search range of a formula's lengths and rates
    latest: float  # s, of the delay of a channel

    @classmethod
    def of(cls, motion: ElementMotion, rules: ComponentRules = RULES.component) -> MotionSizes:
        quantiles = np.quantile(np.abs(motion.rate), np.linspace(0, 1, 101))
        travel = 0.5 * float(np.ptp(motion.deflection))
        rate, seconds = np.maximum(quantiles, 1e-12), len(motion.time) * motion.step
        usual = max(float(rate[50]), _MEDIAN_OF_NORMAL * float(np.sqrt(np.mean(rate**2))))  # independent of rests
        knee = rules.lowest_knee * usual
        return cls(max(travel, 1e-12), rate, seconds, motion.step, knee, rules.formula_reach, rules.latest)

    @property
    def rate_rms(self) -> float:
        return float(np.sqrt(np.mean(self.rate**2)))

    def slowest_corner(self, motion: ElementMotion) -> float:
        """Change of the rate per sample at a reversal, m/s: knees below it are not resolved."""
        return reversal_step(motion.rate)


def rates_at(seen: MotionSizes, shares: Sequence[float]) -> FloatArray:
    """Rates, m/s, that so many shares (N,) of the time are not exceeded, (N,)."""
    return np.interp(shares, np.linspace(0, 1, 101), seen.rate)

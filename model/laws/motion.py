"""The motion along which laws act, the linear element beside them, and sizes of that motion in a recording."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from sprung.model.signals import FloatArray

_AT_REST = 0.01  # of the largest step of the rate at a reversal: less is no motion
CLOCK_LEAD = 5.0  # s; the clock of the laws starts this long before the first sample of a recording


class Motion(NamedTuple):
    """The motion of an element that a law sees; all entries broadcast with each other."""

    deflection: Any  # m, upper minus lower
    rate: Any  # m/s
    time: Any = 0.0  # s on the laws' clock: CLOCK_LEAD at the first sample
    memory: Any = ()  # the law's own states, first axis: one per state


class SpringDamper(NamedTuple):
    """The linear element that a law belongs to."""

    stiffness: Any  # N/m
    damping: Any  # N s/m


UNIT_ELEMENT = SpringDamper(1.0, 1.0)  # beside which laws are looked at alone


@dataclass(frozen=True, slots=True)
class Observed:
    """Sizes of an element's motion in a recording, which bound knees, gaps and yield displacements."""

    deflection: FloatArray  # quantiles 0, 1 %, ..., 100 % of abs(deflection), m, shape (101,)
    rate: FloatArray  # the same of abs(rate), m/s, shape (101,)
    deflection_rms: float  # m
    rate_rms: float  # m/s
    stiffness: float  # N/m, of the element as identified without any law
    damping: float  # N s/m
    seconds: float  # length of the recording

    def deflection_quantile(self, shares: Sequence[float]) -> FloatArray:
        return np.interp(shares, np.linspace(0, 1, 101), self.deflection)

    def rate_quantile(self, shares: Sequence[float]) -> FloatArray:
        return np.interp(shares, np.linspace(0, 1, 101), self.rate)


def reversal_step(rate: FloatArray) -> float:
    """The rate that one sample passes at a reversal of a motion (T,), m/s, median; 0 where there is none.

    A force that turns within less of it is seen as a jump: the record does not determine the size of its corner.  What
    still trembles where the motion has come to rest does not count.
    """
    passed = np.abs(np.diff(rate))[rate[1:] * rate[:-1] < 0]
    return float(np.median(passed[passed >= _AT_REST * passed.max()])) if len(passed) else 0.0


def observe(
    deflection: FloatArray,
    rate: FloatArray,
    sample_rate: float,
    stiffness: float,
    damping: float,
) -> Observed:
    """Statistics of one element's motion, both of shape (T,)."""
    shares = np.linspace(0, 1, 101)
    return Observed(
        deflection=np.quantile(np.abs(deflection), shares),
        rate=np.quantile(np.abs(rate), shares),
        deflection_rms=float(np.sqrt(np.mean(deflection**2))),
        rate_rms=float(np.sqrt(np.mean(rate**2))),
        stiffness=float(stiffness),
        damping=float(damping),
        seconds=len(deflection) / sample_rate,
    )

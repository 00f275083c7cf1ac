"""Springs and dampers that follow a measured signal: a valve's voltage or current, a temperature.

    k (1 + slope (s - reference))   and   c (1 + slope (s - reference)),

with s the recorded signal and its mean as the reference: laws of one recording, made from it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sprung.model.laws.base import ElementLaw, ParameterSpec, Values, grid
from sprung.model.laws.motion import CLOCK_LEAD, Motion, Observed, SpringDamper
from sprung.model.signal_filters import lfilter_from, lfilter_zi
from sprung.model.signals import FloatArray


@dataclass(frozen=True, eq=False)
class Covariate:
    """A measured signal that neither moves nor weighs anything."""

    name: str
    unit: str
    time: FloatArray  # on the laws' clock, s, (T,)
    series: FloatArray  # (T,)

    @staticmethod
    def of(name: str, unit: str, series: FloatArray, sample_rate: float) -> Covariate | None:
        """A recorded column (T,), its gaps closed; None if it is constant or absent."""
        good = np.isfinite(series)
        if not good.any() or np.ptp(series[good]) == 0:
            return None
        time = CLOCK_LEAD + np.arange(len(series)) / sample_rate
        return Covariate(name, unit, time, np.interp(time, time[good], series[good]))

    @property
    def reference(self) -> float:
        return float(np.mean(self.series))

    @property
    def size(self) -> float:
        """Standard deviation."""
        return float(np.std(self.series))

    @property
    def per_unit(self) -> str:
        """Unit of a relative slope."""
        return f"1/{self.unit}" if self.unit != "1" else "1"

    @property
    def step(self) -> float:
        """Time between samples, s."""
        return float(self.time[1] - self.time[0])

    def above(self, time: FloatArray, lag: float = 0.0) -> FloatArray:
        """The signal less its reference at times on the laws' clock.

        lag: time constant of a first-order lag of its effect, s, as of a coil or a valve; exact for a signal that is
        linear between samples and constant before the first.
        """
        series = self.series - self.reference
        if lag > 0.0:
            share = self.step / lag
            kept = np.exp(-share)
            mean = (1 - kept) / share
            numerator, denominator = [1 - mean, mean - kept], [1.0, -kept]
            at_rest = lfilter_zi(numerator, denominator) * series[0]
            series = lfilter_from(numerator, denominator, series, at_rest)
        return np.interp(time, self.time, series)


def following_law(quantity: str, signal: Covariate, elements: tuple[str, ...] = ()) -> ElementLaw:
    """The stiffness or the damping of an element as it follows a signal.

    elements: where it may; empty: anywhere.
    """

    def force(motion: Motion, p: Values, element: SpringDamper) -> FloatArray:
        (slope,) = p
        along = motion.deflection if quantity == "stiffness" else motion.rate
        found: FloatArray = getattr(element, quantity) * slope * signal.above(motion.time) * along
        return found

    def typical(seen: Observed) -> float:
        return 0.1 / signal.size

    return ElementLaw(
        name=f"{quantity}_by_{signal.name}",
        title=f"{quantity} that follows {signal.name}",
        parameters=(ParameterSpec("slope", signal.per_unit, -1e9, 1e9, f"relative change per {signal.unit}", typical),),
        force=force,
        shapes=lambda seen: grid([typical(seen)]),
        absent=(0.0,),
        looks_like=f"a residual in step with {signal.name}",
        confused_with=(),
        sentence=f"its {quantity} changes by {{slope}} of itself with {signal.name}, from its value at "
        f"{signal.reference:.4g} {signal.unit}",
        at=elements,
    )

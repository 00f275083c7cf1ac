"""Alarms of loads beyond what the system file allows."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from sprung.model.identification.measurements.deviations import Deviation
from sprung.model.tracking.rules import AlarmRules
from sprung.model.tracking.state import Alarm, TrackerState


@dataclass(frozen=True, slots=True)
class LoadLimit:
    """Limits of the load of a body."""

    empty: float  # kg
    least: float | None  # kg
    most: float | None  # kg

    def beyond(self, ratio: float) -> float:
        """kg above the most, or (negative) below the least, of a mass whose logarithm over the empty one is `ratio`."""
        carried = self.empty * float(np.expm1(ratio))
        if self.most is not None and carried > self.most:
            return carried - self.most
        return min(0.0, carried - self.least) if self.least is not None else 0.0


@dataclass(frozen=True, slots=True)
class LoadAlarms:
    """Of the bodies of one tracker that have limits."""

    deviations: tuple[Deviation, ...]
    limits: Mapping[str, LoadLimit]
    rules: AlarmRules

    def overloads(self, state: TrackerState, certain: float | None = None) -> dict[str, tuple[float, float]]:
        """Bodies whose load is beyond its limits: excess relative to the empty mass, and its standard deviation."""
        found = {}
        certain = self.rules.certain if certain is None else certain
        H = len(self.deviations)
        for h, deviation in enumerate(self.deviations):
            limit = self.limits.get(deviation.name) if deviation.kind == "load" else None
            if limit is None:
                continue
            value, std = float(state.belief.mean[-H:][h]), float(np.sqrt(state.belief.covariance.diagonal()[-H:][h]))
            excess = limit.beyond(value) / limit.empty
            if std < self.rules.load_known and abs(excess) > certain * std * np.exp(value):
                found[deviation.name] = (excess, std * float(np.exp(value)))
        return found

    def opened(self, alarms: list[Alarm], overloads: Mapping[str, tuple[float, float]], now: int) -> list[Alarm]:
        """Opens an alarm for each body whose load is beyond its limits."""
        opened = {alarm.parameter for alarm in alarms if alarm.kind == "load" and alarm.closed is None}
        new = {f"{body}.load": beyond for body, beyond in overloads.items() if f"{body}.load" not in opened}
        return alarms + [_overload(Alarm("load", name, now, now, "warning"), *beyond) for name, beyond in new.items()]

    def updated(self, alarm: Alarm, state: TrackerState, now: int) -> Alarm:
        """The alarm with its present values, or closed."""
        body = (alarm.parameter or "").removesuffix(".load")
        found = self.overloads(state, 0.0).get(body)
        return alarm.ended(now) if found is None else _overload(alarm, *found)


def _overload(alarm: Alarm, excess: float, std: float) -> Alarm:
    """An alarm with its excess as it is now."""
    peak = excess if abs(excess) > abs(alarm.peak or 0.0) else alarm.peak
    return replace(alarm, change=excess, std=std, peak=peak)

"""Alarms of wrong measurements: gains and delays that jump or drift away, and stuck, reversed or exchanged channels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from sprung.model.identification.measurements.deviations import Deviation, named
from sprung.model.signals import HARD_FAULTS, FaultKind, FloatArray, MeasurementFault
from sprung.model.tracking import deviations as dev
from sprung.model.tracking.deviation_model import DeviationModel
from sprung.model.tracking.jumps import Jump
from sprung.model.tracking.rules import AlarmRules
from sprung.model.tracking.state import Alarm, Stuck, TrackerState


@dataclass(frozen=True, slots=True)
class SensorAlarms:
    """Of the channels of one tracker."""

    deviations: tuple[Deviation, ...]
    model: DeviationModel
    rules: AlarmRules

    def with_jump(self, alarms: list[Alarm], jump: Jump | None, now: int) -> list[Alarm]:
        """Opens the alarm of a gain or a delay that has jumped by enough; None: none has."""
        if jump is None or jump.kind not in ("gain", "delay") or abs(jump.size) < self.model.jump_limit(jump.kind):
            return alarms
        name = self.name_of(jump.direction, jump.kind)
        if any(a.closed is None and a.kind == "sensor" and a.parameter == name for a in alarms):
            return alarms
        rivals = tuple(self.name_of(rival, self.model.kind_along(rival)) for rival in jump.rivals)
        alarm = Alarm("sensor", name, jump.since, now, "warning", jump.size, jump.std, jump.size, alternatives=rivals)
        return [*alarms, alarm]

    def drifted(self, state: TrackerState) -> list[MeasurementFault]:
        """Gains and delays that have left the reference of the baseline by more than electronics drift."""
        if not self.deviations:
            return []
        off, far = dev.drifted(state.calibration, self.model, state.belief)
        return list(named(self.deviations, off, np.zeros(len(off)), far)) if far.any() else []

    def with_drifted(
        self, alarms: list[Alarm], drifted: list[MeasurementFault], state: TrackerState, now: int
    ) -> list[Alarm]:
        """Opens alarms of gains and delays that drifted away, unless an open alarm contains them."""
        reported = {
            (channel, kind)
            for a in alarms
            if a.closed is None and a.kind == "sensor"
            for names, _, kind in [(a.parameter or "").rpartition(".")]
            for channel in names.split("|")
        }
        fresh = [f for f in drifted if not all((channel, f.kind) in reported for channel in f.channel.split("|"))]
        return alarms + [
            self.updated(Alarm("sensor", f"{f.channel}.{f.kind}", now, now, "warning"), state, now) for f in fresh
        ]

    def name_of(self, direction: FloatArray, kind: str) -> str:
        """Name of what a direction (H,) changes, "car_1l|car_1r.gain"."""
        channels = [d.name for d, part in zip(self.deviations, direction, strict=True) if part]
        return f"{'|'.join(channels)}.{kind}"

    def updated(self, alarm: Alarm, state: TrackerState, now: int) -> Alarm:
        """The alarm with its present values, or closed."""
        channel, _, kind = (alarm.parameter or "").rpartition(".")
        if kind in HARD_FAULTS:
            there = any(s.channel == channel and s.kind == kind for s in state.stuck)
            return alarm if there else alarm.ended(now)
        members = [h for h, d in enumerate(self.deviations) if d.kind == kind and d.name in channel.split("|")]
        if not members:
            return alarm.ended(now)
        H = len(self.deviations)
        away = state.belief.mean[-H:] - state.calibration.reference
        others = ~np.isin(np.arange(H), members)
        off = float(np.mean((away - self.model.common_value(away, others))[members]))
        own = self.model.relative_std(state.belief.covariance[-H:, -H:])[members]
        variance = dev.change_variance(state.calibration, self.model, state.belief)
        known = float(np.sqrt(np.mean(own**2)))
        spread = float(np.mean((variance + dev.pending_variance(state.calibration, self.model))[members]))
        linear = float(dev.linearisation_std(np.asarray(off))) if kind == "gain" else 0.0
        std = float(np.hypot(np.sqrt(spread), linear))
        recovered = self.rules.sensor_recovered * abs(alarm.peak or 0.0)
        if abs(off) + 2 * known < max(self.model.jump_limit(kind), recovered):
            return replace(alarm, change=off, std=std).ended(now)
        peak = off if abs(off) > abs(alarm.peak or 0.0) else alarm.peak
        return replace(alarm, change=off, std=std, peak=peak)

    def narrowed(self, alarms: list[Alarm], state: TrackerState, now: int) -> list[Alarm]:
        """Alarms of several channels that share a gain or a delay without those that turn out not to have it: each
        leaves an alarm when that would close if it were its own."""
        out = list(alarms)
        for i, alarm in enumerate(alarms):
            channels, _, kind = (alarm.parameter or "").rpartition(".")
            several = channels.split("|")
            if alarm.kind != "sensor" or alarm.closed is not None or kind in HARD_FAULTS or len(several) < 2:
                continue
            own = [self.updated(replace(alarm, parameter=f"{name}.{kind}"), state, now) for name in several]
            left = [name for name, one in zip(several, own, strict=True) if one.closed is None]
            if not 0 < len(left) < len(several):
                continue
            out[i] = alarm.ended(now)
            name = f"{'|'.join(left)}.{kind}"
            if not any(a.closed is None and a.kind == "sensor" and a.parameter == name for a in alarms):
                rivals = alarm.alternatives
                fresh = Alarm("sensor", name, alarm.onset, now, "warning", peak=alarm.peak, alternatives=rivals)
                out.append(self.updated(fresh, state, now))
        return out

    def with_stuck(self, alarms: list[Alarm], state: TrackerState, now: int) -> list[Alarm]:
        """Opens alarms of frozen, saturated, silent, noisy, reversed and exchanged channels."""
        opened = {a.parameter for a in alarms if a.closed is None and a.kind == "sensor"}
        return alarms + [
            Alarm("sensor", f"{s.channel}.{s.kind}", s.since, now, "warning", s.value)
            for s in state.stuck
            if s.count >= self.rules.hard and f"{s.channel}.{s.kind}" not in opened
        ]


def counted(
    stuck: Sequence[Stuck],
    found: Sequence[tuple[str, FaultKind, float]],
    time: int,
    most: int,
    unseen: tuple[str, ...] | None = None,
) -> tuple[Stuck, ...]:
    """Counts of frozen, saturated, silent, noisy, reversed and exchanged channels after a window that found some.

    unseen: parameters that the window did not identify; None: it could not be used.
    """
    old = {(s.channel, s.kind): s for s in stuck}
    now: dict[tuple[str, FaultKind], float] = {
        (channel, kind): value for channel, kind, value in found if kind in HARD_FAULTS
    }
    out = []
    for key in dict.fromkeys([*old, *now]):
        s = old.get(key) or Stuck(key[0], key[1], now[key], 0, time, unseen or ())
        count = min(s.count + 1, most) if key in now else s.count - 1
        if key in now and unseen is not None:
            s = replace(s, unseen=tuple(name for name in s.unseen if name in unseen))
        if count > 0:
            value = now.get(key, s.value)
            if s.kind == "noisy" and s.count:  # of one window it is not well known
                value = float(np.sqrt(s.value**2 + (value**2 - s.value**2) / most))
            out.append(replace(s, count=count, value=value))
    return tuple(out)

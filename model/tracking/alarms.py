"""Alarms of one vehicle: opened, followed, closed, and attributed to what the evidence speaks for.

A sequential test that has left the baseline says that something changed, not what.  Before an alarm accuses an element,

- a deviation of a measurement must have had its chance: some windows since the onset must have been weighed for it;
  what explains the change as well is named with the alarm, and when the windows point to it, it is the alarm;
- all elements of a kind that moved together are one message: oil that warms, rubber that stiffens in the cold.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from sprung.model.identification.deviations import Deviation
from sprung.model.signals import FaultKind, FloatArray, IntArray
from sprung.model.tracking import deviations as dev
from sprung.model.tracking.deviations import DeviationModel, Jump
from sprung.model.tracking.settings import TrackerSettings
from sprung.model.tracking.state import Alarm, Severity, Stuck, TrackerState

CERTAIN = 2.5  # standard deviations within which two explanations are equally good
LARGEST = {"gain": 0.3, "delay": 0.03, "load": 0.7}  # a deviation beyond this is none that a sensor has for long
PATIENCE = 20.0  # s that an alarm waits for windows weighed for deviations
ALIKE = 0.35  # of the common change: elements within this of it move together
MOST_OF = 0.75  # of the elements of a kind
FEWEST = 4  # elements that can be said to move together
WINDOWS = 6  # windows that a frozen or reversed channel needs to be told
HARD = ("frozen", "saturated", "inverted", "swapped")


@dataclass(frozen=True, slots=True)
class Drift:
    """Posterior over baseline of every parameter."""

    change: FloatArray  # value / baseline - 1, shape (P,)
    std: FloatArray


@dataclass(frozen=True, slots=True)
class Attribution:
    """Constants of one tracker that alarms need."""

    names: tuple[str, ...]
    settings: TrackerSettings
    deviations: tuple[Deviation, ...]
    model: DeviationModel

    @property
    def kinds(self) -> list[str]:
        """What kind of value each parameter is: "stiffness", "damping"."""
        return [name.rpartition(".")[2] for name in self.names]

    def after(self, state: TrackerState, drift: Drift, jump: Jump | None, now: int) -> tuple[Alarm, ...]:
        """Alarms after a window."""
        quiet = not state.active and state.misfit_since is None and not state.changes.active.any()
        if quiet and jump is None and not state.stuck:
            return state.alarms
        alarms = [self._kept_open(alarm, state, drift, now) for alarm in state.alarms]
        if jump is not None and jump.kind != "load" and abs(jump.size) >= dev.JUMPED[jump.kind]:
            alarms = self._with_sensor(alarms, state, jump, now)
        alarms = self._with_stuck(alarms, state, now)
        alarms = self._with_changes(alarms, state, drift, now)
        if state.misfit_since is not None and not any(a.kind == "misfit" and a.closed is None for a in alarms):
            alarms.append(Alarm("misfit", None, state.misfit_since, now, "warning"))
        return self._latest(alarms)

    def _kept_open(self, alarm: Alarm, state: TrackerState, drift: Drift, now: int) -> Alarm:
        """The alarm as it is now: followed, or closed."""
        if alarm.closed is not None:
            return alarm
        if alarm.kind == "misfit":
            return alarm if state.misfit_since is not None else _closed(alarm, now)
        if alarm.kind == "sensor":
            return self._sensor_followed(alarm, state, now)
        name = alarm.parameter or ""
        if name.startswith("*."):
            members = self._of_kind(name[2:])
            if not state.changes.active[members].any():
                return _closed(alarm, now)
            return self._followed(alarm, *_common(drift, members))
        i = self.names.index(name)
        if state.changes.active[i] == 0:
            return _closed(alarm, now)
        return self._followed(alarm, float(drift.change[i]), float(drift.std[i]))

    def _with_changes(self, alarms: list[Alarm], state: TrackerState, drift: Drift, now: int) -> list[Alarm]:
        """Opens alarms of parameters whose test has left the baseline."""
        alarmed = {alarm.parameter for alarm in alarms if alarm.closed is None and alarm.kind == "change"}
        out = list(alarms)
        for i in np.flatnonzero(state.changes.active).tolist():
            together = f"*.{self.kinds[i]}"
            members = self._of_kind(self.kinds[i])
            if self.names[i] in alarmed or (together in alarmed and self._moves_along(i, drift, members)):
                continue
            since = state.changes.up_since if state.changes.active[i] > 0 else state.changes.down_since
            others = self._alternatives(int(i), state, drift, int(since[i]), now)
            if others is None:
                continue
            name, change, std = self.names[i], float(drift.change[i]), float(drift.std[i])
            if together not in alarmed and self._all_move(drift, members):
                name, (change, std), others = together, _common(drift, members), ()
            alarm = Alarm("change", name, int(since[i]), now, "warning", 0.0, 0.0, 0.0, alternatives=others)
            alarmed.add(name)
            out.append(self._followed(alarm, change, std))
        return out

    def _of_kind(self, kind: str) -> IntArray:
        return np.flatnonzero([k == kind for k in self.kinds])

    def _all_move(self, drift: Drift, members: IntArray) -> bool:
        """Whether all elements of a kind have changed alike."""
        known = members[np.isfinite(drift.change[members])]
        if len(known) < FEWEST:
            return False
        middle, std = _common(drift, known)
        with_it = np.array([self._moves_along(i, drift, known) for i in known])
        return bool(with_it.mean() >= MOST_OF and abs(middle) > max(self.settings.change / 4, 4 * std))

    def _moves_along(self, i: int, drift: Drift, members: IntArray) -> bool:
        middle, std = _common(drift, members)
        apart = abs(drift.change[i] - middle)
        return bool(apart < max(ALIKE * abs(middle), 3 * float(np.hypot(drift.std[i], std))))

    def _alternatives(self, i: int, state: TrackerState, drift: Drift, since: int, now: int) -> tuple[str, ...] | None:
        """Deviations that would explain the change of parameter `i` as well; None: too early to say.

        The parameters are profiled out of the evidence on deviations: what it says of one does not depend on springs.
        """
        if not self.deviations:
            return ()
        calibration = state.calibration
        if calibration.recent[-1] == 0:  # estimates that never speak of deviations
            return ()
        if calibration.recent[0] < since and (now - since) * 1e-9 < PATIENCE:
            return None
        moved = np.log1p(drift.change[i])
        found = []
        for h, deviation in enumerate(self.deviations):
            slope = calibration.cross[i, h]
            if deviation.kind == "load" or calibration.curvature[h] <= 0 or slope == 0:
                continue
            needed = moved / -slope  # a reading that is too large by this moves the estimate so
            std = calibration.curvature[h] ** -0.5
            seen = calibration.slope[h] / calibration.curvature[h]
            if (
                abs(needed) <= LARGEST[deviation.kind]
                and abs(needed) < CERTAIN * std
                and abs(seen - needed) < CERTAIN * std
            ):
                found.append((abs(needed) / deviation.std, f"{deviation.name}.{deviation.kind}"))
        return tuple(name for _, name in sorted(found)[:3])

    def _with_sensor(self, alarms: list[Alarm], state: TrackerState, jump: Jump, now: int) -> list[Alarm]:
        """Opens the alarm of a gain or a delay that has jumped."""
        name = self.sensor_name(jump.direction, jump.kind)
        if any(a.closed is None and a.kind == "sensor" and a.parameter == name for a in alarms):
            return alarms
        alarm = Alarm("sensor", name, jump.since, now, "warning", jump.size, None, jump.size)
        return [*alarms, alarm]

    def sensor_name(self, direction: FloatArray, kind: str) -> str:
        channels = [d.name for d, part in zip(self.deviations, direction, strict=True) if part]
        return f"{'|'.join(channels)}.{kind}"

    def _sensor_followed(self, alarm: Alarm, state: TrackerState, now: int) -> Alarm:
        channel, _, kind = (alarm.parameter or "").rpartition(".")
        if kind in HARD:
            there = any(s.channel == channel and s.kind == kind for s in state.stuck)
            return alarm if there else _closed(alarm, now)
        members = [h for h, d in enumerate(self.deviations) if d.kind == kind and d.name in channel.split("|")]
        if not members:
            return _closed(alarm, now)
        H = len(self.deviations)
        off = float(np.mean((state.belief.mean[-H:] - state.calibration.reference)[members]))
        std = float(np.sqrt(np.diag(state.belief.covariance)[-H:][members].mean()))
        if abs(off) + 2 * std < dev.JUMPED[kind]:
            return _closed(replace(alarm, change=off, std=std), now)
        peak = off if abs(off) > abs(alarm.peak or 0.0) else alarm.peak
        return replace(alarm, change=off, std=std, peak=peak)

    def _with_stuck(self, alarms: list[Alarm], state: TrackerState, now: int) -> list[Alarm]:
        opened = {a.parameter for a in alarms if a.closed is None and a.kind == "sensor"}
        return alarms + [
            Alarm("sensor", f"{s.channel}.{s.kind}", s.since, now, "warning", s.value)
            for s in state.stuck
            if s.count >= WINDOWS and f"{s.channel}.{s.kind}" not in opened
        ]

    def _followed(self, alarm: Alarm, change: float, std: float) -> Alarm:
        """An active alarm with its change as it is now; severity falls only with hysteresis."""
        limit = self.settings.alarm_change
        if alarm.severity == "alarm":
            limit *= self.settings.hysteresis
        severity: Severity = "alarm" if abs(change) >= limit else "warning"
        peak = change if abs(change) >= abs(alarm.peak or 0.0) else alarm.peak
        return replace(alarm, change=change, std=std, severity=severity, peak=peak)

    def _latest(self, alarms: list[Alarm]) -> tuple[Alarm, ...]:
        """All active alarms and the latest closed ones."""
        closed = [alarm for alarm in alarms if alarm.closed is not None]
        surplus = {alarm.key for alarm in closed[: max(0, len(closed) - self.settings.kept_alarms)]}
        return tuple(alarm for alarm in alarms if alarm.closed is None or alarm.key not in surplus)


def _closed(alarm: Alarm, now: int) -> Alarm:
    """Closed now, or when it was opened if a clock that was wrong then says that this is later."""
    return replace(alarm, closed=max(now, alarm.opened))


def _common(drift: Drift, members: IntArray) -> tuple[float, float]:
    """Median change of some parameters, and its standard deviation."""
    change, std = drift.change[members], drift.std[members]
    return float(np.nanmedian(change)), float(1.25 * np.sqrt(np.nanmean(std**2) / len(members)))


def counted(stuck: Sequence[Stuck], said: Sequence[tuple[str, FaultKind, float]], time: int) -> tuple[Stuck, ...]:
    """Counts of frozen, saturated, reversed and exchanged channels after a window that said so of some."""
    old = {(s.channel, s.kind): s for s in stuck}
    now: dict[tuple[str, FaultKind], float] = {(channel, kind): value for channel, kind, value in said if kind in HARD}
    out = []
    for key in dict.fromkeys([*old, *now]):
        s = old.get(key) or Stuck(key[0], key[1], now[key], 0, time)
        count = min(s.count + 1, 2 * WINDOWS) if key in now else s.count - 1
        if count > 0:
            out.append(replace(s, count=count, value=now.get(key, s.value)))
    return tuple(out)

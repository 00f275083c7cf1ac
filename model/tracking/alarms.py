"""Alarms of one vehicle: opening, update, closing, and fault isolation.

A sequential test detects that something has changed, not what.  Before an alarm names an element,

- sensor faults must be excluded: some windows since the onset must have contained information on deviations of the
  measurements, and while the evidence for one rises, further windows are awaited; deviations that explain the change
  equally well are listed with the alarm, and if a jump of one is found, that is the alarm;
- elements of a kind that changed together give one alarm: oil that warms up, rubber that stiffens in the cold;
- where all springs and dampers at a body changed alike, its mass is listed as an alternative: it scales their forces.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from itertools import takewhile

import numpy as np

from sprung.model.identification.measurements.deviations import Deviation
from sprung.model.signals import IntArray
from sprung.model.tracking import weather as weathers
from sprung.model.tracking.deviation_model import DeviationModel
from sprung.model.tracking.drift import Drift, common_change, is_between
from sprung.model.tracking.jumps import Jump
from sprung.model.tracking.load_alarms import LoadAlarms, LoadLimit
from sprung.model.tracking.rules import AlarmRules
from sprung.model.tracking.sensor_alarms import SensorAlarms
from sprung.model.tracking.settings import TrackerSettings
from sprung.model.tracking.state import Alarm, Severity, TrackerState
from sprung.model.tracking.weather import WeatherModel

_TOGETHER = 0.25  # share of a common change that every kind of a quantity has at least, to be reported as one of all


@dataclass(frozen=True, slots=True)
class VehicleAlarms:
    """Opens, updates and closes the alarms of one vehicle, with the constants of its tracker."""

    names: tuple[str, ...]
    settings: TrackerSettings
    deviations: tuple[Deviation, ...]
    model: DeviationModel
    weather: WeatherModel
    limits: dict[str, LoadLimit]
    masses: Mapping[str, tuple[str, ...]]  # bodies whose mass is not identifiable, and the elements at them

    @property
    def _rules(self) -> AlarmRules:
        return self.settings.rules.alarms

    @property
    def _sensor_alarms(self) -> SensorAlarms:
        return SensorAlarms(self.deviations, self.model, self._rules)

    @property
    def _load_alarms(self) -> LoadAlarms:
        return LoadAlarms(self.deviations, self.limits, self._rules)

    @property
    def kinds(self) -> list[str]:
        """Quantity of each parameter: "stiffness", "damping"."""
        return [name.rpartition(".")[2] for name in self.names]

    def updated(self, state: TrackerState, drift: Drift, jump: Jump | None, now: int) -> tuple[Alarm, ...]:
        """Alarms after a window whose centre is at `now`, ns."""
        sensors, loads = self._sensor_alarms, self._load_alarms
        common, overloads, drifted = self._common_changes(state), loads.overloads(state), sensors.drifted(state)
        if jump is None and not (common or overloads or drifted) and _nothing_is_wrong(state):
            return state.alarms
        alarms = [self._present(alarm, state, drift, now) for alarm in state.alarms]
        alarms = sensors.with_jump(alarms, jump, now)
        alarms = sensors.narrowed(alarms, state, now)
        alarms = sensors.with_drifted(alarms, drifted, state, now)
        alarms = sensors.with_stuck(alarms, state, now)
        alarms = self._with_common(alarms, common, drift, now)
        alarms = self._with_changes(alarms, state, drift, now)
        alarms = loads.opened(alarms, overloads, now)
        alarms = _with_misfit(alarms, state, now)
        return self._latest(alarms)

    def _present(self, alarm: Alarm, state: TrackerState, drift: Drift, now: int) -> Alarm:
        """The alarm with its present values, or closed."""
        if alarm.closed is not None:
            return alarm
        if alarm.kind == "misfit":
            return alarm if state.misfit_since is not None else alarm.ended(now)
        if alarm.kind == "sensor":
            return self._sensor_alarms.updated(alarm, state, now)
        if alarm.kind == "load":
            return self._load_alarms.updated(alarm, state, now)
        name = alarm.parameter or ""
        if "*" in name:
            return self._kind_updated(alarm, name, state, drift, now)
        return self._single_updated(alarm, self.names.index(name), state, drift, now)

    def _kind_updated(self, alarm: Alarm, name: str, state: TrackerState, drift: Drift, now: int) -> Alarm:
        """The alarm of elements that changed together, `primary_*.damping`."""
        members = np.flatnonzero([fnmatchcase(n, name) for n in self.names])
        if np.isnan(drift.whole[members]).all():  # all baselines are learned anew: there is nothing to compare with
            return alarm.ended(now)
        still = any(fnmatchcase(pattern, name) for pattern, *_ in self._common_changes(state, self._rules.recovered))
        change, std = common_change(replace(drift, change=drift.whole), members)
        moved = state.changes.active[members].any() and abs(change) > self._rules.recovered * self._common_limit
        if not (still or moved):  # a change of one element alone does not keep the alarm of all open
            return alarm.ended(now)
        return self._updated(alarm, change, std)

    def _single_updated(self, alarm: Alarm, i: int, state: TrackerState, drift: Drift, now: int) -> Alarm:
        """The alarm of parameter `i`."""
        if state.changes.active[i] == 0:
            return alarm.ended(now)
        return self._updated(alarm, float(drift.change[i]), float(drift.std[i]))

    def _common_changes(self, state: TrackerState, share: float = 1.0) -> list[tuple[str, float, float]]:
        """Kinds that changed more than weather can explain: name, change and its standard deviation.

        share: of the limits that open an alarm.  Kinds of one quantity that changed alike are reported as one.
        """
        weather, model = state.weather, self.weather
        if weather is None or not model.groups:
            return []
        odd = weathers.beyond_weather(weather, model, share)
        if not odd.any():
            return []
        out, names = [], set()
        for g in np.flatnonzero(odd).tolist():
            quantity = self.kinds[int(np.flatnonzero(model.group == g)[0])]
            alike = [o for o in range(model.groups) if self.kinds[int(np.flatnonzero(model.group == o)[0])] == quantity]
            everything = all(weather.common[o] * weather.common[g] > _TOGETHER * weather.common[g] ** 2 for o in alike)
            name = f"*.{quantity}" if everything else self._kind_name(g)
            if name not in names:
                names.add(name)
                change = float(np.expm1(np.mean(weather.common[alike if everything else [g]])))
                out.append((name, change, float(np.sqrt(weather.variance[g]))))
        return out

    def _kind_name(self, group: int) -> str:
        """Pattern of the names of a kind, `primary_*.damping`."""
        members = [self.names[i] for i in np.flatnonzero(self.weather.group == group)]
        quantity = members[0].rpartition(".")[2]
        letters = zip(*(m.rpartition(".")[0] for m in members), strict=False)
        prefix = "".join(c[0] for c in takewhile(lambda column: len(set(column)) == 1, letters))
        return f"{prefix.rstrip('0123456789')}*.{quantity}"

    def _with_common(
        self, alarms: list[Alarm], common: list[tuple[str, float, float]], drift: Drift, now: int
    ) -> list[Alarm]:
        """Opens one alarm for each kind whose elements changed together."""
        opened = [a.parameter or "" for a in alarms if a.closed is None and a.kind == "change"]
        whole = replace(drift, change=drift.whole)
        out = list(alarms)
        for name, change, std in common:
            if any(fnmatchcase(name, other) for other in opened):
                continue
            members = np.flatnonzero([fnmatchcase(n, name) for n in self.names])
            heavier = self._masses_of(members.tolist(), whole)
            alarm = Alarm("change", name, now, now, "warning", 0.0, 0.0, 0.0, alternatives=heavier)
            out.append(self._updated(alarm, change, std))
        return out

    def _with_changes(self, alarms: list[Alarm], state: TrackerState, drift: Drift, now: int) -> list[Alarm]:
        """Opens alarms of parameters whose change test has fired."""
        alarmed = {alarm.parameter for alarm in alarms if alarm.closed is None and alarm.kind == "change"}
        out = list(alarms)
        for i in np.flatnonzero(state.changes.active).tolist():
            opened = None if self.names[i] in alarmed else self._opened(i, alarmed, state, drift, now)
            if opened is not None:
                alarmed.add(opened.parameter)
                out.append(opened)
        return out

    def _opened(
        self, i: int, alarmed: Collection[str | None], state: TrackerState, drift: Drift, now: int
    ) -> Alarm | None:
        """A new alarm for the change of parameter `i`, or of all of its quantity; None where none is due (yet).

        alarmed: names of parameters and kinds whose alarms are open.
        """
        whole, members = replace(drift, change=drift.whole), self._of_kind(self.kinds[i])
        along = self._changed_with(i, whole, members)
        in_a_kind = any(name and "*" in name and fnmatchcase(self.names[i], name) for name in alarmed)
        if in_a_kind and (along or is_between(float(whole.change[i]), common_change(whole, members)[0])):
            return None
        since = int((state.changes.up_since if state.changes.active[i] > 0 else state.changes.down_since)[i])
        deviations = self._alternatives(i, state, drift, since, now)
        if deviations is None:
            return None
        if not in_a_kind and along and self._all_changed(whole, members):
            name, (change, std) = f"*.{self.kinds[i]}", common_change(whole, members)
            others = self._masses_of(members.tolist(), whole)
        else:
            name, change, std = self.names[i], float(drift.change[i]), float(drift.std[i])
            if abs(change) < self._rules.certain * std:  # by now a gain, a delay or a load explains what the test saw
                return None
            others = (*deviations, *self._masses_of([i], whole))
        alarm = Alarm("change", name, since, now, "warning", 0.0, 0.0, 0.0, alternatives=others)
        return self._updated(alarm, change, std)

    def _of_kind(self, kind: str) -> IntArray:
        return np.flatnonzero([k == kind for k in self.kinds])

    def _all_changed(self, drift: Drift, members: IntArray) -> bool:
        """Whether most of `members` have changed alike, and significantly."""
        known = members[np.isfinite(drift.change[members])]
        if len(known) < self._rules.fewest:
            return False
        middle, std = common_change(drift, known)
        with_it = np.array([self._changed_with(i, drift, known) for i in known])
        return bool(with_it.mean() >= self._rules.most_of and abs(middle) > max(self._common_limit, 4 * std))

    @property
    def _common_limit(self) -> float:
        """Common change that opens an alarm of a kind; a median is more precise than one element."""
        return self.settings.change * self._rules.common

    def _masses_of(self, changed: Sequence[int], drift: Drift) -> tuple[str, ...]:
        """Masses that explain the changes of `changed`, too: all springs and dampers at the body changed alike."""
        found = []
        for body, elements in self.masses.items():
            at = np.flatnonzero([n.rpartition(".")[0] in elements for n in self.names])
            if np.isin(changed, at).any() and len({self.kinds[k] for k in at}) > 1 and self._all_changed(drift, at):
                found.append(f"{body}.mass")
        return tuple(found)

    def _changed_with(self, i: int, drift: Drift, members: IntArray) -> bool:
        middle, std = common_change(drift, members)
        distance = abs(drift.change[i] - middle)
        return bool(distance < max(self._rules.alike * abs(middle), 3 * float(np.hypot(drift.std[i], std))))

    def _alternatives(self, i: int, state: TrackerState, drift: Drift, since: int, now: int) -> tuple[str, ...] | None:
        """Deviations that explain the change of parameter `i` equally well; None: not decided yet.

        The parameters are profiled out of the evidence on deviations: it does not depend on changes of springs.
        """
        if not self.deviations:
            return ()
        calibration = state.calibration
        if calibration.recent[-1] == 0:  # estimates without information on deviations
            return ()
        undecided = calibration.recent[0] < since or calibration.ratio.max(initial=0.0) >= self.model.rules.suspected
        if undecided and (now - since) * 1e-9 < self._rules.patience:
            return None
        moved = np.log1p(drift.change[i])
        largest = {"gain": self._rules.largest_gain, "delay": self._rules.largest_delay}
        found = []
        for h, deviation in enumerate(self.deviations):
            slope = calibration.cross[i, h]
            if deviation.kind not in largest or calibration.curvature[h] <= 0 or slope == 0:
                continue
            needed = moved / -slope  # deviation that shifts the estimate by this much
            std = calibration.curvature[h] ** -0.5
            seen = calibration.slope[h] / calibration.curvature[h]
            if (
                abs(needed) <= largest[deviation.kind]
                and abs(needed) < self._rules.certain * std
                and abs(seen - needed) < self._rules.certain * std
            ):
                found.append((abs(needed) / deviation.std, f"{deviation.name}.{deviation.kind}"))
        return tuple(name for _, name in sorted(found)[:3])

    def _updated(self, alarm: Alarm, change: float, std: float) -> Alarm:
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


def _nothing_is_wrong(state: TrackerState) -> bool:
    """Whether no alarm is open and no test of a single parameter, channel or window has fired."""
    return not (state.active or state.changes.active.any() or state.stuck or state.misfit_since is not None)


def _with_misfit(alarms: list[Alarm], state: TrackerState, now: int) -> list[Alarm]:
    """Opens the alarm of windows that the model does not explain."""
    if state.misfit_since is None or any(a.kind == "misfit" and a.closed is None for a in alarms):
        return alarms
    return [*alarms, Alarm("misfit", None, state.misfit_since, now, "warning")]

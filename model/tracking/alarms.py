"""Alarms of one vehicle: opened, followed, closed, and attributed to what the evidence speaks for.

A sequential test that has left the baseline says that something changed, not what.  Before an alarm accuses an element,

- a deviation of a measurement must have had its chance: some windows since the onset must have been weighed for it, and
  while their evidence for one rises, the next are waited for; what explains the change as well is named with the alarm,
  and when the windows point to it, it is the alarm;
- all elements of a kind that moved together are one message: oil that warms, rubber that stiffens in the cold;
- where all springs and dampers at a body moved alike, its mass is named with them: it is the scale of their forces.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from itertools import takewhile

import numpy as np

from sprung.model.identification.deviations import Deviation, named
from sprung.model.signals import FaultKind, FloatArray, IntArray, MeasurementFault
from sprung.model.tracking import deviations as dev
from sprung.model.tracking import weather as weathers
from sprung.model.tracking.deviations import DeviationModel, Jump
from sprung.model.tracking.settings import TrackerSettings
from sprung.model.tracking.state import Alarm, Severity, Stuck, TrackerState
from sprung.model.tracking.weather import WeatherModel

CERTAIN = 2.5  # standard deviations within which two explanations are equally good
LARGEST = {"gain": 0.3, "delay": 0.03}  # a deviation beyond this is none that a sensor has for long
PATIENCE = 20.0  # s that an alarm waits for windows weighed for deviations
ALIKE = 0.35  # of the common change: elements within this of it move together
MOST_OF = 0.75  # of the elements of a kind
FEWEST = 4  # elements that can be said to move together
RECOVERED = 0.6  # of the change that opens an alarm of a kind: below it is over
MENDED = 0.2  # of a sensor's largest deviation: surely below it is over
LOAD_KNOWN = 0.02  # standard deviation of a load that can be said to be beyond a limit
WINDOWS = 6  # windows that a frozen or reversed channel needs to be told
HARD = ("frozen", "saturated", "inverted", "swapped")


@dataclass(frozen=True, slots=True)
class Drift:
    """Posterior over baseline of every parameter."""

    change: FloatArray  # value / baseline - 1, apart from what all of a kind have in common, shape (P,)
    std: FloatArray
    whole: FloatArray  # with it, but for the slow part that is weather


@dataclass(frozen=True, slots=True)
class LoadLimit:
    """What a body may carry, kg beside its empty mass."""

    empty: float  # kg
    least: float | None
    most: float | None

    def beyond(self, ratio: float) -> float:
        """kg above the most, or (negative) below the least, of a mass whose logarithm over the empty one is `ratio`."""
        carried = self.empty * float(np.expm1(ratio))
        if self.most is not None and carried > self.most:
            return carried - self.most
        return min(0.0, carried - self.least) if self.least is not None else 0.0


@dataclass(frozen=True, slots=True)
class Attribution:
    """Constants of one tracker that alarms need."""

    names: tuple[str, ...]
    settings: TrackerSettings
    deviations: tuple[Deviation, ...]
    model: DeviationModel
    weather: WeatherModel
    limits: dict[str, LoadLimit]
    masses: Mapping[str, tuple[str, ...]]  # of bodies whose mass no window tells: the elements at them

    @property
    def kinds(self) -> list[str]:
        """What kind of value each parameter is: "stiffness", "damping"."""
        return [name.rpartition(".")[2] for name in self.names]

    def after(self, state: TrackerState, drift: Drift, jump: Jump | None, now: int) -> tuple[Alarm, ...]:
        """Alarms after a window."""
        common = self._common_changes(state)
        overloaded = self._overloads(state)
        quiet = not (state.active or state.changes.active.any() or common or overloaded)
        quiet = quiet and state.misfit_since is None
        crept = self._crept(state)
        if quiet and jump is None and not state.stuck and not crept:
            return state.alarms
        alarms = [self._kept_open(alarm, state, drift, now) for alarm in state.alarms]
        if jump is not None and jump.kind in ("gain", "delay") and abs(jump.size) >= dev.JUMPED[jump.kind]:
            alarms = self._with_sensor(alarms, jump, now)
        alarms = self._with_crept(alarms, crept, state, now)
        alarms = self._with_stuck(alarms, state, now)
        alarms = self._with_common(alarms, common, drift, now)
        alarms = self._with_changes(alarms, state, drift, now)
        alarms += [
            self._overload(Alarm("load", f"{body}.load", now, now, "warning"), excess, std)
            for body, (excess, std) in overloaded.items()
            if not any(a.kind == "load" and a.closed is None and a.parameter == f"{body}.load" for a in alarms)
        ]
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
        if alarm.kind == "load":
            return self._load_followed(alarm, state, now)
        name = alarm.parameter or ""
        if "*" in name:
            members = np.flatnonzero([fnmatchcase(n, name) for n in self.names])
            still = any(fnmatchcase(pattern, name) for pattern, *_ in self._common_changes(state, RECOVERED))
            if np.isnan(drift.whole[members]).all():  # all baselines begin anew: nothing is left to compare with
                return _closed(alarm, now)
            change, std = _common(replace(drift, change=drift.whole), members)
            moved = state.changes.active[members].any() and abs(change) > RECOVERED * self._least_together
            if not (still or moved):  # one that has changed by itself does not keep the alarm of all open
                return _closed(alarm, now)
            return self._followed(alarm, change, std)
        i = self.names.index(name)
        if state.changes.active[i] == 0:
            return _closed(alarm, now)
        return self._followed(alarm, float(drift.change[i]), float(drift.std[i]))

    def _common_changes(self, state: TrackerState, share: float = 1.0) -> list[tuple[str, float, float]]:
        """Kinds that moved as no weather does: name, change and its standard deviation.

        share: of what opens an alarm.  Kinds of one quantity that move alike are one.
        """
        weather, model = state.weather, self.weather
        if weather is None or not model.groups:
            return []
        odd = weathers.unusual(weather, model, share)
        if not odd.any():
            return []
        out, told = [], set()
        for g in np.flatnonzero(odd).tolist():
            quantity = self.kinds[int(np.flatnonzero(model.group == g)[0])]
            alike = [o for o in range(model.groups) if self.kinds[int(np.flatnonzero(model.group == o)[0])] == quantity]
            everything = all(weather.common[o] * weather.common[g] > 0.25 * weather.common[g] ** 2 for o in alike)
            name = f"*.{quantity}" if everything else self._kind_name(g)
            if name not in told:
                told.add(name)
                change = float(np.expm1(np.mean(weather.common[alike if everything else [g]])))
                out.append((name, change, float(np.sqrt(weather.variance[g]))))
        return out

    def _kind_name(self, group: int) -> str:
        """`primary_*.damping`: what the names of a kind have in common."""
        members = [self.names[i] for i in np.flatnonzero(self.weather.group == group)]
        quantity = members[0].rpartition(".")[2]
        letters = zip(*(m.rpartition(".")[0] for m in members), strict=False)
        prefix = "".join(c[0] for c in takewhile(lambda column: len(set(column)) == 1, letters))
        return f"{prefix.rstrip('0123456789')}*.{quantity}"

    def _with_common(
        self, alarms: list[Alarm], common: list[tuple[str, float, float]], drift: Drift, now: int
    ) -> list[Alarm]:
        """Opens one alarm for a kind that moved together."""
        opened = [a.parameter or "" for a in alarms if a.closed is None and a.kind == "change"]
        whole = replace(drift, change=drift.whole)
        out = list(alarms)
        for name, change, std in common:
            if any(fnmatchcase(name, other) for other in opened):
                continue
            members = np.flatnonzero([fnmatchcase(n, name) for n in self.names])
            heavier = self._masses_of(members.tolist(), whole)
            alarm = Alarm("change", name, now, now, "warning", 0.0, 0.0, 0.0, alternatives=heavier)
            out.append(self._followed(alarm, change, std))
        return out

    def _overloads(self, state: TrackerState, certain: float = CERTAIN) -> dict[str, tuple[float, float]]:
        """Bodies that carry more, or less, than they may: by how much of the empty mass, and its standard deviation."""
        found = {}
        H = len(self.deviations)
        for h, deviation in enumerate(self.deviations):
            limit = self.limits.get(deviation.name) if deviation.kind == "load" else None
            if limit is None:
                continue
            value, std = float(state.belief.mean[-H:][h]), float(np.sqrt(state.belief.covariance.diagonal()[-H:][h]))
            excess = limit.beyond(value) / limit.empty
            if std < LOAD_KNOWN and abs(excess) > certain * std * np.exp(value):
                found[deviation.name] = (excess, std * float(np.exp(value)))
        return found

    def _load_followed(self, alarm: Alarm, state: TrackerState, now: int) -> Alarm:
        body = (alarm.parameter or "").removesuffix(".load")
        found = self._overloads(state, 0.0).get(body)
        return _closed(alarm, now) if found is None else self._overload(alarm, *found)

    def _overload(self, alarm: Alarm, excess: float, std: float) -> Alarm:
        peak = excess if abs(excess) > abs(alarm.peak or 0.0) else alarm.peak
        return replace(alarm, change=excess, std=std, peak=peak)

    def _with_changes(self, alarms: list[Alarm], state: TrackerState, drift: Drift, now: int) -> list[Alarm]:
        """Opens alarms of parameters whose test has left the baseline."""
        alarmed = {alarm.parameter for alarm in alarms if alarm.closed is None and alarm.kind == "change"}
        out = list(alarms)
        for i in np.flatnonzero(state.changes.active).tolist():
            together = f"*.{self.kinds[i]}"
            members = self._of_kind(self.kinds[i])
            kinds = [name for name in alarmed if name and "*" in name and fnmatchcase(self.names[i], name)]
            whole = replace(drift, change=drift.whole)
            along = self._moves_along(int(i), whole, members)
            if self.names[i] in alarmed or (kinds and along):
                continue
            since = state.changes.up_since if state.changes.active[i] > 0 else state.changes.down_since
            others = self._alternatives(int(i), state, drift, int(since[i]), now)
            if others is None:
                continue
            others = (*others, *self._masses_of([int(i)], whole))
            name, change, std = self.names[i], float(drift.change[i]), float(drift.std[i])
            if not kinds and along and self._all_move(whole, members):
                name, (change, std), others = (
                    together,
                    _common(whole, members),
                    self._masses_of(members.tolist(), whole),
                )
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
        return bool(with_it.mean() >= MOST_OF and abs(middle) > max(self._least_together, 4 * std))

    @property
    def _least_together(self) -> float:
        """Change that all elements of a kind must show for an alarm of theirs: a middle is surer than one element."""
        return self.settings.change / 4

    def _masses_of(self, changed: Sequence[int], drift: Drift) -> tuple[str, ...]:
        """Masses that would explain what `changed` as well: of bodies at which all springs and dampers did alike."""
        found = []
        for body, elements in self.masses.items():
            at = np.flatnonzero([n.rpartition(".")[0] in elements for n in self.names])
            if np.isin(changed, at).any() and len({self.kinds[k] for k in at}) > 1 and self._all_move(drift, at):
                found.append(f"{body}.mass")
        return tuple(found)

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
        undecided = calibration.recent[0] < since or calibration.ratio.max(initial=0.0) >= dev.POINTING
        if undecided and (now - since) * 1e-9 < PATIENCE:
            return None
        moved = np.log1p(drift.change[i])
        found = []
        for h, deviation in enumerate(self.deviations):
            slope = calibration.cross[i, h]
            if deviation.kind not in LARGEST or calibration.curvature[h] <= 0 or slope == 0:
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

    def _with_sensor(self, alarms: list[Alarm], jump: Jump, now: int) -> list[Alarm]:
        """Opens the alarm of a gain or a delay that has jumped."""
        name = self.sensor_name(jump.direction, jump.kind)
        if any(a.closed is None and a.kind == "sensor" and a.parameter == name for a in alarms):
            return alarms
        alarm = Alarm("sensor", name, jump.since, now, "warning", jump.size, None, jump.size)
        return [*alarms, alarm]

    def _crept(self, state: TrackerState) -> list[MeasurementFault]:
        """Gains and delays that are no longer those of the baseline by more than electronics do."""
        if not self.deviations:
            return []
        off, far = dev.crept(state.calibration, self.model, state.belief)
        return list(named(self.deviations, off, np.zeros(len(off)), far)) if far.any() else []

    def _with_crept(
        self, alarms: list[Alarm], crept: list[MeasurementFault], state: TrackerState, now: int
    ) -> list[Alarm]:
        """Opens alarms of gains and delays that crept away, those apart that jumped, or are told with others."""
        told = {
            (channel, kind)
            for a in alarms
            if a.closed is None and a.kind == "sensor"
            for names, _, kind in [(a.parameter or "").rpartition(".")]
            for channel in names.split("|")
        }
        fresh = [f for f in crept if not all((channel, f.kind) in told for channel in f.channel.split("|"))]
        return alarms + [
            self._sensor_followed(Alarm("sensor", f"{f.channel}.{f.kind}", now, now, "warning"), state, now)
            for f in fresh
        ]

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
        apart = state.belief.mean[-H:] - state.calibration.reference
        others = ~np.isin(np.arange(H), members)
        off = float(np.mean((apart - self.model.common(apart, others))[members]))
        own = self.model.relative_std(state.belief.covariance[-H:, -H:])[members]
        # That of the baseline is known as well as this one, or wrong by what is no straying yet.
        strays = dev.STRAYED / 3 * self.model.crept[members]
        of_baseline = np.where(state.calibration.moved[members] > 0, own, strays)
        known = float(np.sqrt(np.mean(own**2)))
        spread = float(np.mean(own**2 + of_baseline**2 + dev.pending(state.calibration, self.model)[members]))
        bent = float(dev.bending(np.asarray(off))) if kind == "gain" else 0.0
        std = float(np.hypot(np.sqrt(spread), bent))
        if abs(off) + 2 * known < max(dev.JUMPED[kind], MENDED * abs(alarm.peak or 0.0)):
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

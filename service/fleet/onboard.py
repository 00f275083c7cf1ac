"""On board: windows -> estimates -> the vehicle's own tracker -> messages, and raw samples around alarms.

The tracker here decides what raw data is worth sending; the server folds the same estimates into its own.
"""

from __future__ import annotations

import logging
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from sprung.model.signals import Estimate, Window
from sprung.model.tracking.tracker import TrackerState
from sprung.replay.writing import write_recording
from sprung.service.fleet.message import Message, WindowEstimate, encode
from sprung.service.fleet.spool import Spool
from sprung.service.monitoring.compute import Priority
from sprung.service.monitoring.engine import Engine
from sprung.service.monitoring.following import FollowedVehicle
from sprung.service.monitoring.ring import Rings
from sprung.service.times import NANOSECONDS, now_ns, to_iso

log = logging.getLogger("sprung.edge")
RAW_AFTER_SECONDS = 20.0  # of samples after the window that raised an alarm
RAW_PAUSE_SECONDS = 3600.0  # before raw samples are sent again


@dataclass(frozen=True, slots=True)
class OnboardSettings:
    """How often, how much."""

    together_seconds: float = 10.0  # of windows that are identified together: one by one costs three times as much
    message_seconds: float = 60.0  # of windows in one message
    weigh_seconds: float = 30.0  # between windows that speak of gains, delays and loads: each takes 3 kB
    raw_seconds: float = 60.0  # of samples around an alarm; 0: none


@dataclass(slots=True)
class OnboardCounts:
    """What was made of the windows so far."""

    windows: int = 0
    messages: int = 0
    message_bytes: int = 0
    raw_files: int = 0
    raw_bytes: int = 0
    made_room: int = 0  # entries that were never sent because the spool was full
    alarms: int = 0


class Onboard:
    """Takes windows of one vehicle.  For one thread."""

    def __init__(self, engine: Engine, vehicle: str, spool: Spool, settings: OnboardSettings) -> None:
        hop = engine.system.hop / engine.system.sample_rate
        self.engine = replace(engine, weighed_of=max(1, round(settings.weigh_seconds / hop)))
        self.counts = OnboardCounts()
        self._settings = settings
        self._vehicle = vehicle
        self._spool = spool
        self._together = max(1, round(settings.together_seconds / hop))
        self._per_message = max(1, round(settings.message_seconds / hop))
        self._waiting: list[Window] = []
        self._made: list[WindowEstimate] = []
        raw = settings.raw_seconds
        self._ring = Rings(1, raw, len(engine.system.channels), engine.system.sample_rate) if raw else None
        self._raw_due: int | None = None  # ns: when enough samples after an alarm will be there
        self._raw_next = 0  # ns: before it, none are sent again
        state = self._restored()
        self._followed = FollowedVehicle(state, -1 if state.time is None else state.time)

    def process(
        self,
        vehicle: str,
        windows: Sequence[Window],
        recording_id: str | None = None,
        priority: Priority = Priority.LIVE,
    ) -> None:
        """Take windows in order of time."""
        for window in windows:
            self._waiting.append(window)
            if len(self._waiting) >= self._together:
                self._identify()
            if len(self._made) >= self._per_message:
                self._send()

    def flush(self) -> None:
        """Make messages of everything that was taken."""
        self._identify()
        self._send()
        if self._raw_due is not None:
            self._send_raw()

    @property
    def state(self) -> TrackerState:
        """The vehicle's tracker as of the windows that were identified."""
        return self._followed.state

    def _identify(self) -> None:
        windows, self._waiting = self._waiting, []
        whole = [w for w in windows if w.outcome != "dropped"]
        found: list[Estimate] = []
        if whole:
            values, starts = np.stack([w.values for w in whole]), [w.start for w in whole]
            known = [self.engine.tracker.known_faults(self.state)] * len(whole)
            found, _ = self.engine.identify(values, starts=starts, known=known)
        estimates = iter(found)
        for window in windows:
            estimate = None if window.outcome == "dropped" else _spoken(next(estimates))
            self._follow(window, estimate)
            self._made.append(WindowEstimate.of(window, estimate))
        self.counts.windows += len(windows)

    def _follow(self, window: Window, estimate: Estimate | None) -> None:
        before = self._followed.state
        self._followed = self._followed.after(
            self.engine.tracker, window, estimate, now_ns(), self.engine.system.conditions(window.auxiliary)
        )
        if estimate is None:
            return
        known = {(alarm.parameter, alarm.opened) for alarm in before.alarms}
        opened = [a for a in self._followed.state.active if (a.parameter, a.opened) not in known]
        self.counts.alarms += len(opened)
        if self._ring is None:
            return
        self._ring.add(self._vehicle, [window])
        if opened and self._raw_due is None and window.start >= self._raw_next:
            self._raw_due = window.start + round(min(RAW_AFTER_SECONDS, self._settings.raw_seconds / 2) * NANOSECONDS)
        if self._raw_due is not None and window.start >= self._raw_due:
            self._send_raw()

    def _send(self) -> None:
        if not self._made:
            return
        made, self._made = self._made, []
        body = encode(Message(self._vehicle, self.engine.digest, tuple(made)), "small")
        state = {"vehicle": self._vehicle, "model": self.engine.digest, "state": self._followed.state.to_dict()}
        self._kept(self._spool.add("estimates", body, tracker=state))
        self.counts.messages += 1
        self.counts.message_bytes += len(body)

    def _send_raw(self) -> None:
        self._raw_due = None
        excerpt = None if self._ring is None else self._ring.excerpt(self._vehicle)
        if excerpt is None:
            return
        system = self.engine.system
        name = f"{self._vehicle}-{to_iso(excerpt.start)}.mcap".replace(":", "")
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / name
            write_recording(
                path,
                system.channels,
                excerpt.values,
                excerpt.sample_rate,
                excerpt.start,
                vehicle=self._vehicle,
            )
            body = path.read_bytes()
        self._raw_next = excerpt.start + round(RAW_PAUSE_SECONDS * NANOSECONDS)
        self._kept(self._spool.add("recording", body, name))
        self.counts.raw_files += 1
        self.counts.raw_bytes += len(body)

    def _kept(self, made_room: int) -> None:
        if made_room:
            log.error("the spool is full: %d entries that were never sent are given up", made_room)
        self.counts.made_room += made_room

    def _restored(self) -> TrackerState:
        kept = self._spool.fact("tracker")
        if kept is None or (kept["vehicle"], kept["model"]) != (self._vehicle, self.engine.digest):
            return self.engine.tracker.initial_state()
        return self.engine.load_state(kept["state"])


def _spoken(estimate: Estimate) -> Estimate:
    """Without what a window says of loads alone: it takes more room than all the rest, and the next window that is
    weighed says it again."""
    found = estimate.deviating
    return estimate if found is None or found.whole else replace(estimate, deviating=None)

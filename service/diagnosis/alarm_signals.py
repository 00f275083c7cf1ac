"""The raw signals of the minute in which an alarm was raised, kept beside the uploads to be looked at later.

They are recordings of the source `alarm`: housekeeping, back-up and the deletion of a vehicle take them along.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from sqlalchemy import Connection
from sqlalchemy.exc import SQLAlchemyError

from sprung.model.system import System
from sprung.service.diagnosis.excerpts import kept_excerpt
from sprung.service.diagnosis.worker import load_excerpt
from sprung.service.monitoring.processed import Batch
from sprung.service.monitoring.ring import Excerpt, Rings
from sprung.service.settings import Settings
from sprung.service.store import Store, fleet, retention, work
from sprung.service.store.work import ALARM_SOURCE, RecordingRow
from sprung.service.times import NANOSECONDS, now_ns, to_iso

log = logging.getLogger("sprung.alarms")


@dataclass(frozen=True, slots=True)
class Stretch:
    """Samples that are kept of a vehicle, and since when they go until when."""

    start: int  # ns since epoch
    end: int
    recording: RecordingRow | None  # None: they are held in memory

    def covers(self, time: int) -> bool:
        """Whether the time, ns, lies in it."""
        return self.start <= time <= self.end


class AlarmSignals:
    """Keeps them when an alarm is raised.  Safe to share between threads."""

    def __init__(self, settings: Settings, store: Store, rings: Rings, aging: Callable[[], int] = now_ns) -> None:
        """aging: the clock by which what is kept ages, ns since 1970."""
        self._aging = aging
        self._settings = settings
        self._store = store
        self._rings = rings

    def on_batch(self, batch: Batch) -> None:
        """Keep the held samples of a vehicle if the batch raised an alarm; call it after the rings have the batch.

        What cannot be kept is logged: the alarm itself is worth more than its signals.
        """
        raised = [alarm for alarm in batch.state.alarms if batch.fresh and alarm.opened >= batch.fresh[0].start]
        if not raised or self._settings.alarm_signals_vehicle == 0:
            return
        try:
            with self._store.read() as connection:
                stretches = kept(connection, batch.vehicle)
            # of several alarms of one cause, raised one after the other, the first one's signals are kept
            if any(best(stretches, alarm.onset, alarm.opened) is None for alarm in raised):
                self._keep(batch.vehicle, batch.served.engine.system)
        except (OSError, SQLAlchemyError) as error:
            log.warning("the signals of an alarm of %s are not kept: %s", batch.vehicle, error)

    def _keep(self, vehicle: str, system: System) -> None:
        excerpt = self._rings.excerpt(vehicle)
        if excerpt is None:
            return
        stretch = held(excerpt)
        label = f"{(stretch.end - stretch.start) / NANOSECONDS:.0f} s until {to_iso(stretch.end)} of {vehicle}"
        about = {"start_ns": stretch.start, "end_ns": stretch.end, "channels": _channels(system)}
        now = now_ns()
        with kept_excerpt(self._settings.uploads, excerpt) as path:
            size = path.stat().st_size
            row = RecordingRow(work.new_id(), vehicle, label, ALARM_SOURCE, path.name, size, about, now, now)
            row = replace(row, kept_since_ns=self._aging())
            with self._store.write() as connection:
                files = [path.name]
                if fleet.vehicle_exists(connection, vehicle):  # it may have been deleted meanwhile
                    work.add_recording(connection, row)
                    limits = self._settings.alarm_signals_vehicle, self._settings.alarm_signals_bytes
                    files = retention.surplus_alarm_signals(connection, vehicle, *limits)
        for file in files:
            (self._settings.uploads / file).unlink(missing_ok=True)

    def load(self, stretch: Stretch, vehicle: str, system: System) -> Excerpt | None:
        """The samples; None where they are gone by now or were measured by other channels."""
        row = stretch.recording
        if row is None:
            return self._rings.excerpt(vehicle)
        if row.file is None or (row.tally or {}).get("channels") != _channels(system):
            return None
        try:
            found = load_excerpt(self._settings.uploads / row.file)
        except (OSError, ValueError) as error:
            log.warning("the signals of an alarm of %s cannot be read: %s", vehicle, error)
            return None
        return Excerpt(found.start, found.sample_rate, found.values)


def kept(connection: Connection, vehicle: str) -> list[Stretch]:
    """What is kept of a vehicle's alarms, newest first."""
    rows = work.alarm_recordings(connection, vehicle)
    return [Stretch(row.tally["start_ns"], row.tally["end_ns"], row) for row in rows if row.tally]


def held(excerpt: Excerpt) -> Stretch:
    """What is held in memory."""
    last = len(excerpt.values) - 1
    return Stretch(excerpt.start, excerpt.start + round(last * NANOSECONDS / excerpt.sample_rate), None)


def best(stretches: Sequence[Stretch], onset: int, raised: int) -> Stretch | None:
    """The first with the onset of an alarm, else the first with the time at which it was raised."""
    for time in (onset, raised):
        for stretch in stretches:
            if stretch.covers(time):
                return stretch
    return None


def _channels(system: System) -> list[str]:
    return [channel.name for channel in system.channels]

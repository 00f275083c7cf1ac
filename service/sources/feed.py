"""Recordings and buses into the pipeline: reading, identifying and storing overlap, each in a thread of its own."""

from __future__ import annotations

import re
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path, PurePath
from typing import Any

from sprung.model import comfort
from sprung.model.signals import Tally, Window
from sprung.model.text import IN_VEHICLE_IDS
from sprung.model.tracking.tracker import TrackerState
from sprung.service.errors import UserError
from sprung.service.monitoring import rides
from sprung.service.monitoring.compute import Priority
from sprung.service.monitoring.pipeline import Pipeline
from sprung.service.monitoring.processed import Batch, IdentifiedBatch
from sprung.service.processes.worker import ProcessLimits
from sprung.service.retrying import Retry, retry
from sprung.service.sources.reading import Ending, Reading, ReadRequest, ReadWindows, prefetched, reading_of
from sprung.service.store import work
from sprung.service.times import AHEAD, now_ns, to_iso

MOST_MINUTES = 1440  # of comfort that a summary keeps
MOST_LOST = 0.1  # of the samples; with more, too few windows can be used
NOT_IN_IDS = re.compile(f"[^{IN_VEHICLE_IDS}]")

OnBatch = Callable[[Batch], None]
OnTally = Callable[[Tally], None]


@dataclass(slots=True)
class FeedResult:
    """What feeding a source came to."""

    vehicle: str
    windows: Counter[str] = field(default_factory=lambda: Counter(used=0, repaired=0, dropped=0))
    reasons: Counter[str] = field(default_factory=Counter)  # of windows that were dropped
    adequate: int = 0  # windows that fit the model
    late: int = 0  # windows that were not tracked, older than what the tracker had seen
    stored_before: int = 0  # windows that the store had already
    expected: int = 0  # samples that the windows should hold
    lost: int = 0  # of these, samples that did not come or were invalid
    recorded_seconds: float = 0.0  # without pauses, jumps of the clock and stray time stamps
    last_ns: int | None = None  # of the samples
    state: TrackerState | None = None
    tally: Tally = field(default_factory=Tally)
    problems: list[str] = field(default_factory=list)  # one line each
    incomplete: bool = False
    wall_seconds: float = 0.0
    ride: comfort.RideQuality | None = None  # minutes of the body's accelerometers

    @property
    def fitting(self) -> dict[str, int]:
        """What became of the windows beyond being read."""
        return {"adequate": self.adequate, "untracked": self.late}

    @property
    def monitored(self) -> bool:
        """Whether the recording informs on its vehicle: windows were used, and few samples are lost."""
        usable = self.windows["used"] + self.windows["repaired"] - self.late
        return usable > 0 and self.lost < MOST_LOST * self.expected

    def summary(self) -> dict[str, Any]:
        """The counts, as the store and the jobs keep them."""
        return {
            "vehicle": self.vehicle,
            "windows": dict(self.windows),
            "frames": self.tally.as_dict(),
            "samples": {"expected": self.expected, "lost": self.lost},
            "problems": self.problems[:20],
            "fitting": self.fitting,
            "monitored": self.monitored,
            "late_windows": self.late,
            "stored_before": self.stored_before,  # windows of a recording that was sent before
            "comfort": None if self.ride is None else ride_dict(self.ride),
        }


def vehicle_of(named: str | None, recorded: str | None, file_name: str) -> str:
    """Whose windows these are: as the user says, else as the recording says, else the file's name.

    Made fit for a URL, as `service.api.bodies.VehicleId` has it.
    """
    name = NOT_IN_IDS.sub("_", named or recorded or PurePath(file_name).stem)[:128]
    return name if name[:1].isalnum() else f"v{name}"[:128]


def feed_file(
    pipeline: Pipeline,
    path: Path,
    *,
    vehicle: str | None = None,
    file_name: str | None = None,
    recording_id: str | None = None,
    batch_windows: int = 128,
    speed: float = 0.0,
    limits: ProcessLimits | None = None,
    on_batch: OnBatch = lambda batch: None,
    on_tally: OnTally = lambda tally: None,
    check: Callable[[], None] = lambda: None,
    start: int | None = None,
    retrying: bool = False,
) -> FeedResult:
    """Read a recording to its end, through the pipeline.

    file_name: what the user calls the file, where `path` is a name of the service's own.
    speed: times real time; 0: as fast as possible.  limits: read in a process of its own, within these.
    start: ns since 1970, when the recording began if its times count from 0; else the file's own time is taken.
    check: called while waiting; this stops with whatever it or `on_batch` raises, batches before are stored.
    retrying: a store that refuses a batch is asked again until it takes it, or `check` raises.
    Raises UnreadableRecording, or UserError where the limits are exceeded.
    """
    request = ReadRequest(
        path, pipeline.engine.system, pipeline.engine.dbc, 1 if speed else batch_windows, speed, start
    )
    reading = reading_of(request, limits)
    started = time.perf_counter()
    fed = FeedResult("", ride=comfort.RideQuality(pipeline.engine.system))
    feed = _FileFeed(
        pipeline,
        fed,
        path,
        given_name=vehicle,
        file_name=file_name or path.name,
        recording_id=recording_id,
        priority=Priority.LIVE if speed else Priority.BATCH,
        take=partial(retry, what=file_name or path.name, check=check) if retrying else _at_once,
    )
    found = prefetched(feed.identified(reading, check), 1, check)
    try:
        for one, tally in found:
            on_tally(tally)
            if one is not None:
                on_batch(_count(fed, feed.take(partial(pipeline.keep, one(), recording_id))))
    finally:
        reading.close()
        found.close()
    on_tally(reading.ending.tally)
    fed.vehicle = feed.vehicle_of(reading.ending.vehicle)
    fed.state = fed.state or feed.take(partial(pipeline.state, fed.vehicle))
    _ended(fed, reading.ending)
    fed.wall_seconds = time.perf_counter() - started
    return fed


@dataclass(frozen=True, slots=True)
class _FileFeed:
    """One recording on its way through the pipeline."""

    pipeline: Pipeline
    fed: FeedResult
    path: Path
    given_name: str | None  # of the vehicle, by the user
    file_name: str
    recording_id: str | None
    priority: Priority
    take: Retry[Any]  # does what needs the store, again and again if the feed is retrying

    def vehicle_of(self, recorded: str | None) -> str:
        """The vehicle's name; recorded: as the recording has it."""
        return self.fed.vehicle or vehicle_of(self.given_name, recorded, self.file_name)

    def identified(
        self, reading: Reading, check: Callable[[], None]
    ) -> Iterator[tuple[Callable[[], IdentifiedBatch] | None, Tally]]:
        """Windows as they are read, identified ahead where that is of use, with the tally until there; the ride's
        comfort is kept beside them."""
        fed = self.fed
        for piece in reading.pieces(check):
            found: Callable[[], IdentifiedBatch] | None = None
            if piece.windows:
                fed.vehicle = self.vehicle_of(piece.vehicle)
                if piece.assumed:
                    self._refuse_another_ride(piece)
                for window in piece.windows:
                    if window.outcome != "dropped" and fed.ride is not None:
                        fed.ride.push(window.start, window.values)
                found = partial(self._identify, piece.windows)
                if not self.pipeline.knows_faults(fed.vehicle):
                    found = partial(_itself, found())
            yield found, piece.tally

    def _identify(self, windows: list[Window]) -> IdentifiedBatch:
        found: IdentifiedBatch = self.take(partial(self.pipeline.identify, self.fed.vehicle, windows, self.priority))
        return found

    def _refuse_another_ride(self, piece: ReadWindows) -> None:
        """Raises UserError where another recording of the vehicle lies at the times that are assumed for a piece."""
        other = self.take(partial(_other_ride, self.pipeline, self.fed.vehicle, piece, self.recording_id))
        if other is not None:
            raise UserError(
                f"{self.path}: its times count from 0, and from {to_iso(piece.windows[0].start)} on, as the file's own "
                f"time has it, there is {other} of {self.fed.vehicle} already; say when it began (`sprung replay "
                "--start`, `start` beside an uploaded file)"
            )


def _other_ride(pipeline: Pipeline, vehicle: str, piece: ReadWindows, recording_id: str | None) -> str | None:
    """The name of another recording whose windows lie among those of a piece; None where there is none.

    One of the same name and size is the same recording, sent again.
    """
    first, last = piece.windows[0].start, piece.windows[-1].start
    with pipeline.store.read() as connection:
        model_id = pipeline.engines.of(connection, vehicle).model_id
        stored = work.recordings_between(connection, vehicle, model_id, first, last)
        own = None if recording_id is None else work.get_recording(connection, recording_id)
    others = [row.name for row in stored if own is None or (row.name, row.size_bytes) != (own.name, own.size_bytes)]
    return others[0] if others else None


def _at_once(work: Callable[[], Any]) -> Any:
    return work()


def _itself(found: IdentifiedBatch) -> IdentifiedBatch:
    return found


def _ended(fed: FeedResult, ending: Ending) -> None:
    """Take over what is known of a recording once it has been read."""
    fed.tally, fed.problems, fed.incomplete = ending.tally, ending.problems, ending.incomplete
    fed.expected, fed.lost = ending.expected, ending.lost
    fed.recorded_seconds, fed.last_ns = ending.recorded_seconds, ending.last_ns
    if fed.last_ns is not None and fed.last_ns > now_ns() + AHEAD:
        line = f"the recording ends on {to_iso(fed.last_ns)}, which is in the future by this host's clock"
        fed.problems = [*fed.problems, line]


def ride_dict(ride: comfort.RideQuality) -> dict[str, Any]:
    """The comfort of a ride, and of each of its latest minutes."""
    minutes = ride.by_minute()[-MOST_MINUTES:]
    return ride.summary() | {"by_minute": [{"start": to_iso(start), "sensors": figures} for start, figures in minutes]}


def comfort_dict(pipeline: Pipeline, fed: FeedResult) -> dict[str, Any]:
    """The ride's comfort, and what the changes from the vehicle's own baseline cost of it on an average track."""
    figures = ride_dict(fed.ride) if fed.ride is not None else {"minutes": 0, "sensors": {}}
    if fed.state is None:
        return figures | {"cost": None}
    return figures | {"cost": rides.cost(pipeline.engine, fed.state)}


def _count(fed: FeedResult, batch: Batch) -> Batch:
    fed.windows.update(record.outcome for record in batch.records)
    fed.reasons.update(r.reason or "" for r in batch.records if r.outcome == "dropped")
    fed.adequate += sum(record.solved is not None and record.solved.adequate for record in batch.records)
    fed.stored_before += len(batch.records) - len(batch.fresh)
    fed.late += sum(record.solved is not None and not record.tracked for record in batch.records)
    fed.state = batch.state
    return batch

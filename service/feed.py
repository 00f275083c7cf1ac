"""Recordings and buses into the pipeline: reading, identifying and storing overlap, each in a thread of its own."""

from __future__ import annotations

import queue
import re
import threading
import time
from collections import Counter
from collections.abc import Callable, Generator, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path, PurePath
from typing import Any, Protocol, TypeVar

from sprung.model.signals import SampleBlock, Tally, Window
from sprung.model.tracking.tracker import TrackerState
from sprung.replay import open_recording
from sprung.replay.pacing import paced
from sprung.replay.windowing import Windower
from sprung.service.compute import Priority
from sprung.service.errors import Busy
from sprung.service.pipeline import Batch, Identified, Pipeline
from sprung.service.times import NANOSECONDS

T = TypeVar("T")
NOT_IN_IDS = re.compile(r"[^A-Za-z0-9._:-]")
READ_AHEAD = 2  # batches; with them memory stays flat however long the file is

OnBatch = Callable[[Batch], None]
OnTally = Callable[[Tally], None]


class Source(Protocol):
    """A recording or a live bus."""

    @property
    def tally(self) -> Tally:
        """Messages so far, by what became of them."""

    def blocks(self) -> Iterator[SampleBlock]:
        """Samples in the order in which they come."""


@dataclass(slots=True)
class Fed:
    """What feeding a source came to."""

    vehicle: str
    windows: Counter[str] = field(default_factory=lambda: Counter(used=0, repaired=0, dropped=0))
    reasons: Counter[str] = field(default_factory=Counter)  # of windows that were dropped
    late: int = 0
    expected: int = 0  # samples that the windows should hold
    lost: int = 0  # of these, samples that did not come or were invalid
    first_ns: int | None = None  # of the samples
    last_ns: int | None = None
    state: TrackerState | None = None
    tally: Tally = field(default_factory=Tally)
    problems: list[str] = field(default_factory=list)  # one line each
    incomplete: bool = False
    wall_seconds: float = 0.0

    def recorded_seconds(self, sample_rate: float) -> float:
        """From the first sample to the end of the last one."""
        if self.first_ns is None or self.last_ns is None:
            return 0.0
        return round((self.last_ns - self.first_ns) / NANOSECONDS + 1 / sample_rate, 3)

    def summary(self) -> dict[str, Any]:
        """The counts, as the store and the jobs keep them."""
        return {
            "vehicle": self.vehicle,
            "windows": dict(self.windows),
            "frames": self.tally.as_dict(),
            "samples": {"expected": self.expected, "lost": self.lost},
            "problems": self.problems[:20],
            "late_windows": self.late,
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
    on_batch: OnBatch = lambda batch: None,
    on_tally: OnTally = lambda tally: None,
) -> Fed:
    """Read a recording to its end, through the pipeline.

    file_name: what the user calls the file, where `path` is a name of the service's own.
    speed: times real time; 0: as fast as possible.
    Stops with whatever `on_batch` raises; batches before are stored.  Raises UnreadableRecording.
    """
    started = time.perf_counter()
    recording = open_recording(path, pipeline.engine.system.channels, dbc=pipeline.engine.dbc)
    fed = Fed("")
    windows = _windows(pipeline, paced(recording.blocks(), speed), fed)
    batches = prefetched(_batched(windows, 1 if speed else batch_windows), READ_AHEAD)
    priority = Priority.LIVE if speed else Priority.BATCH

    def identified() -> Iterator[Identified]:
        for batch in batches:
            fed.vehicle = fed.vehicle or vehicle_of(vehicle, recording.vehicle, file_name or path.name)
            yield pipeline.identify(fed.vehicle, batch, priority)

    found = prefetched(identified(), 1)
    try:
        for one in found:
            on_tally(recording.tally)
            on_batch(_count(fed, pipeline.keep(one, recording_id)))
    finally:
        found.close()
        batches.close()
    on_tally(recording.tally)
    fed.vehicle = fed.vehicle or vehicle_of(vehicle, recording.vehicle, file_name or path.name)
    fed.state = fed.state or pipeline.state(fed.vehicle)
    fed.tally = recording.tally
    fed.problems = list(recording.problems)
    fed.incomplete = recording.incomplete
    fed.wall_seconds = time.perf_counter() - started
    return fed


def feed_live(pipeline: Pipeline, source: Source, vehicle: str, stopping: threading.Event, on_tally: OnTally) -> None:
    """Feed a live source until it ends or `stopping` is set; every window as soon as it is whole."""
    fed = Fed(vehicle)
    try:
        for window in _windows(pipeline, _until(source.blocks(), stopping), fed):
            _count(fed, pipeline.process(fed.vehicle, [window], None, Priority.LIVE))
            on_tally(source.tally)
    except Busy:  # a service that stops accepts nothing more; what it had accepted is stored
        if not stopping.is_set():
            raise
    on_tally(source.tally)


def prefetched(items: Iterator[T], ahead: int) -> Generator[T, None, None]:
    """The same items, produced in a thread of their own, at most `ahead` of them waiting."""
    waiting: queue.Queue[tuple[bool, Any]] = queue.Queue(ahead)
    abandoned = threading.Event()

    def offer(entry: tuple[bool, Any]) -> bool:
        while not abandoned.is_set():
            try:
                waiting.put(entry, timeout=0.1)
                return True
            except queue.Full:
                continue
        return False

    def produce() -> None:
        try:
            for item in items:
                if not offer((True, item)):
                    return
            offer((False, None))
        except BaseException as error:  # raised where the items are used
            offer((False, error))

    thread = threading.Thread(target=produce, name="sprung-read", daemon=True)
    thread.start()
    try:
        while True:
            more, item = waiting.get()
            if more:
                yield item
            elif item is None:
                return
            else:
                raise item
    finally:
        abandoned.set()
        thread.join()


def _count(fed: Fed, batch: Batch) -> Batch:
    fed.windows.update(record.outcome for record in batch.records)
    fed.reasons.update(r.reason or "" for r in batch.records if r.outcome == "dropped")
    fed.late += batch.late
    fed.state = batch.state
    return batch


def _windows(pipeline: Pipeline, blocks: Iterable[SampleBlock], fed: Fed) -> Iterator[Window]:
    system = pipeline.engine.system
    windower = Windower(system.channels, system.sample_rate, system.window, system.hop, inputs=len(system.inputs))
    for block in blocks:
        if len(block.time):
            first, last = int(block.time.min()), int(block.time.max())
            fed.first_ns = first if fed.first_ns is None else min(fed.first_ns, first)
            fed.last_ns = last if fed.last_ns is None else max(fed.last_ns, last)
        yield from windower.push(block)
    yield from windower.flush()
    fed.expected, fed.lost = windower.expected, windower.lost


def _batched(windows: Iterable[Window], size: int) -> Iterator[list[Window]]:
    held: list[Window] = []
    for window in windows:
        held.append(window)
        if len(held) >= size:
            yield held
            held = []
    if held:
        yield held


def _until(blocks: Iterable[SampleBlock], stopping: threading.Event) -> Iterator[SampleBlock]:
    for block in blocks:
        if stopping.is_set():
            return
        yield block

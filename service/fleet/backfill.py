"""Back-fill: recordings -> windows -> estimates, in any order and anywhere; then every vehicle's fold in order of time.

A file's estimates are a pure function of the file, and a vehicle's fold of one file depends on the fold of the file
before it: that is all that is said to whoever does the work (`service.fleet.tasks`).  Windows of a vehicle whose
tracker knows of faults of its measurements are identified once more while they are folded, as a replay does that knows
of them.

What is made lies under a model of its own (`staging:...`), unseen, until `swap` puts it in place vehicle by vehicle.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from sprung.model.signals import Estimate, MeasurementFault, Window
from sprung.service.fleet.message import Message, WindowEstimate, decode, encode
from sprung.service.fleet.recordings import FoundFile, list_recordings, local_copy
from sprung.service.fleet.tasks import Tasks, WorkLost
from sprung.service.jobs.recordings import reading_limits
from sprung.service.monitoring.compute import Compute
from sprung.service.monitoring.engine import Engine, load_engine
from sprung.service.monitoring.pipeline import Pipeline
from sprung.service.monitoring.processed import FaultsChanged, FoldedWindows
from sprung.service.processes.worker import ProcessLimits, carried_out
from sprung.service.settings import Settings
from sprung.service.sources.feed import vehicle_of
from sprung.service.sources.loading import RecordRequest, head_task
from sprung.service.sources.reading import Reading, ReadRequest, reading_of
from sprung.service.store import Store, fleet, open_store, status, work
from sprung.service.store.partitions import prepare
from sprung.service.store.staging import staging_digest, swap
from sprung.service.store.work import RecordingRow
from sprung.service.times import now_ns

AHEAD = 4  # files per core that may be identified ahead: bounds waiting results


@dataclass(frozen=True, slots=True)
class BackfillPlan:
    """What every piece of the work needs to know; travels with it."""

    settings: Settings
    place: str  # folder, or an address such as s3://bucket/folder
    since: int  # ns; windows before are left out
    until: int

    @property
    def name(self) -> str:
        """Distinguishes this back-fill from others: started again, it goes on where it stopped."""
        return hashlib.sha256(f"{self.place} {self.since} {self.until}".encode()).hexdigest()[:12]


@dataclass(frozen=True, slots=True)
class IdentifiedFile:
    """A file's estimates."""

    file: FoundFile
    messages: tuple[bytes, ...]  # exact ones, of the windows that were identified together
    incomplete: bool = False
    problem: str = ""


@dataclass(frozen=True, slots=True)
class FoldedFile:
    """What became of a file."""

    file: FoundFile
    windows: int = 0
    known: int = 0  # that were there before, as from a copy of the same recording
    incomplete: bool = False
    problem: str = ""
    before: bool = False  # it was done in an earlier run


@dataclass(slots=True)
class Backfilled:
    """What a back-fill came to."""

    files: int = 0
    windows: int = 0
    done_before: int = 0
    vehicles: list[str] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)  # one line each
    swapped: int = 0


OnFile = Callable[[FoldedFile, int, int], None]  # with how many are done, of how many


def backfill(plan: BackfillPlan, tasks: Tasks, cores: int, on_file: OnFile) -> Backfilled:
    """Do it all; what cannot be read is collected, everything else goes on."""
    found = list_recordings(plan.place)
    looked = [tasks.result(one) for one in [tasks.submit(look, plan, file) for file in found]]
    summary = Backfilled(files=len(found))
    summary.problems += [_of_file(file, file.problem) for file in looked if file.problem]
    files = sorted((f for f in looked if not f.problem), key=lambda f: (f.first_ns, f.vehicle, f.path))
    with opened_store(plan.settings) as store, store.read() as connection:
        rows = {file.id: work.get_recording(connection, _row_id(plan, file)) for file in files}
    last: dict[str, Any] = {}
    waiting: list[tuple[FoundFile, Any]] = []
    lost: set[str] = set()  # vehicles of which a piece of work was lost: they stay as they are, for the next time
    done = 0

    def settle(most: int) -> None:
        nonlocal done
        while len(waiting) > most:
            file, pending = waiting.pop(0)
            try:
                folded = tasks.result(pending)
            except WorkLost as error:
                lost.add(file.vehicle)
                folded = FoldedFile(file, problem=str(error))
            done += 1
            summary.windows += folded.windows
            if folded.problem:
                summary.problems.append(_of_file(folded.file, folded.problem))
            on_file(folded, done, len(files))

    for file in files:
        row = rows[file.id]
        if row is not None and row.finished_ns is not None:
            summary.done_before += 1
            done += 1
            on_file(FoldedFile(file, before=True), done, len(files))
            continue
        identified = tasks.submit(identify_file, plan, file)
        last[file.vehicle] = tasks.submit(fold_file, plan, identified, last.get(file.vehicle))
        waiting.append((file, last[file.vehicle]))
        settle(0 if tasks.at_once else AHEAD * cores)
    settle(0)
    summary.vehicles = sorted({file.vehicle for file in files})
    for one in [tasks.submit(swap_vehicle, plan, vehicle) for vehicle in summary.vehicles if vehicle not in lost]:
        summary.swapped += tasks.result(one)
    return summary


def _limits(plan: BackfillPlan, path: Path) -> ProcessLimits | None:
    return reading_limits(plan.settings, path) if plan.settings.isolate_reading else None


def look(plan: BackfillPlan, file: FoundFile) -> FoundFile:
    """Whose recording it is and when it began: its head is read, no more."""
    engine = engine_of(plan.settings)
    try:
        with local_copy(file) as path:
            system = engine.system
            start = file.modified_ns or None
            request = RecordRequest(path, system.channels, system.sample_rate, engine.dbc, system.time, start)
            head = carried_out(head_task, request, _limits(plan, path), f"the reading of {path.name}")
        if head.first_ns is None:
            return replace(file, problem="no samples of the system's channels")
        return replace(file, vehicle=vehicle_of(None, head.vehicle, Path(file.path).name), first_ns=head.first_ns)
    except Exception as error:  # the others go on
        return replace(file, problem=message_of(error))


def identify_file(plan: BackfillPlan, file: FoundFile) -> IdentifiedFile:
    """Estimates of a file's windows."""
    engine = engine_of(plan.settings)
    messages: list[bytes] = []
    try:
        with read_again(plan, file) as reading:
            for chosen in _chosen(plan, reading):
                sent = _identified(engine, chosen, ())
                messages.append(encode(Message(file.vehicle, engine.digest, sent), "exact"))
            ending = reading.ending
    except Exception as error:  # the others go on
        return IdentifiedFile(file, tuple(messages), True, message_of(error))
    problem = "; ".join(ending.problems[:3]) if ending.incomplete else ""
    return IdentifiedFile(file, tuple(messages), ending.incomplete, problem)


@contextmanager
def read_again(plan: BackfillPlan, file: FoundFile) -> Iterator[Reading]:
    """A file that is read in pieces as when it is replayed, so that estimates are the same bit by bit."""
    engine = engine_of(plan.settings)
    with local_copy(file) as path:
        together = plan.settings.batch_windows
        request = ReadRequest(path, engine.system, engine.dbc, together, start=file.modified_ns or None)
        reading = reading_of(request, _limits(plan, path))
        try:
            yield reading
        finally:
            reading.close()


def _chosen(plan: BackfillPlan, reading: Reading) -> Iterator[list[Window]]:
    """The windows of each piece that lie in the times of the plan, where there are any."""
    for piece in reading.pieces(lambda: None):
        if chosen := [w for w in piece.windows if plan.since <= w.start < plan.until]:
            yield chosen


def _identified(
    engine: Engine, windows: list[Window], faults: tuple[MeasurementFault, ...]
) -> tuple[WindowEstimate, ...]:
    """Windows identified together; faults: of the vehicle's measurements, that are put right before."""
    whole = [w for w in windows if w.outcome != "dropped"]
    found: Iterator[Estimate] = iter(())
    if whole:
        values, known = np.stack([w.values for w in whole]), [faults] * len(whole)
        found = iter(engine.identify(values, starts=[w.start for w in whole], known=known)[0])
    return tuple(WindowEstimate.of(w, None if w.outcome == "dropped" else next(found)) for w in windows)


def fold_file(plan: BackfillPlan, found: IdentifiedFile, before: FoldedFile | None) -> FoldedFile:
    """Fold a file's estimates into its vehicle's tracker, after those of the file `before`."""
    count, known = 0, 0
    with staging_pipeline(plan) as pipeline, ExitStack() as stack:
        pieces = _Pieces(plan, found.file, stack)
        row = RecordingRow(
            _row_id(plan, found.file),
            None,
            Path(found.file.path).name[:255],
            "backfill",
            None,
            found.file.size,
            None,
            now_ns(),
            None,
        )
        with pipeline.store.write() as connection:
            if work.get_recording(connection, row.id) is None:
                work.add_recording(connection, row)
        for number, body in enumerate(found.messages):
            try:
                folded = _folded(pipeline, found.file.vehicle, decode(body).windows, row.id, partial(pieces.at, number))
            except UnreadableAgain as error:
                return FoldedFile(found.file, count, known, True, str(error))
            pipeline.settle(folded)
            count += len(folded.batch.fresh)
            known += len(folded.batch.records) - len(folded.batch.fresh)
        if not found.problem or found.messages:
            with pipeline.store.write() as connection:
                tally = {"windows": count, "incomplete": found.incomplete, "problem": found.problem}
                vehicle = found.file.vehicle if count or known else None
                work.finish_recording(connection, row.id, vehicle, tally, now_ns())
    return FoldedFile(found.file, count, known, found.incomplete, found.problem)


def _folded(
    pipeline: Pipeline,
    vehicle: str,
    sent: tuple[WindowEstimate, ...],
    recording: str,
    samples: Callable[[], list[Window]],
) -> FoldedWindows:
    """Windows that are folded and stored; `samples`: the same windows with what was measured."""
    system = pipeline.engine.system
    faults: tuple[MeasurementFault, ...] = ()
    prepare(pipeline.store, (w.start for w in sent))
    while True:
        windows = [w.window(system.sample_rate, len(system.channels)) for w in sent]
        estimates = [w.estimate for w in sent]
        try:
            with pipeline.store.write() as connection:
                return pipeline.fold(connection, vehicle, windows, estimates, recording, faults=faults)
        except FaultsChanged as changed:
            faults = changed.faults
            sent = _identified(pipeline.engine, samples(), faults)


class UnreadableAgain(Exception):
    """A file that was read before cannot be read any more; one line."""


class _Pieces:
    """A file's windows with their samples, piece by piece; read when they are first asked for."""

    def __init__(self, plan: BackfillPlan, file: FoundFile, stack: ExitStack) -> None:
        self._plan, self._file, self._stack = plan, file, stack
        self._read: Iterator[list[Window]] | None = None
        self._piece: list[Window] = []
        self._next = 0

    def at(self, number: int) -> list[Window]:
        """Piece `number`; they are asked for in order, not necessarily all.  Raises UnreadableAgain."""
        try:
            if self._read is None:
                self._read = _chosen(self._plan, self._stack.enter_context(read_again(self._plan, self._file)))
            while self._next <= number:
                self._piece = next(self._read)
                self._next += 1
        except Exception as error:  # whatever it is: the other files go on
            raise UnreadableAgain(message_of(error)) from error
        return self._piece


def swap_vehicle(plan: BackfillPlan, vehicle: str) -> bool:
    """Replace a vehicle's history by the new one; whether there was one."""
    with staging_pipeline(plan) as made, shown_pipeline(plan, made.store) as shown:
        with made.store.write() as connection:
            fleet.hold_vehicle(connection, vehicle)
            if not swap(connection, vehicle, made.model_id, shown.model_id, now_ns()):
                return False
            in_use = status.fleet_model(connection, vehicle)
            if in_use in (None, shown.model_id):  # else another model is in use: `serve` shows this one when it starts
                shown.show(connection, vehicle)
        return True


def engine_of(settings: Settings) -> Engine:
    """The engine of a process that does pieces of the work, loaded once."""
    return _engine(settings.system, settings.dbc, settings.weights)


@cache
def _engine(system: Path | None, dbc: Path | None, weights: Path | None) -> Engine:
    return load_engine(Settings(system=system, dbc=dbc, weights=weights))


@contextmanager
def opened_store(settings: Settings, migrated: bool = False) -> Iterator[Store]:
    """The store, for a while; `migrated` as in `open_store`."""
    store = open_store(settings.store_url, migrated)
    try:
        yield store
    finally:
        store.close()


@contextmanager
def staging_pipeline(plan: BackfillPlan) -> Iterator[Pipeline]:
    """A pipeline into a model that is not visible yet."""
    engine = engine_of(plan.settings)
    with opened_store(plan.settings, migrated=True) as store, ExitStack() as stack:
        compute = Compute(1)
        stack.callback(compute.close)
        yield Pipeline(engine, store, compute, staging=staging_digest(engine.digest, plan.name))


@contextmanager
def shown_pipeline(plan: BackfillPlan, store: Store) -> Iterator[Pipeline]:
    """The pipeline of the model itself."""
    compute = Compute(1)
    try:
        yield Pipeline(engine_of(plan.settings), store, compute)
    finally:
        compute.close()


def _row_id(plan: BackfillPlan, file: FoundFile) -> str:
    """One row a file, back-fill and model."""
    key = f"{file.id} {plan.name} {engine_of(plan.settings).digest}"
    return hashlib.sha256(key.encode()).hexdigest()[:36]


def _of_file(file: FoundFile, problem: str) -> str:
    return problem if problem.startswith(file.path) else f"{file.path}: {problem}"  # readers mostly say whose it is


def message_of(error: Exception) -> str:
    """What is wrong with a recording, in one line."""
    expected = isinstance(error, ValueError | OSError)  # as readers say it
    text = str(error) or type(error).__name__ if expected else f"unexpected {type(error).__name__}: {error}"
    return " ".join(text.split())[:500]

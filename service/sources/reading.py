"""Recordings as windows: here, read ahead in a thread, or apart, in a process of its own with limits."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable, Generator, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol, TypeVar

from sprung.model.signals import Tally, Window
from sprung.model.system import System
from sprung.replay.auxiliary import AuxiliaryMeans
from sprung.replay.clock_messages import pauses, remarks
from sprung.replay.pacing import paced
from sprung.replay.windowing import Windower
from sprung.service.processes.worker import Emit, ProcessLimits, Worker
from sprung.service.sources.opening import open_stream

T = TypeVar("T")
READ_AHEAD = 2  # batches; with them memory stays flat however long the file is
SIGN_OF_LIFE_SECONDS = 1.0  # a file without windows is reported, too
WAIT_SECONDS = 0.1
SLOWEST_BYTES_PER_SECOND = 100_000  # any reader is faster, by an order of magnitude


@dataclass(frozen=True, slots=True)
class ReadRequest:
    """A recording to cut into windows."""

    path: Path
    system: System
    dbc: Path | None
    batch_windows: int
    speed: float = 0.0  # times real time; 0: as fast as possible
    start: int | None = None  # ns since 1970, of recordings whose times count from 0; None: as the file's own time


@dataclass(frozen=True, slots=True)
class ReadWindows:
    """Windows in order of time, and what had become of the messages when they were whole."""

    windows: list[Window]
    tally: Tally
    vehicle: str | None  # as recorded
    assumed: bool = False  # when it began: its times count from 0, and nobody has said


@dataclass(frozen=True, slots=True)
class Ending:
    """What a recording came to."""

    tally: Tally
    vehicle: str | None
    problems: list[str]  # one line each
    incomplete: bool
    expected: int  # samples that the windows should hold
    lost: int  # of these, samples that did not come or were invalid
    recorded_seconds: float  # without pauses, jumps of the clock and stray time stamps
    last_ns: int | None  # of the samples


class Reading(Protocol):
    """A recording that is being read."""

    @property
    def ending(self) -> Ending:
        """Known when `pieces` has ended."""

    def pieces(self, check: Callable[[], None]) -> Iterator[ReadWindows]:
        """Windows as they become whole; `check` is called while waiting and may raise to give up."""

    def close(self) -> None:
        """Stop reading; may be called from any thread."""


def windower_of(system: System, stamped: bool = False) -> Windower:
    """The windower of a system; `stamped`: times are those of sampling, not of arrival."""
    return Windower(
        system.channels,
        system.sample_rate,
        system.window,
        system.hop,
        needed=system.needed,
        stamped=stamped,
    )


def read(request: ReadRequest, emit: Emit[ReadWindows]) -> Ending:
    """Read to the end, handing over pieces of `batch_windows` windows.  Raises UnreadableRecording.

    Pieces do not depend on how fast the machine is: estimates depend on what they are identified with, in the last
    digits, and a recording that is read again should give the same.
    """
    system = request.system
    recording = open_stream(request.path, system, request.dbc, request.start)
    windower = windower_of(system, recording.stamped)
    beside = AuxiliaryMeans(len(system.channels), len(system.auxiliary))
    held: list[Window] = []
    whole = 0
    reported = time.monotonic()

    def tell(some: list[Window]) -> None:
        assumed = request.start is None and recording.relative
        emit(ReadWindows(some, _copy(recording.tally), recording.vehicle, assumed))

    def report() -> None:
        nonlocal held, reported
        tell(held)
        held, reported = [], time.monotonic()

    for block in paced(recording.at_rate(system.sample_rate, beside.keep), request.speed):
        for window in windower.push(block):
            held.append(beside.to(window))
            whole += 1
            if len(held) >= request.batch_windows:
                report()
        if time.monotonic() - reported > SIGN_OF_LIFE_SECONDS:
            tell([])
            reported = time.monotonic()
    last = windower.flush()
    held += [beside.to(window) for window in last]
    for first in range(0, len(held), request.batch_windows):
        tell(held[first : first + request.batch_windows])
    said = remarks(windower, whole + len(last))
    return Ending(
        recording.tally,
        recording.vehicle,
        [*said, *recording.problems, *pauses(windower)],
        recording.incomplete or bool(said),
        windower.account.expected,
        windower.account.lost,
        round(windower.account.recorded, 3),
        windower.order.newest,
    )


class ThreadReading:
    """Reads in a thread of this process: for files of the user's own."""

    def __init__(self, request: ReadRequest) -> None:
        self._request = request
        self._ending: Ending | None = None
        self._closed = threading.Event()

    @property
    def ending(self) -> Ending:
        """What the recording came to."""
        assert self._ending is not None, "the recording is not read yet"
        return self._ending

    def pieces(self, check: Callable[[], None]) -> Iterator[ReadWindows]:
        """Windows as they become whole."""

        def produce(put: Callable[[ReadWindows], None]) -> None:
            self._ending = read(self._request, put)

        found = produced(produce, READ_AHEAD, check)
        try:
            for piece in found:
                if self._closed.is_set():
                    return
                yield piece
        finally:
            found.close()

    def close(self) -> None:
        """Stop after the next piece."""
        self._closed.set()


class ProcessReading:
    """Reads in a process of its own: for files of strangers."""

    def __init__(self, request: ReadRequest, limits: ProcessLimits) -> None:
        self._worker: Worker[ReadWindows, Ending] = Worker(read, request, limits, "the reading of the recording")

    @property
    def ending(self) -> Ending:
        """What the recording came to."""
        return self._worker.result

    def pieces(self, check: Callable[[], None]) -> Iterator[ReadWindows]:
        """Windows as they become whole."""
        return self._worker.messages(check)

    def close(self) -> None:
        """End the process."""
        self._worker.kill()


def reading_of(request: ReadRequest, limits: ProcessLimits | None) -> Reading:
    """A recording that is about to be read: in a process of its own, or here where limits are None."""
    return ThreadReading(request) if limits is None else ProcessReading(request, limits)


class _Abandoned(Exception):
    """Raised where items are produced when nobody wants them any more."""


def produced(
    produce: Callable[[Callable[[T], None]], None], ahead: int, check: Callable[[], None] = lambda: None
) -> Generator[T, None, None]:
    """What `produce` puts, made in a thread of its own, at most `ahead` items waiting; its errors are raised here."""
    waiting: queue.Queue[tuple[bool, Any]] = queue.Queue(ahead)
    abandoned = threading.Event()

    def offer(entry: tuple[bool, Any]) -> None:
        while not abandoned.is_set():
            try:
                waiting.put(entry, timeout=WAIT_SECONDS)
                return
            except queue.Full:
                continue
        raise _Abandoned

    def work() -> None:
        try:
            try:
                produce(lambda item: offer((True, item)))
            except _Abandoned:
                raise
            except BaseException as error:  # raised where the items are used
                offer((False, error))
            else:
                offer((False, None))
        except _Abandoned:
            return

    thread = threading.Thread(target=work, name="sprung-read", daemon=True)
    thread.start()
    try:
        while True:
            try:
                more, item = waiting.get(timeout=WAIT_SECONDS)
            except queue.Empty:
                check()
                continue
            if more:
                yield item
            elif item is None:
                return
            else:
                raise item
    finally:
        abandoned.set()
        thread.join()


def prefetched(items: Iterator[T], ahead: int, check: Callable[[], None] = lambda: None) -> Generator[T, None, None]:
    """The same items, produced in a thread of their own, at most `ahead` of them waiting."""

    def put_all(put: Callable[[T], None]) -> None:
        for item in items:
            put(item)

    return produced(put_all, ahead, check)


def _copy(tally: Tally) -> Tally:
    return replace(tally, reasons=tally.reasons.copy())

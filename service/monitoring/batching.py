"""Windows of several clients, read, identified, tracked and stored together.

The numerics cost per call more than per window, and so does a transaction.  While one batch is being worked on the next
one gathers: a single client waits for nobody, and many share the cost.  A batch for which the tracker is not ready yet
goes on gathering as well: identified early in small parts it would wait all the same, and take the tracker's processor
time.
"""

from __future__ import annotations

import asyncio
import math
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field

import numpy as np
from sqlalchemy.exc import SQLAlchemyError

from sprung.model.signals import Estimate, FloatArray, Window
from sprung.service.errors import Busy
from sprung.service.monitoring.batched_tracking import FoundWindow, track_together
from sprung.service.monitoring.compute import Compute, Priority
from sprung.service.monitoring.engines import ServedModel
from sprung.service.monitoring.fair_queues import FairQueues
from sprung.service.monitoring.pipeline import Pipeline
from sprung.service.store.vehicle_models import SERVICE_FILE
from sprung.service.store.windows import WindowRecord

TOGETHER = 32  # windows of one batch: more gain little and let the first one wait longer
ENOUGH = TOGETHER // 2  # windows, for which no others are waited for
PATIENCE = 0.01  # s, for windows that are being read
READERS = 2  # threads that look through bodies


@dataclass(frozen=True, slots=True)
class AskedWindow:
    """A window as a client sent it."""

    values: FloatArray  # shape (T, C)
    served: ServedModel  # with which it is identified
    vehicle: str | None = None
    states: bool = False  # whether the simulated states are wanted
    start: int | None = None  # ns, of a window that is to be tracked and stored; None: it is only identified


@dataclass(frozen=True, slots=True)
class AnsweredWindow:
    """What became of it."""

    asked: AskedWindow
    estimate: Estimate
    record: WindowRecord | None = None  # as it is stored


@dataclass(slots=True, eq=False)
class _Request:
    """One on its way."""

    loop: asyncio.AbstractEventLoop
    future: asyncio.Future[AnsweredWindow]
    since: float = field(default_factory=time.perf_counter)
    handed: float = 0.0  # perf_counter s, to the tracking thread
    asked: AskedWindow | None = None
    answer: AnsweredWindow | BaseException | None = None

    @property
    def sent(self) -> AskedWindow:
        """Once it was read."""
        assert self.asked is not None
        return self.asked

    @property
    def estimate(self) -> Estimate:
        """Once it was identified."""
        assert isinstance(self.answer, AnsweredWindow)
        return self.answer.estimate

    def settle(self) -> None:
        """Tell whoever waits; runs in its event loop."""
        if self.future.done():  # it does not wait any more
            return
        if isinstance(self.answer, AnsweredWindow):
            self.future.set_result(self.answer)
        else:
            self.future.set_exception(self.answer or RuntimeError("a window was forgotten"))


class Batcher:
    """Takes single windows, hands batches to the numerics and to the store.  For any event loop."""

    def __init__(
        self,
        pipeline: Pipeline,
        compute: Compute,
        limit: int,
        observe: Callable[[dict[str, float]], None],
        beside: Batcher | None = None,
    ) -> None:
        """limit: windows that may wait; observe: called with the seconds of each stage, both queues among them; beside:
        takes the windows of vehicles with a model of their own, for which others do not wait; these take turns."""
        self._pipeline = pipeline
        self._compute = compute
        self._limit = limit
        self._observe = observe
        self._beside = beside
        self._reading = 0
        self._waiting = FairQueues(_whose)
        self._to_track: deque[_Request] = deque()
        self._lock = threading.Lock()
        self._called = False  # a batch is in the compute's queue, or being identified
        self._tracking = False  # as well, in the tracking thread's
        self._readers = ThreadPoolExecutor(READERS, "sprung-read")
        self._tracker = ThreadPoolExecutor(1, "sprung-track")

    @property
    def waiting(self) -> int:
        """Windows that no batch has taken yet."""
        return len(self._waiting) + (0 if self._beside is None else self._beside.waiting)

    async def ask(self, read: Callable[[], AskedWindow]) -> AnsweredWindow:
        """The answer to a window, stored where that was asked for.

        read: looks through what was sent, in a thread; what it raises is raised here.  Raises Busy when too many wait.
        """
        loop = asyncio.get_running_loop()
        request = _Request(loop, loop.create_future())
        with self._lock:
            if len(self._waiting) + self._reading >= self._limit:
                raise _busy()
            self._reading += 1
        self._readers.submit(self._read, request, read)
        return await request.future

    def close(self) -> None:
        """Let the threads end."""
        self._readers.shutdown()
        self._tracker.shutdown()
        if self._beside is not None:
            self._beside.close()

    def _read(self, request: _Request, read: Callable[[], AskedWindow]) -> None:
        """In one of the readers' threads."""
        try:
            request.asked = read()
        except BaseException as error:
            request.answer = error
        own = request.asked is not None and request.asked.served.version != SERVICE_FILE
        beside = self._beside if own else None
        with self._lock:
            self._reading -= 1
            if request.asked is not None and beside is None:
                self._waiting.append(request)
            refused = self._call_in_time()
        _deliver([request, *refused] if request.asked is None else refused)
        if beside is not None:
            beside.take(request)

    def take(self, request: _Request) -> None:
        """A window that another batcher has read; of one vehicle no more wait than there are places left for others."""
        with self._lock:
            if self._waiting.alike(request) >= self._limit - len(self._waiting):
                request.answer, refused = _busy(), [request]
            else:
                self._waiting.append(request)
                refused = self._call_in_time()
        _deliver(refused)

    def _call_in_time(self) -> list[_Request]:
        """As `_call`, unless that is done or better done later; whoever ends the wait calls this again."""
        return [] if self._called or self._more_to_come() or self._tracker_is_behind() else self._call()

    def _more_to_come(self) -> bool:
        """Whether a batch is better off with windows that are being read just now; the last of them calls."""
        if not self._reading or len(self._waiting) >= ENOUGH:
            return False
        return time.perf_counter() - min((one.since for one in self._waiting), default=math.inf) < PATIENCE

    def _tracker_is_behind(self) -> bool:
        """Whether a batch would wait behind another one for the tracker; that calls when it takes the other one."""
        return bool(self._to_track) and len(self._waiting) < TOGETHER and all(map(_is_followed, self._waiting))

    def _call(self) -> list[_Request]:
        """Ask the numerics for a batch of what waits; those refused, as their queue is full of others' work."""
        if not self._waiting:
            return []
        try:
            self._compute.submit(self._identify, Priority.REQUEST)
        except Busy:
            refused = self._waiting.clear()
            for request in refused:
                request.answer = _busy()
            return refused
        self._called = True
        return []

    def _identify(self) -> None:
        """One batch; runs in the numerics' thread."""
        with self._lock:
            batch = self._waiting.take(lambda one: self._pipeline.pace.windows(one.sent.served, TOGETHER))
        try:
            self._identify_together(batch)
        except BaseException as error:  # no memory, or none for another thread: who waits hears of it, and others go on
            for request in batch:
                request.answer = error
        with self._lock:
            self._called = False
            refused = self._call_in_time()
        _deliver([*refused, *(request for request in batch if not _to_be_tracked(request))])

    def _identify_together(self, batch: Sequence[_Request]) -> None:
        """Estimates of a batch, and those to be tracked handed over; all of them, or none where this raises."""
        now = time.perf_counter()
        alike: dict[tuple[int, bool, bool], list[_Request]] = {}
        for request in batch:
            if not request.future.cancelled():
                self._observe({"queue": now - request.since})
                sent = request.sent
                alike.setdefault((id(sent.served.engine), sent.states, sent.start is not None), []).append(request)
        for together in alike.values():
            self._estimate(together)
        self._track([request for request in batch if _to_be_tracked(request)])

    def _estimate(self, batch: Sequence[_Request]) -> None:
        """Windows that are asked about in the same way."""
        first = batch[0].sent
        starts = None if first.states or first.start is None else [request.sent.start or 0 for request in batch]
        values = np.stack([request.sent.values for request in batch])
        vehicles = [request.sent.vehicle for request in batch]
        known = [() if name is None else self._pipeline.known_faults(name, first.served) for name in vehicles]
        try:
            estimates, seconds = first.served.engine.identify(values, states=first.states, starts=starts, known=known)
        except BaseException as error:
            if len(batch) == 1:
                batch[0].answer = error
                return
            for request in batch:  # one of them spoils it for the others
                self._estimate([request])
            return
        self._observe(seconds)
        self._pipeline.pace.note(first.served, len(batch), sum(seconds.values()))
        for request, estimate in zip(batch, estimates, strict=True):
            request.answer = AnsweredWindow(request.sent, estimate)

    def _track(self, requests: Sequence[_Request]) -> None:
        """Hand over to the tracking thread."""
        if not requests:
            return
        now = time.perf_counter()
        for request in requests:
            request.handed = now
        with self._lock:
            if not self._tracking:
                self._tracker.submit(self._keep)  # raises where its thread cannot be started
                self._tracking = True
            self._to_track.extend(requests)

    def _keep(self) -> None:
        """All that wait to be tracked, in one transaction; runs in the tracking thread."""
        with self._lock:
            self._tracking = False
            batch = list(self._to_track)
            self._to_track.clear()
            refused = self._call_in_time()
        _deliver(refused)
        now = time.perf_counter()
        try:
            for request in batch:
                self._observe({"track queue": now - request.handed})
            self._keep_together(batch)
        except BaseException as error:  # as above: no memory
            for request in batch:
                request.answer = error
        _deliver(batch)

    def _keep_together(self, batch: Sequence[_Request]) -> None:
        found = [_found(request.sent, request.estimate) for request in batch]
        try:
            records = track_together(self._pipeline, found)
        except BaseException as error:
            if len(batch) == 1 or isinstance(
                error, SQLAlchemyError | OSError | TimeoutError
            ):  # of the store: everyone's
                for request in batch:
                    request.answer = error
                return
            for request in batch:
                self._keep_together([request])
            return
        for request, record in zip(batch, records, strict=True):
            request.answer = AnsweredWindow(request.sent, request.estimate, record)


def _whose(request: _Request) -> str | None:
    """Whose turn it has: that of its vehicle where this has a model of its own."""
    return None if request.sent.served.version == SERVICE_FILE else request.sent.vehicle


def _is_followed(request: _Request) -> bool:
    """Whether it is asked to be tracked and stored."""
    return request.asked is not None and request.asked.start is not None


def _to_be_tracked(request: _Request) -> bool:
    """Whether it was identified, too."""
    return _is_followed(request) and isinstance(request.answer, AnsweredWindow)


def _found(asked: AskedWindow, estimate: Estimate) -> FoundWindow:
    assert asked.vehicle is not None and asked.start is not None
    window = Window(asked.start, asked.served.engine.system.sample_rate, asked.values)
    return FoundWindow(asked.vehicle, window, estimate, asked.served)


def _busy() -> Busy:
    return Busy("the numerics are busy; try again in a second")


def _deliver(requests: Sequence[_Request]) -> None:
    """Tell all that wait at once: woken one by one they would take turns with the next batch."""
    by_loop: dict[asyncio.AbstractEventLoop, list[_Request]] = {}
    for request in requests:
        by_loop.setdefault(request.loop, []).append(request)
    for loop, theirs in by_loop.items():
        with suppress(RuntimeError):  # the loop has ended, and nobody waits
            loop.call_soon_threadsafe(_settle, theirs)


def _settle(requests: Sequence[_Request]) -> None:
    for request in requests:
        request.settle()

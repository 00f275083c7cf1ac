"""One thread for the numerics: requests of people first, recordings behind, and a bounded queue before both."""

from __future__ import annotations

import itertools
import queue
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from enum import IntEnum
from typing import Any, TypeVar

from sprung.service.errors import Busy

T = TypeVar("T")


class Priority(IntEnum):
    """Smaller goes first."""

    REQUEST = 0
    LIVE = 1
    BATCH = 2
    STOP = 3


class Compute:
    """Runs functions one after the other in its own thread, so that torch never blocks an event loop.

    A single thread is deliberate: torch uses all cores within one call, and two calls at once only get slower.
    """

    def __init__(self, queue_size: int, on_wait: Callable[[float], None] = lambda seconds: None) -> None:
        """on_wait: called with the time that each function waited for its turn, s."""
        self._queue: queue.PriorityQueue[tuple[int, int, float, Callable[[], Any], Future[Any]]] = queue.PriorityQueue(
            queue_size
        )
        self._on_wait = on_wait
        self._number = itertools.count()
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._run, name="sprung-compute", daemon=True)
        self._thread.start()

    def submit(self, work: Callable[[], T], priority: Priority = Priority.REQUEST) -> Future[T]:
        """Queue work without waiting; raises Busy when the queue is full or closed."""
        future: Future[T] = Future()
        self._refuse_when_closed()
        try:
            self._queue.put_nowait((priority, next(self._number), time.perf_counter(), work, future))
        except queue.Full:
            raise Busy("the numerics are busy; try again in a second") from None
        return future

    def run(self, work: Callable[[], T], priority: Priority = Priority.BATCH) -> T:
        """Queue work, wait for a place and for the result; for threads that produce in bulk."""
        if threading.current_thread() is self._thread:
            return work()
        future: Future[T] = Future()
        self._refuse_when_closed()
        self._queue.put((priority, next(self._number), time.perf_counter(), work, future))
        return future.result()

    @property
    def waiting(self) -> int:
        """Entries in the queue."""
        return self._queue.qsize()

    def close(self) -> None:
        """Finish what was queued, then stop."""
        if not self._closed.is_set():
            self._closed.set()
            self._queue.put((Priority.STOP, next(self._number), 0.0, lambda: None, Future()))
            self._thread.join()

    def _refuse_when_closed(self) -> None:
        if self._closed.is_set():
            raise Busy("the service is stopping")

    def _run(self) -> None:
        while True:
            priority, _, since, work, future = self._queue.get()
            if priority == Priority.STOP:
                return
            self._on_wait(time.perf_counter() - since)
            if not future.set_running_or_notify_cancel():
                continue
            try:
                future.set_result(work())
            except BaseException as error:  # whoever waits for the result gets it
                future.set_exception(error)

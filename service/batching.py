"""Windows of several clients, identified together.

The numerics cost per call more than per window.  While one batch is being identified the next one gathers: a single
client waits for nobody, and many share the cost.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass, field

import numpy as np

from sprung.model.signals import Estimate, FloatArray
from sprung.service.compute import Compute, Priority
from sprung.service.engine import Engine
from sprung.service.errors import Busy

TOGETHER = 32  # windows of one batch: more gain little and let the first one wait longer


@dataclass(slots=True)
class _Asked:
    values: FloatArray  # shape (T, C)
    engine: Engine
    states: bool
    start: int | None  # ns, of a window that will be tracked
    future: Future[Estimate] = field(default_factory=Future)
    since: float = field(default_factory=time.perf_counter)


class Batcher:
    """Takes single windows, hands batches to the numerics.  Safe to share between threads."""

    def __init__(
        self, engine: Engine, compute: Compute, limit: int, observe: Callable[[dict[str, float]], None]
    ) -> None:
        """limit: windows that may wait; observe: told the seconds of each stage, `queue` among them."""
        self._engine = engine
        self._compute = compute
        self._limit = limit
        self._observe = observe
        self._waiting: deque[_Asked] = deque()
        self._lock = threading.Lock()
        self._called = False  # a batch is in the compute's queue and has not begun

    @property
    def waiting(self) -> int:
        """Windows that no batch has taken yet."""
        return len(self._waiting)

    def submit(
        self, values: FloatArray, states: bool = False, start: int | None = None, engine: Engine | None = None
    ) -> Future[Estimate]:
        """Queue a window, shape (T, C), without waiting.  Raises Busy when too many wait.

        start: ns, of a window that will be tracked (see `Engine.identify`); engine: of a vehicle that has its own.
        """
        asked = _Asked(values, engine or self._engine, states, start)
        with self._lock:
            if len(self._waiting) >= self._limit:
                raise Busy("the numerics are busy; try again in a second")
            if not self._called:
                self._compute.submit(self._identify, Priority.REQUEST)
                self._called = True
            self._waiting.append(asked)
        return asked.future

    def _identify(self) -> None:
        """One batch; runs in the numerics' thread."""
        with self._lock:
            self._called = False
            batch = [self._waiting.popleft() for _ in range(min(TOGETHER, len(self._waiting)))]
            if self._waiting:
                self._call_again()
        now = time.perf_counter()
        wanted = [asked for asked in batch if asked.future.set_running_or_notify_cancel()]
        for asked in wanted:
            self._observe({"queue": now - asked.since})
        alike: dict[tuple[int, bool, bool], list[_Asked]] = {}
        for asked in wanted:
            alike.setdefault((id(asked.engine), asked.states, asked.start is not None), []).append(asked)
        for together in alike.values():
            self._answer(together)

    def _call_again(self) -> None:
        try:
            self._compute.submit(self._identify, Priority.REQUEST)
            self._called = True
        except Busy as busy:  # the queue is full of others' work
            for asked in self._waiting:
                if asked.future.set_running_or_notify_cancel():
                    asked.future.set_exception(busy)
            self._waiting.clear()

    def _answer(self, batch: list[_Asked]) -> None:
        """Windows that are asked about in the same way."""
        states = batch[0].states
        try:
            estimates, seconds = batch[0].engine.identify(
                np.stack([asked.values for asked in batch]),
                states=states,
                starts=None if states or batch[0].start is None else [asked.start or 0 for asked in batch],
            )
        except BaseException as error:
            if len(batch) == 1:
                batch[0].future.set_exception(error)
                return
            for asked in batch:  # one of them spoils it for the others
                self._answer([asked])
            return
        self._observe(seconds)
        for asked, estimate in zip(batch, estimates, strict=True):
            asked.future.set_result(estimate)

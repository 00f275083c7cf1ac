"""Whose turn it is to write.

SQLite has one writer.  Where another program holds its lock, each transaction waits for that lock for many seconds in
its turn, and whoever waits behind it holds a thread: without a limit all threads that answer requests would soon wait
there, and none would be left for those who only read.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

from sqlalchemy.exc import TimeoutError as NotInTime

STUCK_SECONDS = 3.0  # of a transaction: from then on only few may wait behind it
MOST_BEHIND = 8  # far below the forty threads that answer requests
LOOK_SECONDS = 0.25
LONGEST_WAIT = 60.0  # s, where the caller does not say


class WriteLock:
    """Lets `most` transactions at once write.  Safe to share between threads."""

    def __init__(self, most: int) -> None:
        self._free = threading.BoundedSemaphore(most)
        self._lock = threading.Lock()
        self._waiting: dict[object, None] = {}  # in the order in which they came
        self._writing: dict[object, float] = {}  # since when, monotonic s

    @contextmanager
    def held(self, seconds: float = LONGEST_WAIT) -> Iterator[None]:
        """Wait for a turn, no longer than so many seconds.  Raises SQLAlchemy's TimeoutError where it would come too
        late."""
        me = object()
        self._wait(me, time.monotonic() + seconds)
        try:
            yield
        finally:
            with self._lock:
                del self._writing[me]
            self._free.release()

    def _wait(self, me: object, until: float) -> None:
        with self._lock:
            self._waiting[me] = None
        try:
            while not self._free.acquire(timeout=0.0 if self._too_late(me, until) else LOOK_SECONDS):
                if self._too_late(me, until):
                    raise NotInTime("other transactions have not ended for a while")
            with self._lock:
                self._writing[me] = time.monotonic()
        finally:
            with self._lock:
                del self._waiting[me]

    def _too_late(self, me: object, until: float) -> bool:
        now = time.monotonic()
        with self._lock:
            stuck = any(now - since > STUCK_SECONDS for since in self._writing.values())
            before = list(self._waiting).index(me) if stuck else 0
        return now > until or before >= MOST_BEHIND

"""A live source into the pipeline, for as long as the service runs, whatever happens to the bus, the numerics or the
store in the meantime.

One thread reads the source and cuts windows, one identifies and stores them, one watches both.  Between the first two
is a bounded queue: a store that is locked for a minute loses nothing, and one that stays away costs whole windows,
which are counted.
"""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol

from sprung.model.signals import SampleBlock, Tally, Window
from sprung.model.text import first_line
from sprung.replay.auxiliary import AuxiliaryMeans
from sprung.service.monitoring.compute import Priority
from sprung.service.monitoring.engine import Engine
from sprung.service.retrying import FIRST_RETRY, LAST_RETRY, is_transient
from sprung.service.sources.feed import OnTally
from sprung.service.sources.reading import windower_of

log = logging.getLogger("sprung.live")

WAITING_WINDOWS = 240  # two minutes at two windows a second, 22 kB each
TOGETHER = 32  # windows that are stored in one transaction when some wait
SILENT_SECONDS = 10.0  # without a sample from an open bus
HUNG_SECONDS = 30.0  # without a sign of the reader; it looks at the bus twenty times a second
WATCH_SECONDS = 1.0
BEHIND_SECONDS = 5.0
LATELY_SECONDS = 30.0  # for which windows that were given up show in the state
FAILING_WINDOWS = 10  # in a row that the numerics could not take: no longer single ones


class Source(Protocol):
    """A live bus."""

    name: str
    connected: bool
    lost: int  # frames dropped by the kernel
    lag: float  # s that the last frame had waited
    reconnects: int
    beat: float  # monotonic s, when its reader last came by; one that hangs does not

    @property
    def trouble(self) -> str:
        """Why it is not connected; empty while it is."""

    @property
    def tally(self) -> Tally:
        """Messages so far, by what became of them."""

    def blocks(self) -> Iterator[SampleBlock]:
        """Samples in the order in which they come."""


class TakesWindows(Protocol):
    """Where windows go: a pipeline, or what an edge has in its place."""

    @property
    def engine(self) -> Engine:
        """The model that they are cut for."""

    def process(
        self, vehicle: str, windows: Sequence[Window], recording_id: str | None = None, priority: Priority = ...
    ) -> object:
        """Take windows in order of time; they are safe when this returns."""


@dataclass(frozen=True, slots=True)
class FeedStatus:
    """How a feed does."""

    name: str
    vehicle: str
    state: str  # receiving, silent, behind, down, failing, hung, ended
    detail: str  # one line; empty while all is well
    lag_seconds: float  # that the last frame had waited
    waiting_windows: int
    dropped_windows: int  # given up because the queue was full
    failed_windows: int  # that the numerics could not take
    lost_frames: int  # dropped by the kernel
    restarts: int  # of the bus, the reader or the writer

    @property
    def works(self) -> bool:
        """Whether samples are received and kept; a silent bus may belong to a parked train."""
        return self.state in ("receiving", "silent", "behind")


class LiveFeed:
    """Feeds one source.  `start` it once; it ends when `stopping` is set and what was received is stored."""

    def __init__(
        self, pipeline: TakesWindows, source: Source, vehicle: str, stopping: threading.Event, on_tally: OnTally
    ) -> None:
        self.source = source
        self.vehicle = vehicle
        self._pipeline = pipeline
        self._stopping = stopping
        self._on_tally = on_tally
        self._waiting: deque[Window] = deque()
        self._changed = threading.Condition()
        self._turn = 0  # of the reader; one that was given up for hung sees that it is no longer his
        self._reading = self._thread(self._read)
        self._keeping = self._thread(self._keep)
        self._watching = self._thread(self._watch)
        self._trouble = ""  # why the reader failed
        self._refused = ""  # why nothing can be kept at the moment
        self._hung = False
        self._begun = 0.0  # monotonic s, when the reader in place of one that hung was started
        self._ended = False
        self._last_block = self._dropped_at = -1e9  # monotonic s
        self._dropped = self._failed = self._restarts = 0
        self._failed_in_a_row, self._failure = 0, ""

    def start(self) -> None:
        """Begin."""
        self.source.beat = time.monotonic()  # it may have been made long ago
        for thread in (self._reading, self._keeping, self._watching):
            thread.start()

    def join(self, seconds: float) -> bool:
        """Wait for the end after `stopping` was set; whether it came."""
        deadline = time.monotonic() + seconds
        with self._changed:
            self._changed.notify_all()
        for thread in (self._watching, self._reading, self._keeping):
            thread.join(max(0.0, deadline - time.monotonic()))
        return not self._keeping.is_alive()

    def status(self) -> FeedStatus:
        """How it does now."""
        state, detail = self._state(time.monotonic())
        return FeedStatus(
            self.source.name,
            self.vehicle,
            state,
            detail,
            round(self.source.lag, 3),
            len(self._waiting),
            self._dropped,
            self._failed,
            self.source.lost,
            self._restarts + self.source.reconnects,
        )

    def _state(self, now: float) -> tuple[str, str]:
        if self._refused:
            return "failing", f"windows cannot be stored: {self._refused}; {len(self._waiting)} wait"
        if self._failed_in_a_row >= FAILING_WINDOWS:
            return "failing", f"the last {self._failed_in_a_row} windows could not be identified: {self._failure}"
        if self._hung:
            return "hung", f"the reader gave no sign for {HUNG_SECONDS:.0f} s; another one was started"
        if self._trouble:
            return "down", self._trouble
        if self._ended:
            return "ended", "the source has ended"
        if not self.source.connected:
            return "down", self.source.trouble or "the bus is not open yet"
        if now - self._dropped_at < LATELY_SECONDS:
            return "behind", f"{self._dropped} windows were given up since the start"
        if self.source.lag > BEHIND_SECONDS:
            return "behind", f"frames wait {self.source.lag:.0f} s"
        if now - self._last_block > SILENT_SECONDS:
            return "silent", "no frame that the system file names has come lately"
        return "receiving", ""

    def _thread(self, target: Callable[[], None]) -> threading.Thread:
        return threading.Thread(target=target, name=f"sprung-{target.__name__.strip('_')}", daemon=True)

    def _read(self) -> None:
        """Source -> windows, begun again after whatever went wrong."""
        turn, retry = self._turn, FIRST_RETRY
        while not self._stopping.is_set() and turn == self._turn:
            system = self._pipeline.engine.system
            windower, beside = windower_of(system), AuxiliaryMeans(len(system.channels), len(system.auxiliary))
            try:
                for block in self.source.blocks():
                    if self._stopping.is_set() or turn != self._turn:
                        return
                    self._last_block, retry = time.monotonic(), FIRST_RETRY
                    self._trouble, self._hung = "", False
                    for window in windower.push(beside.keep(block)):
                        self._offer(beside.to(window))
                    self._on_tally(self.source.tally)
                for window in windower.flush():
                    self._offer(beside.to(window))
                self._on_tally(self.source.tally)
                self._ended = True
                return
            except Exception as error:
                self._restarts += 1
                self._trouble = f"{first_line(error)}; trying again in {retry:.1f} s"
                log.exception("the feed of %s failed; trying again in %.1f s", self.source.name, retry)
                self._stopping.wait(retry)
                retry = min(2.0 * retry, LAST_RETRY)

    def _offer(self, window: Window) -> None:
        with self._changed:
            self._waiting.append(window)
            if len(self._waiting) > WAITING_WINDOWS:
                self._waiting.popleft()  # the oldest: what is happening now matters more
                if time.monotonic() - self._dropped_at > LATELY_SECONDS:
                    log.error(
                        "%s: windows come faster than they can be stored; the oldest are given up", self.source.name
                    )
                self._dropped += 1
                self._dropped_at = time.monotonic()
            self._changed.notify_all()

    def _take(self) -> list[Window]:
        """Windows to store next; none when the feed is over."""
        with self._changed:
            while not self._waiting:
                if self._stopping.is_set() and not self._reading.is_alive():
                    return []
                self._changed.wait(0.2)
            return [self._waiting.popleft() for _ in range(min(TOGETHER, len(self._waiting)))]

    def _keep(self) -> None:
        """Windows -> store, each as often as it takes."""
        while windows := self._take():
            self._store(windows)

    def _store(self, windows: list[Window]) -> None:
        retry = FIRST_RETRY
        while True:
            try:
                self._pipeline.process(self.vehicle, windows, None, Priority.LIVE)
                self._refused, self._failed_in_a_row = "", 0
                return
            except Exception as error:
                if not is_transient(error):
                    self._leave_out(windows, error)
                    return
                if not self._refused:
                    log.error("%s: windows cannot be stored (%s); trying again", self.source.name, first_line(error))
                self._refused = first_line(error)
                if self._stopping.wait(retry):
                    return  # said above; the service may not wait for a store that is gone
                retry = min(2.0 * retry, LAST_RETRY)

    def _leave_out(self, windows: list[Window], error: Exception) -> None:
        """Count the window that the numerics cannot take; of several, find out which."""
        if len(windows) > 1:
            for window in windows:
                self._store([window])
            return
        self._failed += 1
        self._failed_in_a_row += 1
        self._failure = first_line(error)
        log.error("%s: a window could not be identified and is left out", self.source.name, exc_info=error)

    def _watch(self) -> None:
        """Start the reader or the writer anew when it has died or hangs; again, where there is no thread for it."""
        while not self._stopping.wait(WATCH_SECONDS):
            try:
                self._look()
            except Exception as error:
                log.error("%s: what has ended could not be started anew (%s)", self.source.name, first_line(error))

    def _look(self) -> None:
        if not self._keeping.is_alive():
            self._restarts += 1
            self._keeping = self._thread(self._keep)
            self._keeping.start()
        beat = self.source.beat
        if self._ended or (self._reading.is_alive() and time.monotonic() - beat < HUNG_SECONDS):
            self._hung = self._hung and beat <= self._begun  # until the one that was started gives a sign
            return
        log.error("the reader of %s gives no sign; another one is started", self.source.name)
        self._restarts += 1
        self._hung = True
        self._turn += 1
        self._begun = time.monotonic()
        self.source.beat = self._begun
        self._reading = self._thread(self._read)
        self._reading.start()

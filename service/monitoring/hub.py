"""What happens, told at once to everybody who listens: pages that follow a vehicle, notifications."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass

from cachetools import LRUCache

from sprung.service.errors import Busy, TooManyOfOne
from sprung.service.monitoring.processed import Batch

MOST_LISTENERS = 200
MOST_OF_ONE = 40  # listeners of one client: a wall of screens, or an office behind one address
RETRY_SECONDS = 30  # after which one that found no place may look again
MOST_WAITING = 1000  # vehicles with news that a slow listener has not fetched; older ones are forgotten


@dataclass(frozen=True, slots=True)
class VehicleNews:
    """A vehicle has new windows, or something about it was changed."""

    vehicle: str
    window: int | None  # start of its newest window, ns since epoch
    active: int  # alarms


class Listener:
    """Holds the newest news of every vehicle until they are taken."""

    def __init__(self, vehicle: str | None, wake: Callable[[], None], client: str = "") -> None:
        self.client = client
        self.ended = False  # given up for another one
        self._vehicle = vehicle
        self._wake = wake
        self._news: LRUCache[str, VehicleNews] = LRUCache(MOST_WAITING)
        self._lock = threading.Lock()

    def put(self, news: VehicleNews) -> None:
        """Take news, unless they are about another vehicle."""
        if self._vehicle not in (None, news.vehicle):
            return
        with self._lock:
            self._news[news.vehicle] = news
        self._wake()

    def end(self) -> None:
        """Give it up."""
        self.ended = True
        self._wake()

    def take(self) -> list[VehicleNews]:
        """Everything new, oldest first."""
        with self._lock:
            found = list(self._news.values())
            self._news.clear()
        return found


class Hub:
    """Passes news on; never waits for a listener."""

    def __init__(self) -> None:
        self._listeners: dict[Listener, None] = {}  # the oldest first
        self._lock = threading.Lock()

    def on_batch(self, batch: Batch) -> None:
        """Tell that a vehicle has changed."""
        news = VehicleNews(batch.vehicle, batch.state.time, len(batch.state.active))
        with self._lock:
            listeners = list(self._listeners)
        for listener in listeners:
            listener.put(news)

    def listen(self, vehicle: str | None, wake: Callable[[], None], client: str = "") -> Listener:
        """Listen to one vehicle, or to all; `wake` is called from other threads.

        When there are too many, the client that has most gives its oldest up for one that has fewer.  Raises
        TooManyOfOne when the client has too many itself, and Busy when nobody has more than it would have.
        """
        listener = Listener(vehicle, wake, client)
        with self._lock:
            clients = Counter(one.client for one in self._listeners)
            if clients[client] >= MOST_OF_ONE:
                raise TooManyOfOne(f"{MOST_OF_ONE} pages are followed already by one client; close some", RETRY_SECONDS)
            if len(self._listeners) >= MOST_LISTENERS:
                greedy, most = clients.most_common(1)[0]
                if most <= clients[client] + 1:
                    raise Busy(f"{MOST_LISTENERS} pages are followed already; reload later", RETRY_SECONDS)
                oldest = next(one for one in self._listeners if one.client == greedy)
                del self._listeners[oldest]
                oldest.end()
            self._listeners[listener] = None
        return listener

    def leave(self, listener: Listener) -> None:
        """Stop listening."""
        with self._lock:
            self._listeners.pop(listener, None)

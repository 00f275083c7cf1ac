"""How many connections there may be, whose, and which of them are given up for others.

uvicorn bounds neither the number of connections nor the time that a request may take to arrive: a thousand clients
that send half of one, or that ask for much and take nothing of it, would hold the service for ever.
"""

from __future__ import annotations

import asyncio
import ipaddress
import time
from collections import Counter
from collections.abc import Iterable
from typing import Protocol

from cachetools import LRUCache

from sprung.service.settings import Settings

LOOK_SECONDS = 1.0
RESERVED_DESCRIPTORS = 128  # for the store, uploads and workers
MOST_LINGERING = 64  # refused connections that still get an answer; not counted in the limits
BURST_SECONDS = 2.0  # of the permitted rate of broken-off requests that may come at once
MOST_CLIENTS = 10_000  # whose broken-off requests are remembered
MOST_UNSENT_BYTES = 200_000_000  # of answers that clients have not taken, of all together
# why connections are closed that their clients did not end
NO_ROOM, BROKEN_OFF = "refused: no room", "refused: too many broken off"
GIVEN_UP, TOO_SLOW, UNREAD = "given up for another", "too slow", "answers not taken"
CAUSES = (NO_ROOM, BROKEN_OFF, GIVEN_UP, TOO_SLOW, UNREAD)


class Connection(Protocol):
    """What is known of a connection."""

    host: str
    active: float  # when something came, by time.monotonic

    @property
    def waiting(self) -> bool:
        """Whether nothing is being done for it."""

    @property
    def unsent(self) -> int:
        """Bytes of answers that its client has not taken."""

    def too_slow(self, now: float) -> bool:
        """Whether it has been waited for for long enough; to be asked now and then."""

    def end(self) -> None:
        """Close it now."""


class Doorkeeper:
    """Connections of one server.

    When there are too many, the client that holds most of them gives one up for one that holds fewer: first what only
    waits, and longest.  Who holds connections open loses them, and nobody else notices.  A client that begins many
    requests and breaks them off is not let in for a while: each costs as much as one that is answered.
    """

    def __init__(self, settings: Settings) -> None:
        self.header_seconds = settings.header_seconds
        self.body_idle_seconds = settings.body_idle_seconds
        self._most = min(settings.connections, max(16, _descriptors() - RESERVED_DESCRIPTORS))
        self._most_each = settings.client_connections
        self._broken = LeakyBuckets(settings.client_broken_per_second)
        self._proxies = [ipaddress.ip_network(proxy) for proxy in settings.trusted_proxies]
        self._open: dict[Connection, None] = {}
        self._clients: Counter[str] = Counter()
        self.lingering = 0
        self.closed = dict.fromkeys(CAUSES, 0)

    def __len__(self) -> int:
        return len(self._open)

    def admit(self, new: Connection) -> bool:
        """Whether there is room for a connection; closes another one for it where it can."""
        if self._broken.full(new.host):
            self.closed[BROKEN_OFF] += 1
            return False
        if self._clients[new.host] >= self._most_each or len(self._open) >= self._most:
            yielding = self._yielding(new.host)
            if yielding is None:
                self.closed[NO_ROOM] += 1
                return False
            self._evict(yielding, GIVEN_UP)
        self._open[new] = None
        self._clients[new.host] += 1
        return True

    def leave(self, gone: Connection) -> None:
        """Forget a connection."""
        if gone in self._open:
            del self._open[gone]
            self._clients[gone.host] -= 1
            if not self._clients[gone.host]:
                del self._clients[gone.host]

    def broke_off(self, gone: Connection) -> None:
        """A client has gone, or was given up, before its request had come whole.

        What comes through a proxy is not the proxy's fault, nor that of one whose connection was wanted for others.
        """
        if gone in self._open and not self._is_proxy(gone.host):
            self._broken.add(gone.host)

    def lighten(self) -> None:
        """Close connections with the most that waits to be taken until all of it together is bearable."""
        waiting = {connection: size for connection in self._open if (size := connection.unsent)}
        total = sum(waiting.values())
        while total > MOST_UNSENT_BYTES:
            heaviest = max(waiting, key=waiting.__getitem__)
            total -= waiting.pop(heaviest)
            self._evict(heaviest, UNREAD)

    async def watch(self) -> None:
        """Close connections whose requests do not arrive, or whose answers are not taken; runs as long as the
        server."""
        while True:
            await asyncio.sleep(LOOK_SECONDS)
            now = time.monotonic()
            for connection in list(self._open):
                if connection.too_slow(now):
                    self.closed[TOO_SLOW] += 1
                    connection.end()

    def _is_proxy(self, host: str) -> bool:
        try:
            address = ipaddress.ip_address(host)
        except ValueError:
            return False
        return any(address in proxy for proxy in self._proxies)

    def _yielding(self, host: str) -> Connection | None:
        """The connection that is closed for a new one of a client; None where all are as worthy."""
        mine = self._clients[host]
        if mine >= self._most_each:
            return _longest_waiting(self._of(host))
        greedy, most = self._clients.most_common(1)[0]
        if most <= mine + 1:
            return _longest_waiting(self._open)
        theirs = self._of(greedy)
        return _longest_waiting(theirs) or theirs[0]

    def _of(self, host: str) -> list[Connection]:
        return [connection for connection in self._open if connection.host == host]

    def _evict(self, connection: Connection, cause: str) -> None:
        self.closed[cause] += 1
        connection.end()
        self.leave(connection)


class LeakyBuckets:
    """Events by client, of which `rate` a second are forgotten; for one thread."""

    def __init__(self, rate: float) -> None:
        self._rate = rate
        self._levels: LRUCache[str, tuple[float, float]] = LRUCache(MOST_CLIENTS)  # events and when, by time.monotonic

    def add(self, client: str) -> None:
        """One more."""
        self._levels[client] = (self._level(client) + 1.0, time.monotonic())

    def full(self, client: str) -> bool:
        """Whether there were more lately than are permitted."""
        return self._level(client) >= max(1.0, BURST_SECONDS * self._rate)

    def _level(self, client: str) -> float:
        level, at = self._levels.get(client, (0.0, 0.0))
        return max(0.0, level - (time.monotonic() - at) * self._rate)


def _longest_waiting(connections: Iterable[Connection]) -> Connection | None:
    return min((c for c in connections if c.waiting), key=lambda c: c.active, default=None)


def _descriptors() -> int:
    """How many files may be open; as many as the system lets this process have."""
    try:
        import resource
    except ImportError:
        return 1 << 16
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = hard if hard != resource.RLIM_INFINITY else 1 << 16
    if soft < wanted:
        try:
            resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))
            return wanted
        except (ValueError, OSError):
            return soft
    return soft

"""The server before the application: how many connections there may be, and how long a client may take.

uvicorn bounds neither the number of connections nor the time that a request may take to arrive: a thousand clients
that send half of one would hold the service for ever.
"""

from __future__ import annotations

import asyncio
import logging
import ssl
import time
from collections import Counter
from collections.abc import Callable
from types import FrameType
from typing import Any

import h11
import uvicorn
from fastapi import FastAPI
from uvicorn.protocols.http.h11_impl import H11Protocol

from sprung.service.settings import Settings

log = logging.getLogger("sprung.server")
LOOK_SECONDS = 1.0
RATE_AFTER_SECONDS = 10.0  # from then on a body must have come at the lowest rate, on the average
LOWEST_RATE = 1000.0  # bytes a second
UNREAD_SECONDS = 60.0  # an answer may wait for the client to take what asyncio holds of it, some 64 kB
STALLED_SECONDS = 2.0  # from then on a client that does not take its answer is one that only waits
RESERVED_DESCRIPTORS = 128  # for the store, uploads and workers

REFUSED = (
    b"HTTP/1.1 503 Service Unavailable\r\nconnection: close\r\nretry-after: 2\r\n"
    b"content-type: application/problem+json\r\ncontent-length: %d\r\n\r\n"
)
REFUSED_BODY = (
    b'{"type": "about:blank", "title": "Service Unavailable", "status": 503, "detail": "too many connections are open"}'
)


class Doorkeeper:
    """Connections of one server: how many there are, whose, and which of them only wait.

    When there are too many, the one that has waited longest without a whole request is closed for the new one: who
    holds connections open loses them, and nobody else notices.
    """

    def __init__(self, settings: Settings) -> None:
        self.header_seconds = settings.header_seconds
        self.body_idle_seconds = settings.body_idle_seconds
        self._most = min(settings.connections, max(16, _descriptors() - RESERVED_DESCRIPTORS))
        self._most_each = settings.client_connections
        self._open: dict[GuardedProtocol, None] = {}
        self._clients: Counter[str] = Counter()
        self.evicted = 0
        self.refused = 0

    def __len__(self) -> int:
        return len(self._open)

    def admit(self, new: GuardedProtocol) -> bool:
        """Whether there is room for a connection; closes another one for it where it can."""
        mine = self._clients[new.host] >= self._most_each
        if mine or len(self._open) >= self._most:
            others = (p for p in self._open if p.waiting and (p.host == new.host or not mine))
            idle = min(others, key=lambda p: p.active, default=None)
            if idle is None:
                self.refused += 1
                return False
            self.evicted += 1
            idle.end()
            self.leave(idle)
        self._open[new] = None
        self._clients[new.host] += 1
        return True

    def leave(self, gone: GuardedProtocol) -> None:
        """Forget a connection."""
        if self._open.pop(gone, self) is None:
            self._clients[gone.host] -= 1
            if not self._clients[gone.host]:
                del self._clients[gone.host]

    async def watch(self) -> None:
        """Close connections whose requests do not arrive; runs as long as the server."""
        while True:
            await asyncio.sleep(LOOK_SECONDS)
            now = time.monotonic()
            for protocol in list(self._open):
                if protocol.too_slow(now):
                    protocol.end()


class GuardedProtocol(H11Protocol):
    """uvicorn's HTTP/1.1, admitted by a doorkeeper."""

    doorkeeper: Doorkeeper

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """A client connects."""
        super().connection_made(transport)
        self.host = self.client[0] if self.client else ""
        self.active = self._begun = time.monotonic()  # when something came; when the request that is awaited began
        self._received = 0
        self._full: float | None = None  # since when the client has not taken what was written for it
        self._unsent, self._moved = 0, self.active  # bytes that waited when it was last looked at, and since when
        self._admitted = self.doorkeeper.admit(self)
        if not self._admitted:
            transport.write(REFUSED % len(REFUSED_BODY) + REFUSED_BODY)
            transport.close()

    def connection_lost(self, exc: Exception | None) -> None:
        """A client has gone."""
        self.doorkeeper.leave(self)
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """A client sends."""
        if not self._admitted:
            return
        now = time.monotonic()
        if self._at_rest:
            self._begun, self._received = now, 0
        self.active = now
        self._received += len(data)
        super().data_received(data)

    def pause_writing(self) -> None:
        """More waits to be sent than is sensible."""
        self._full = self._moved = time.monotonic()
        super().pause_writing()

    def resume_writing(self) -> None:
        """The client has taken most of it."""
        self._full = None
        super().resume_writing()

    @property
    def waiting(self) -> bool:
        """Nothing is being done for this connection: it idles, its request has not come whole, or its answer is not
        taken."""
        if self._full is not None and time.monotonic() - self._full > STALLED_SECONDS:
            return True
        return self.cycle is None or self.cycle.response_complete or self.cycle.more_body

    @property
    def _at_rest(self) -> bool:
        """Between two requests."""
        return self.conn.their_state is h11.IDLE and not self.conn.trailing_data[0]

    def too_slow(self, now: float) -> bool:
        """Whether a request that has begun does not arrive, or an answer is not taken."""
        if self._full is not None and self._untaken(now, self._full):
            return True
        if not self.waiting:
            return False
        if self.conn.their_state is h11.IDLE:  # no header yet, or none begun: uvicorn ends what has been kept alive
            begun = self._received > 0 or self.cycle is None
            return begun and now - self._begun > self.doorkeeper.header_seconds
        if self.conn.their_state is not h11.SEND_BODY or self.flow.read_paused:
            return False
        if now - self.active > self.doorkeeper.body_idle_seconds:
            return True
        took = now - self._begun
        return took > RATE_AFTER_SECONDS and self._received < LOWEST_RATE * took

    def _untaken(self, now: float, since: float) -> bool:
        """Whether the client takes nothing of its answer, or too little; to be asked now and then."""
        unsent = self.transport.get_write_buffer_size()
        if unsent != self._unsent:
            self._unsent, self._moved = unsent, now
        return now - self._moved > self.doorkeeper.body_idle_seconds or now - since > UNREAD_SECONDS

    def on_response_complete(self) -> None:
        """uvicorn goes on to the next request."""
        self._begun, self._received = time.monotonic(), 0
        super().on_response_complete()

    def end(self) -> None:
        """Close now, also where it is closing and would wait for the client to take the rest."""
        self.transport.abort()


class Server(uvicorn.Server):
    """uvicorn, with a doorkeeper, that tells of a signal at once."""

    def __init__(self, config: uvicorn.Config, doorkeeper: Doorkeeper, on_exit: Callable[[], None]) -> None:
        super().__init__(config)
        self.doorkeeper = doorkeeper
        self._on_exit = on_exit

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        """A signal: streams must end, or the server would wait for them."""
        self._on_exit()
        super().handle_exit(sig, frame)

    async def startup(self, sockets: list[Any] | None = None) -> None:
        """Begin to watch with the first connection."""
        await super().startup(sockets)
        self._watching = asyncio.create_task(self.doorkeeper.watch())


def make_server(app: FastAPI, settings: Settings, on_exit: Callable[[], None]) -> Server:
    """A server of the application; raises OSError or ssl.SSLError for certificates that cannot be used."""
    doorkeeper = Doorkeeper(settings)
    protocol = type("Protocol", (GuardedProtocol,), {"doorkeeper": doorkeeper})
    config = uvicorn.Config(
        app,
        http=protocol,
        ws="none",
        log_level="warning",
        log_config=None,
        access_log=False,
        server_header=False,
        # uvicorn would believe whoever connects from this machine, also where there is no proxy
        proxy_headers=bool(settings.trusted_proxies),
        forwarded_allow_ips=list(settings.trusted_proxies),
        timeout_graceful_shutdown=settings.shutdown_seconds,
        timeout_keep_alive=30,
        h11_max_incomplete_event_size=64_000,
        lifespan="on",
        **_tls(settings),
    )
    config.load()
    return Server(config, doorkeeper, on_exit)


def _tls(settings: Settings) -> dict[str, Any]:
    if settings.tls_certificate is None:
        return {}
    options: dict[str, Any] = {
        "ssl_certfile": str(settings.tls_certificate),
        "ssl_keyfile": None if settings.tls_key is None else str(settings.tls_key),
    }
    if settings.tls_client_ca is not None:
        options |= {"ssl_ca_certs": str(settings.tls_client_ca), "ssl_cert_reqs": ssl.CERT_REQUIRED}
    return options


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

"""The server before the application: uvicorn, whose connections are admitted and watched by a doorkeeper."""

from __future__ import annotations

import asyncio
import logging
import socket
import ssl
import struct
import time
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from types import FrameType
from typing import Any

import h11
import uvicorn
from fastapi import FastAPI
from uvicorn.protocols.http.h11_impl import H11Protocol

from sprung.service.api.clients import client_of
from sprung.service.api.doorkeeper import MOST_LINGERING, Doorkeeper
from sprung.service.settings import Settings

log = logging.getLogger("sprung.server")
RATE_AFTER_SECONDS = 10.0  # from then on a body must have come at the lowest rate, on the average
LOWEST_RATE = 1000.0  # bytes a second
UNREAD_SECONDS = 60.0  # an answer may wait for the client to take what asyncio holds of it, some 64 kB
STALLED_SECONDS = 2.0  # from then on a client that does not take its answer is one that only waits
LINGER_SECONDS = 1.0  # that a refused client has to read why: closed at once, it would hear of a reset instead
REST_SECONDS = 30.0  # for the rest of a body that nobody wants any more; many clients read only when they have sent all
READ_BYTES = 1 << 16  # that are read at once: so little is found in a heap that may not grow any more
KERNEL_BYTES = 1 << 17  # of an answer that the kernel may hold for a client that takes nothing; else it is megabytes

REFUSED = (
    b"HTTP/1.1 503 Service Unavailable\r\nconnection: close\r\nretry-after: 2\r\n"
    b"content-type: application/problem+json\r\ncontent-length: %d\r\n\r\n"
)
REFUSED_BODY = (
    b'{"type": "about:blank", "title": "Service Unavailable", "status": 503, "detail": "too many connections are open"}'
)


NO_HTTP_BODY = (
    b'{"type": "about:blank", "title": "Bad Request", "status": 400, "detail": "what came is no request in HTTP/1.1"}'
)


class LingeringTransport:
    """A transport that closes when its client has sent what it is sending: the kernel resets a connection that is
    closed on bytes which nobody has read, and with it the answer gets lost."""

    def __init__(self, transport: asyncio.Transport, close: Callable[[], None]) -> None:
        """close: called instead of the transport's own."""
        self.transport = transport
        self.close = close
        self.closing = False

    def __getattr__(self, name: str) -> Any:
        return getattr(self.transport, name)

    def is_closing(self) -> bool:
        """Whether nothing is to be written any more."""
        return self.closing or self.transport.is_closing()


class GuardedProtocol(H11Protocol):
    """uvicorn's HTTP/1.1, admitted by a doorkeeper."""

    doorkeeper: Doorkeeper
    transport: LingeringTransport  # type: ignore[assignment]  # that is all uvicorn asks of it
    _lingers: asyncio.TimerHandle | None = None  # of one that is passed over: when it is closed all the same

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]  # as in uvicorn
        """A client connects."""
        super().connection_made(transport)
        self.transport = LingeringTransport(transport, self._close)
        self.host = client_of(self.client[0] if self.client else "")
        self.active = self._begun = time.monotonic()  # when something came; when the request that is awaited began
        self._received = 0
        self._full: float | None = None  # since when the client has not read its answer
        self._unsent, self._moved = 0, self.active  # bytes that waited when it was last looked at, and since when
        _hold_little(transport)
        transport.max_size = READ_BYTES  # type: ignore[attr-defined]  # of asyncio's own, which takes 256 kB
        self._admitted = self.doorkeeper.admit(self)
        if not self._admitted:
            self._refuse()

    def connection_lost(self, exc: Exception | None) -> None:
        """A client has gone."""
        if self._half_sent:
            self.doorkeeper.broke_off(self)
        self.doorkeeper.leave(self)
        if self._lingers is not None:
            self._lingers.cancel()
            self._lingers = None
            self.doorkeeper.lingering -= 1
        super().connection_lost(exc)
        self.transport.close = self.transport.transport.close  # no circle: what was held of a body goes at once

    def data_received(self, data: bytes) -> None:
        """A client sends."""
        if not self._admitted:
            return
        now = time.monotonic()
        if self._at_rest:
            self._begun, self._received = now, 0
        self.active = now
        self._received += len(data)
        if self._lingers is None:
            super().data_received(data)

    def _refuse(self) -> None:
        """Say that there is no room, and why; what else comes is passed over until the client has read that."""
        self.transport.write(REFUSED % len(REFUSED_BODY) + REFUSED_BODY)
        self._linger(LINGER_SECONDS)

    def _close(self) -> None:
        """Nothing more is answered; of a client in the midst of a body the rest is passed over before."""
        if self.conn.their_state in (h11.SEND_BODY, h11.ERROR) and self._lingers is None:
            self._linger(REST_SECONDS)
        else:
            self.transport.transport.close()

    def _linger(self, seconds: float) -> None:
        """Pass over what comes until the client closes, at most for so long."""
        transport = self.transport.transport
        if self.doorkeeper.lingering >= MOST_LINGERING or transport.is_closing():
            transport.close()
            return
        self.transport.closing = True
        self.doorkeeper.lingering += 1
        self._lingers = self.loop.call_later(seconds, transport.abort)
        if transport.can_write_eof():
            transport.write_eof()
        self.flow.resume_reading()

    def send_400_response(self, msg: str) -> None:
        """Answer malformed HTTP as problem+json, and close.

        Where it is the body of a request that the application is at work on, what it answers goes nowhere.
        """
        if self.cycle is not None and not self.cycle.response_complete:
            self.cycle.disconnected = True
            self.cycle.message_event.set()
        if self.conn.our_state not in (h11.IDLE, h11.SEND_RESPONSE):  # it has begun to answer
            self.transport.close()
            return
        headers = [
            (b"content-type", b"application/problem+json"),
            (b"content-length", b"%d" % len(NO_HTTP_BODY)),
            (b"x-content-type-options", b"nosniff"),
            (b"connection", b"close"),
        ]
        for event in (h11.Response(status_code=400, headers=headers), h11.Data(NO_HTTP_BODY), h11.EndOfMessage()):
            self.transport.write(self.conn.send(event) or b"")
        self.transport.close()

    def pause_writing(self) -> None:
        """More waits to be sent than is sensible."""
        self._full = self._moved = time.monotonic()
        super().pause_writing()
        self.doorkeeper.lighten()

    def resume_writing(self) -> None:
        """The client has taken most of it."""
        self._full, self._moved = None, time.monotonic()
        super().resume_writing()

    @property
    def waiting(self) -> bool:
        """Nothing is being done for this connection: it idles, its request has not come whole, or its answer is not
        taken."""
        if self._full is not None and time.monotonic() - self._full > STALLED_SECONDS:
            return True
        return self.cycle is None or self.cycle.response_complete or self.cycle.more_body

    @property
    def unsent(self) -> int:
        """Bytes of answers that the client has not read, without those in the kernel's buffer."""
        return self.transport.transport.get_write_buffer_size()

    @property
    def _at_rest(self) -> bool:
        """Between two requests."""
        return self.conn.their_state is h11.IDLE and not self.conn.trailing_data[0]

    @property
    def _half_sent(self) -> bool:
        """In the header or body of a request."""
        state = self.conn.their_state
        return state is h11.SEND_BODY or (state is h11.IDLE and bool(self.conn.trailing_data[0]))

    def too_slow(self, now: float) -> bool:
        """Whether a request that has begun does not arrive, or an answer is not taken."""
        if self._untaken(now):
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
        if self.cycle is not None and self.cycle.response_complete and took > REST_SECONDS:  # since the answer
            return True
        return took > RATE_AFTER_SECONDS and self._received < LOWEST_RATE * took

    def _untaken(self, now: float) -> bool:
        """Whether the client takes nothing of its answer, or too little."""
        unsent = self.unsent
        if unsent == 0 or unsent < self._unsent:
            self._moved = now
        self._unsent = unsent
        full = self._full is not None and now - self._full > UNREAD_SECONDS
        return full or now - self._moved > self.doorkeeper.body_idle_seconds

    def on_response_complete(self) -> None:
        """uvicorn goes on to the next request."""
        self._begun, self._received = time.monotonic(), 0
        super().on_response_complete()

    def end(self) -> None:
        """Close now, also where it is closing and would wait for the client to take the rest."""
        connection = self.transport.get_extra_info("socket")
        if connection is not None and self.unsent:  # else the kernel would keep unread data
            with suppress(OSError):
                connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        self.transport.abort()


class Server(uvicorn.Server):
    """uvicorn with a doorkeeper and immediate notice of signals."""

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
        if self.config.ssl is not None:
            loop, seconds = asyncio.get_running_loop(), self.doorkeeper.header_seconds
            in_time = partial(loop.create_server, ssl_handshake_timeout=seconds)
            loop.create_server = in_time  # type: ignore[method-assign]  # uvicorn passes no such option on
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
        log_level="error",  # what strangers send wrong would fill the log
        log_config=None,
        access_log=False,
        server_header=False,
        # uvicorn would trust all local clients, even without a proxy
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


def _hold_little(transport: asyncio.BaseTransport) -> None:
    """Limit the kernel's send buffer, where supported."""
    connection, option = transport.get_extra_info("socket"), getattr(socket, "TCP_NOTSENT_LOWAT", None)
    if connection is not None and option is not None:
        with suppress(OSError):  # no TCP, or gone already
            connection.setsockopt(socket.IPPROTO_TCP, option, KERNEL_BYTES)


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

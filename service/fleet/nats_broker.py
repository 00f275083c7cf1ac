"""NATS JetStream before the service: vehicles store and forward into a stream on disk, which the service consumes."""

from __future__ import annotations

import asyncio
import hashlib
import re
from collections.abc import Awaitable, Sequence
from typing import Any

from sprung.service.errors import UserError
from sprung.service.fleet.broker import AGAIN_SECONDS, TOGETHER, BrokerMessage, NotAcknowledged
from sprung.service.fleet.sending import Answer
from sprung.service.fleet.spool import SpoolEntry

FIRST_ANSWER_SECONDS = 15.0
PUBLISHED_SECONDS = 5.0  # for a message of kB to a server that does not answer
RECONNECT_SECONDS = 0.5  # between attempts of a consumer; there are few
SUBJECT = "sprung.estimates"
STREAM = "SPRUNG"
DURABLE = "sprung-fold"
LEAST_ACK_SECONDS = 2.0  # a transaction takes less


def ack_seconds(late_seconds: float) -> float:
    """After which the server gives a message to somebody else: those after it in time wait for it only so long.

    A consumer that dies with a message in its hands would else leave a message that is stored but not tracked.
    """
    return max(LEAST_ACK_SECONDS, late_seconds / 2)


class NatsDelivery:
    """A message of a JetStream pull consumer."""

    def __init__(self, message: Any) -> None:
        self._message = message

    @property
    def body(self) -> bytes:
        """As it was sent."""
        return bytes(self._message.data)

    async def done(self) -> None:
        """Acknowledge, and wait until the server knows."""
        await _acknowledged(self._message.ack_sync())

    async def again(self) -> None:
        """Ask for it later."""
        await _acknowledged(self._message.nak(delay=AGAIN_SECONDS))


class NatsBroker:
    """NATS JetStream: a stream on disk, a durable consumer that several processes may share."""

    def __init__(self, connection: Any, subscription: Any) -> None:
        self._connection = connection
        self._subscription = subscription

    @classmethod
    async def open(cls, servers: str, ack_seconds: float) -> NatsBroker:
        """Connect, and make stream and consumer, or bring them up to date.  Raises UserError.

        ack_seconds: see the function of that name.
        """
        connection = await _connected(servers)
        from nats.js.api import AckPolicy, ConsumerConfig

        stream = connection.jetstream()
        await _ensure_stream(stream)
        config = ConsumerConfig(
            durable_name=DURABLE,
            filter_subject=f"{SUBJECT}.>",
            ack_policy=AckPolicy.EXPLICIT,
            ack_wait=ack_seconds,
            max_ack_pending=4 * TOGETHER,
        )
        await stream.add_consumer(STREAM, config)
        subscription = await stream.pull_subscribe_bind(DURABLE, STREAM)
        return cls(connection, subscription)

    async def fetch(self, most: int, seconds: float) -> Sequence[BrokerMessage]:
        """What is there; none while the server is away: the client connects again by itself."""
        from nats.errors import Error

        try:
            return [NatsDelivery(one) for one in await self._subscription.fetch(most, timeout=seconds)]
        except (Error, TimeoutError):
            await asyncio.sleep(0.05)
            return []

    async def close(self) -> None:
        """Leave."""
        await self._connection.close()


class NatsLink:
    """An edge's way to NATS instead of HTTP (`--server nats://...`); `Nats-Msg-Id` lets the server drop repetitions."""

    def __init__(self, servers: str, vehicle: str) -> None:
        self._servers = servers
        self._subject = f"{SUBJECT}.{vehicle.replace('.', '_')}"
        self._loop = asyncio.new_event_loop()
        self._connection: Any = None
        self._stream: Any = None
        self._lost = asyncio.Event()  # the connection

    def send(self, entry: SpoolEntry) -> Answer:
        """Publish and wait until the server has it on disk; raw recordings are for HTTP."""
        if entry.kind != "estimates":
            return Answer(False, refused="raw recordings go over HTTP only")
        try:
            self._loop.run_until_complete(self._publish(entry.body))
        except Exception as error:
            self._leave()
            return Answer(False, trouble=f"{type(error).__name__}: {error}")
        return Answer(True)

    def close(self) -> None:
        """Leave."""
        self._leave()
        self._loop.close()

    def _leave(self) -> None:
        """Close the connection, whatever state it is in; the next message opens another one."""
        connection, self._stream, self._connection = self._connection, None, None
        if connection is not None:
            self._loop.run_until_complete(connection.close())
        left = asyncio.all_tasks(self._loop)
        for task in left:
            task.cancel()
        if left:
            self._loop.run_until_complete(asyncio.gather(*left, return_exceptions=True))

    async def _publish(self, body: bytes) -> None:
        """Raises as soon as the connection is lost: whoever sends makes the pauses."""
        if self._stream is None:
            self._lost = asyncio.Event()
            self._connection = await _connected(self._servers, self._lost)
            self._stream = self._connection.jetstream()
            await _ensure_stream(self._stream)
        headers = {"Nats-Msg-Id": hashlib.sha256(body).hexdigest()}
        publishing = self._stream.publish(self._subject, body, headers=headers, timeout=PUBLISHED_SECONDS)
        ways = [asyncio.ensure_future(publishing), asyncio.ensure_future(self._lost.wait())]
        done, left = await asyncio.wait(ways, return_when=asyncio.FIRST_COMPLETED)
        for one in left:
            one.cancel()
        if ways[0] not in done:
            raise ConnectionResetError("the connection was lost")
        await ways[0]


async def _acknowledged(sending: Awaitable[Any]) -> None:
    """Raises NotAcknowledged where the server does not hear it."""
    from nats.errors import Error

    try:
        await sending
    except (Error, OSError, TimeoutError) as error:
        raise NotAcknowledged(type(error).__name__) from error


async def _connected(servers: str, lost: asyncio.Event | None = None) -> Any:
    """A connection that is made again by itself; with `lost`, one that sets it and ends instead.  Raises UserError."""
    try:
        import nats
        from nats.errors import Error
    except ModuleNotFoundError as error:
        raise UserError("NATS needs nats-py: pip install 'sprung[fleet]'") from error

    refused: list[Exception] = []

    async def heard(error: Exception) -> None:
        """Reconnecting says it; who is not let in hears it once."""
        if isinstance(error, Error) and not refused:
            refused.append(error)

    async def ended() -> None:
        if lost is not None:
            lost.set()

    where = without_password(servers)
    connecting = nats.connect(
        servers,
        allow_reconnect=lost is None,
        max_reconnect_attempts=-1 if lost is None else 1,
        reconnect_time_wait=RECONNECT_SECONDS,
        error_cb=heard,
        closed_cb=ended,
        connect_timeout=5,
    )
    try:  # later it connects again however long it takes; now an address may be wrong
        return await asyncio.wait_for(connecting, FIRST_ANSWER_SECONDS)
    except (Error, OSError) as error:
        reason = str(refused[0]) if refused else type(error).__name__
        raise UserError(f"{where}: no NATS server answers, or it refuses access ({reason})") from error
    except ValueError as error:
        raise UserError(f"{where}: give an address as in nats://USER:PASSWORD@HOST:4222 ({error})") from error


def without_password(address: str) -> str:
    """An address for logs, without its password."""
    return re.sub(r"(?<=://)[^/@]*@", "", address)


async def _ensure_stream(stream: Any) -> None:
    from nats.js.api import StorageType, StreamConfig
    from nats.js.errors import NotFoundError

    try:
        await stream.stream_info(STREAM)
    except NotFoundError:
        config = StreamConfig(
            name=STREAM,
            subjects=[f"{SUBJECT}.>"],
            storage=StorageType.FILE,
            duplicate_window=3600.0,
            max_age=7 * 86_400.0,
        )
        await stream.add_stream(config)

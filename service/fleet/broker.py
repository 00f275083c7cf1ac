"""Messages of estimates from a broker: taken in batches, acknowledged once they are stored.

A broker holds what a vehicle could deliver while the service was away.  The interface is small enough for NATS
JetStream and Kafka alike; the effect of a message does not depend on the number of its deliveries
(`service.fleet.ingest`).
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal, Protocol

from sprung.service.errors import UserError
from sprung.service.fleet.ingest import Ingest
from sprung.service.fleet.message import Message, read_messages
from sprung.service.retrying import is_transient

log = logging.getLogger("sprung.broker")
TOGETHER = 64  # messages of one transaction
WAIT_SECONDS = 1.0
Verdict = Literal["stored", "refused", "again"]
AGAIN_SECONDS = 2.0  # before a message is delivered again that could not be stored


class NotAcknowledged(Exception):
    """The broker was not told what became of a message: it delivers the message again, which changes nothing."""


class BrokerMessage(Protocol):
    """A message that was delivered and not yet acknowledged."""

    @property
    def body(self) -> bytes:
        """As it was sent."""

    async def done(self) -> None:
        """It is stored, or never will be: do not deliver it again.  Raises NotAcknowledged."""

    async def again(self) -> None:
        """Deliver it again, later.  Raises NotAcknowledged."""


class Broker(Protocol):
    """Where messages come from."""

    async def fetch(self, most: int, seconds: float) -> Sequence[BrokerMessage]:
        """What is there, at most `most`; none when nothing comes for so long."""

    async def close(self) -> None:
        """Disconnect; unacknowledged messages are delivered again."""


@dataclass(slots=True)
class ConsumerCounts:
    """What was taken so far."""

    messages: int = 0
    windows: int = 0
    refused: int = 0  # messages that no service of this model will ever take
    again: int = 0


async def consume(
    broker: Broker,
    ingest: Ingest,
    stopping: asyncio.Event,
    counts: ConsumerCounts,
    alive: Callable[[], None] = lambda: None,
) -> None:
    """Consume messages until stopped; `alive` is called every second or so, between transactions."""
    while not stopping.is_set():
        alive()
        deliveries = await broker.fetch(TOGETHER, WAIT_SECONDS)
        if not deliveries:
            continue
        messages: list[Message | None] = [_readable(one) for one in deliveries]
        stored = iter(await _store([one for one in messages if one is not None], ingest))
        verdicts: list[Verdict] = ["refused" if message is None else next(stored) for message in messages]
        for message, verdict in zip(messages, verdicts, strict=True):
            _count(counts, message, verdict)
        try:
            await _acknowledge(deliveries, verdicts)
        except NotAcknowledged as error:  # one wait is enough: the broker delivers the rest again, too
            log.warning("the broker does not take acknowledgements (%s); it delivers some messages again", error)


def _count(counts: ConsumerCounts, message: Message | None, verdict: Verdict) -> None:
    counts.again += verdict == "again"
    counts.refused += verdict == "refused"
    if message is not None and verdict == "stored":
        counts.messages += 1
        counts.windows += len(message.windows)


async def _acknowledge(deliveries: Sequence[BrokerMessage], verdicts: Sequence[Verdict]) -> None:
    """Tell the broker, in order: Kafka's offsets only go on."""
    for delivery, verdict in zip(deliveries, verdicts, strict=True):
        await (delivery.again() if verdict == "again" else delivery.done())


def _readable(delivery: BrokerMessage) -> Message | None:
    try:
        return read_messages([delivery.body])[0]
    except UserError as error:
        log.error("a message is left out: %s", error)
        return None


async def _store(messages: Sequence[Message], ingest: Ingest) -> list[Verdict]:
    """One transaction; when one of them cannot be folded, each by itself."""
    if not messages:
        return []
    try:
        await asyncio.to_thread(ingest.take, messages)
    except UserError as error:
        if len(messages) > 1:
            return [verdict for one in messages for verdict in await _store([one], ingest)]
        log.error("a message is left out: %s", error)
        return ["refused"]
    except Exception as error:
        if is_transient(error):
            log.warning("the store does not take anything (%s); the messages come again", type(error).__name__)
            await asyncio.sleep(AGAIN_SECONDS)
            return ["again"] * len(messages)
        if len(messages) > 1:
            return [verdict for one in messages for verdict in await _store([one], ingest)]
        log.exception("a message is left out")  # delivered again it would end every consumer that it reaches
        return ["refused"]
    return ["stored"] * len(messages)

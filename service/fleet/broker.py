"""Messages of estimates from a broker: taken in batches, acknowledged once they are stored.

A broker holds what a vehicle could deliver while the service was away.  The interface is small enough for NATS
JetStream and Kafka alike; what a message does to the store does not depend on how often it comes
(`service.fleet.ingest`).
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

from sqlalchemy.exc import SQLAlchemyError

from sprung.service.errors import Busy, UserError
from sprung.service.fleet.ingest import Ingest, read_messages
from sprung.service.fleet.message import Message

log = logging.getLogger("sprung.broker")
TOGETHER = 64  # messages of one transaction
WAIT_SECONDS = 1.0
AGAIN_SECONDS = 2.0  # before a message is delivered again that could not be stored


class BrokerMessage(Protocol):
    """A message that was delivered and not yet acknowledged."""

    @property
    def body(self) -> bytes:
        """As it was sent."""

    async def done(self) -> None:
        """It is stored, or never will be: do not deliver it again."""

    async def again(self) -> None:
        """Deliver it again, later."""


class Broker(Protocol):
    """Where messages come from."""

    async def fetch(self, most: int, seconds: float) -> Sequence[BrokerMessage]:
        """What is there, at most `most`; none when nothing comes for so long."""

    async def close(self) -> None:
        """Leave; what was not acknowledged is delivered again, to whoever comes next."""


@dataclass(slots=True)
class ConsumerCounts:
    """What was taken so far."""

    messages: int = 0
    windows: int = 0
    refused: int = 0  # messages that no service of this model will ever take
    again: int = 0


async def consume(broker: Broker, ingest: Ingest, stopping: asyncio.Event, counts: ConsumerCounts) -> None:
    """Take messages until told to stop."""
    while not stopping.is_set():
        deliveries = await broker.fetch(TOGETHER, WAIT_SECONDS)
        if not deliveries:
            continue
        readable: list[tuple[BrokerMessage, Message]] = []
        for one in deliveries:
            try:
                readable.append((one, read_messages([one.body])[0]))
            except UserError as error:
                await _refuse(one, error, counts)
        await _store(readable, ingest, counts)


async def _store(found: Sequence[tuple[BrokerMessage, Message]], ingest: Ingest, counts: ConsumerCounts) -> None:
    """One transaction; when one of them cannot be folded, each by itself."""
    if not found:
        return
    try:
        await asyncio.to_thread(ingest.take, [message for _, message in found])
    except UserError as error:
        if len(found) > 1:
            for one in found:
                await _store([one], ingest, counts)
            return
        await _refuse(found[0][0], error, counts)
    except (SQLAlchemyError, OSError, Busy) as error:
        log.warning("the store does not take anything (%s); the messages come again", type(error).__name__)
        for delivery, _ in found:
            await delivery.again()
        counts.again += len(found)
        await asyncio.sleep(AGAIN_SECONDS)
    else:
        for delivery, message in found:
            await delivery.done()
            counts.messages += 1
            counts.windows += len(message.windows)


async def _refuse(delivery: BrokerMessage, error: Exception, counts: ConsumerCounts) -> None:
    log.error("a message is left out: %s", error)
    counts.refused += 1
    await delivery.done()

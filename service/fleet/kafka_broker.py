"""Kafka before the service, through aiokafka (`pip install aiokafka`): the same interface as NATS has."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any
from urllib.parse import urlsplit

from sprung.service.errors import UserError
from sprung.service.fleet.broker import BrokerMessage, NotAcknowledged


class KafkaBroker:
    """A consumer group.  Offsets are committed up to what is done, partition by partition, never beyond a record that
    is to come again."""

    def __init__(self, consumer: Any, errors: tuple[type[Exception], ...] = ()) -> None:
        """consumer: a started AIOKafkaConsumer with enable_auto_commit=False; errors: that it raises."""
        self.consumer = consumer
        self.errors = errors
        self.again: dict[Any, int] = {}  # by partition: the first record that is to come again

    async def fetch(self, most: int, seconds: float) -> Sequence[BrokerMessage]:
        """What is there, records that are to come again first."""
        for place, offset in self.again.items():
            self.consumer.seek(place, offset)
        self.again.clear()
        found = await self.consumer.getmany(timeout_ms=round(1000 * seconds), max_records=most)
        return [KafkaDelivery(self, place, one) for place, records in found.items() for one in records]

    async def close(self) -> None:
        """Leave the group."""
        await self.consumer.stop()


class KafkaDelivery:
    """A record of a partition."""

    def __init__(self, broker: KafkaBroker, place: Any, record: Any) -> None:
        self._broker = broker
        self._place = place
        self._record = record

    @property
    def body(self) -> bytes:
        """As it was sent."""
        return bytes(self._record.value)

    async def done(self) -> None:
        """Go on behind it, unless a record before it is to come again: then this one comes again, too."""
        if self._record.offset < self._broker.again.get(self._place, self._record.offset + 1):
            try:
                await self._broker.consumer.commit({self._place: self._record.offset + 1})
            except self._broker.errors as error:
                raise NotAcknowledged(type(error).__name__) from error

    async def again(self) -> None:
        """Read on from it."""
        known = self._broker.again.get(self._place, self._record.offset)
        self._broker.again[self._place] = min(known, self._record.offset)


async def open_kafka(address: str) -> KafkaBroker:
    """The consumer group `sprung-fold` of a topic, kafka://HOST:PORT/TOPIC.  Raises UserError."""
    parts = urlsplit(address)
    if not parts.hostname:
        raise UserError(f"{address}: give an address as in kafka://HOST:9092/TOPIC")
    try:
        from aiokafka import AIOKafkaConsumer
        from aiokafka.errors import KafkaError
    except ModuleNotFoundError as error:
        raise UserError("Kafka needs aiokafka: pip install 'sprung[kafka]'") from error
    consumer = AIOKafkaConsumer(
        parts.path.strip("/") or "sprung.estimates",
        bootstrap_servers=parts.netloc,
        group_id="sprung-fold",
        enable_auto_commit=False,
        auto_offset_reset="earliest",
    )
    try:
        await consumer.start()
    except (KafkaError, OSError) as error:
        raise UserError(f"{address}: no Kafka broker answers ({type(error).__name__})") from error
    return KafkaBroker(consumer, (KafkaError,))

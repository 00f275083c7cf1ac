"""Brokers: acknowledged after the commit, delivered again without one; NATS with its server, Kafka with a fake."""

from __future__ import annotations

import asyncio
import shutil
import socket
import subprocess
import time
from collections.abc import Awaitable, Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sqlalchemy.exc import OperationalError

from sprung.model.system import System
from sprung.service.errors import UserError
from sprung.service.fleet import broker as module
from sprung.service.fleet.broker import Broker, BrokerMessage, ConsumerCounts, consume
from sprung.service.fleet.ingest import Ingest
from sprung.service.fleet.kafka_broker import KafkaBroker
from sprung.service.fleet.message import encode, read_messages
from sprung.service.fleet.nats_broker import NatsBroker, NatsLink, ack_seconds
from sprung.service.fleet.spool import SpoolEntry
from sprung.service.monitoring.engine import Engine
from sprung.service.monitoring.pipeline import Pipeline
from tests.service.fleet.test_ingest import Clock, messages


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "AGAIN_SECONDS", 0.01)
    monkeypatch.setattr(module, "WAIT_SECONDS", 0.2)


@pytest.fixture
def bodies(engine: Engine, system: System) -> list[bytes]:
    return [encode(message, "exact") for message in messages(engine, system, 40, 10)]


@dataclass
class FakeRecord:
    """As Kafka gives it."""

    offset: int
    value: bytes


@dataclass
class FakeKafka:
    """One partition of a log; what was committed is where a new consumer begins."""

    log: list[bytes]
    committed: int = 0
    at: int = 0
    commits: list[int] = field(default_factory=list)

    async def getmany(self, timeout_ms: int, max_records: int) -> dict[str, list[FakeRecord]]:
        found = [FakeRecord(i, self.log[i]) for i in range(self.at, min(len(self.log), self.at + max_records))]
        self.at += len(found)
        if not found:
            await asyncio.sleep(timeout_ms / 1000)
        return {"p0": found} if found else {}

    def seek(self, place: str, offset: int) -> None:
        self.at = offset

    async def commit(self, offsets: dict[str, int]) -> None:
        self.committed = offsets["p0"]
        self.commits.append(self.committed)

    async def stop(self) -> None:
        """Nothing."""


class Failing(Ingest):
    """A store that is away for the first attempts."""

    failures = 2

    def take(self, found: Sequence[Any]) -> list[Any]:
        if self.failures:
            self.failures -= 1
            raise OperationalError("SELECT 1", {}, Exception("the database is away"))
        return super().take(found)


def opening(kafka: FakeKafka, *errors: tuple[type[Exception], ...]) -> Callable[[], Awaitable[Broker]]:
    async def opened() -> Broker:
        return KafkaBroker(kafka, *errors)

    return opened


async def until(
    open_broker: Callable[[], Awaitable[Broker]], ingest: Ingest, counts: ConsumerCounts, ends: Callable[[], bool]
) -> None:
    stopping = asyncio.Event()
    broker = await open_broker()
    turns: list[int] = []
    task = asyncio.create_task(consume(broker, ingest, stopping, counts, lambda: turns.append(1)))
    deadline = time.monotonic() + 30
    while not ends() and time.monotonic() < deadline:
        await asyncio.sleep(0.02)
    stopping.set()
    await task
    assert turns  # a probe sees that it lives
    await broker.close()


def test_kafka_commits_after_the_store_did_and_reads_again_what_it_did_not(
    pipeline: Pipeline, bodies: list[bytes]
) -> None:
    kafka = FakeKafka([bodies[0], b"nonsense", *bodies[1:]])
    counts = ConsumerCounts()

    ingest = Failing(pipeline, 0.0, Clock())
    asyncio.run(until(opening(kafka), ingest, counts, lambda: kafka.committed == 5))
    assert pipeline.state("north-1").used == 40
    assert counts.again == 8 and counts.refused >= 1
    assert kafka.commits == sorted(kafka.commits)


def test_a_message_that_cannot_be_folded_does_not_hold_up_the_others(
    engine: Engine, system: System, pipeline: Pipeline
) -> None:
    good = messages(engine, system, 20, 10)
    kafka = FakeKafka([encode(m, "exact") for m in (good[0], replace(good[0], model="x"), good[1])])
    counts = ConsumerCounts()

    asyncio.run(until(opening(kafka), Ingest(pipeline, 0.0, Clock()), counts, lambda: kafka.committed == 3))
    assert pipeline.state("north-1").used == 20
    assert (counts.messages, counts.refused) == (2, 1)


def test_a_message_that_fails_in_an_unforeseen_way_is_left_out_and_ends_no_consumer(
    engine: Engine, system: System, pipeline: Pipeline
) -> None:
    good = messages(engine, system, 20, 10)
    kafka = FakeKafka([encode(m, "exact") for m in (good[0], replace(good[0], vehicle="odd"), good[1])])
    counts = ConsumerCounts()

    class Odd(Ingest):
        def take(self, found: Sequence[Any]) -> list[Any]:
            if any(message.vehicle == "odd" for message in found):
                raise np.linalg.LinAlgError("singular matrix")
            return super().take(found)

    asyncio.run(until(opening(kafka), Odd(pipeline, 0.0, Clock()), counts, lambda: kafka.committed == 3))
    assert pipeline.state("north-1").used == 20
    assert (counts.messages, counts.refused) == (2, 1)


def test_an_acknowledgement_that_the_broker_does_not_take_ends_nothing(
    pipeline: Pipeline, bodies: list[bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    """It was away when the first batch was stored: the same records come again, and change nothing."""
    kafka, away = FakeKafka(list(bodies)), [ConnectionError("no coordinator")]
    commit = kafka.commit

    async def fails_once(offsets: dict[str, int]) -> None:
        if away:
            kafka.at = 0  # the partition was given to somebody anew
            raise away.pop()
        await commit(offsets)

    monkeypatch.setattr(kafka, "commit", fails_once)
    counts = ConsumerCounts()

    asyncio.run(
        until(opening(kafka, (ConnectionError,)), Ingest(pipeline, 0.0, Clock()), counts, lambda: kafka.committed == 4)
    )
    assert pipeline.state("north-1").used == 40
    assert counts.messages == 8


@pytest.fixture
def nats_server(tmp_path: Path) -> Iterator[tuple[str, Callable[[], None]]]:
    """Its address, and how to kill it and start it anew."""
    pytest.importorskip("nats")
    program = shutil.which("nats-server") or shutil.which("nats-server", path="/usr/sbin:/usr/local/sbin")
    if program is None:
        pytest.skip("nats-server is not installed")
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    running: list[subprocess.Popen[bytes]] = []

    def start() -> None:
        command = [program, "-a", "127.0.0.1", "-p", str(port), "-js", "-sd", str(tmp_path / "nats")]
        command += ["--user", "sprung", "--pass", "secret"]
        running.append(subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL))
        for _ in range(200):
            try:
                socket.create_connection(("127.0.0.1", port), 1).close()
                return
            except OSError:
                time.sleep(0.05)

    def kill_and_start() -> None:
        running[-1].kill()
        running[-1].wait()
        start()

    start()
    yield f"nats://sprung:secret@127.0.0.1:{port}", kill_and_start
    running[-1].kill()
    running[-1].wait()


def test_nats_keeps_messages_over_kills_of_both_sides(
    nats_server: tuple[str, Callable[[], None]], pipeline: Pipeline, bodies: list[bytes]
) -> None:
    """Published twice each; the consumer dies after it has stored and before it acknowledged; the server is killed."""
    address, kill_and_start = nats_server
    link = NatsLink(address, "north-1")
    for body in (bodies[0], bodies[0], bodies[1]):
        assert link.send(SpoolEntry(1, "estimates", "", body)).stored
    kill_and_start()
    for _ in range(50):
        answers = [link.send(SpoolEntry(1, "estimates", "", body)) for body in bodies[1:]]
        if all(answer.stored for answer in answers):
            break
        time.sleep(0.1)
    link.close()
    ingest = Ingest(pipeline, 0.0, Clock())

    async def dies() -> None:
        broker = await NatsBroker.open(address, ack_seconds=0.5)
        found: Sequence[BrokerMessage] = await broker.fetch(2, 5.0)
        ingest.take(read_messages([one.body for one in found]))
        await broker.close()

    asyncio.run(dies())
    counts = ConsumerCounts()

    async def opened() -> Broker:
        return await NatsBroker.open(address, ack_seconds=0.5)

    asyncio.run(until(opened, ingest, counts, lambda: counts.messages >= 4))
    assert pipeline.state("north-1").used == 40
    assert counts.messages == 4  # each once: the server dropped what was published twice


def test_a_nats_server_that_is_killed_is_missed_at_once_and_found_again_soon(
    nats_server: tuple[str, Callable[[], None]], pipeline: Pipeline, bodies: list[bytes]
) -> None:
    """The sender does not wait for an answer that a dead server owes, nor the consumer for its acknowledgement."""
    address, kill_and_start = nats_server
    link = NatsLink(address, "north-1")
    assert link.send(SpoolEntry(1, "estimates", "", bodies[0])).stored
    counts = ConsumerCounts()

    async def killed_before_the_acknowledgement() -> None:
        broker, stopping = await NatsBroker.open(address, ack_seconds=0.5), asyncio.Event()
        ingest, killed = Ingest(pipeline, 0.0, Clock()), [False]

        class Killing:
            """Stores, then the server goes: once."""

            def take(self, found: Sequence[Any]) -> list[Any]:
                taken = ingest.take(found)
                if not killed[0]:
                    killed[0] = True
                    kill_and_start()
                return list(taken)

        task = asyncio.create_task(consume(broker, Killing(), stopping, counts))  # type: ignore[arg-type]
        await asyncio.sleep(0.5)
        begun = time.monotonic()
        while not (await asyncio.to_thread(link.send, SpoolEntry(1, "estimates", "", bodies[1]))).stored:
            await asyncio.sleep(0.05)
        while pipeline.state("north-1").used < 20 and time.monotonic() - begun < 10.0:
            await asyncio.sleep(0.05)
        assert time.monotonic() - begun < 4.0
        stopping.set()
        await task
        await broker.close()

    asyncio.run(killed_before_the_acknowledgement())
    link.close()
    assert pipeline.state("north-1").used == 20


def test_who_has_no_password_is_not_let_in_and_no_line_shows_one(
    nats_server: tuple[str, Callable[[], None]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sprung.service.fleet.nats_broker.FIRST_ANSWER_SECONDS", 2.0)
    for address in (nats_server[0].replace("secret", "guessed"), nats_server[0].replace("sprung:secret@", "")):
        with pytest.raises(UserError, match="Authorization Violation") as refused:
            asyncio.run(NatsBroker.open(address, 1.0))
        assert "guessed" not in str(refused.value)


def test_a_message_comes_again_before_those_behind_it_stop_waiting() -> None:
    assert ack_seconds(10.0) == 5.0 and ack_seconds(0.0) > 0.0


def test_raw_recordings_do_not_go_through_a_broker() -> None:
    link = NatsLink("nats://127.0.0.1:1", "north-1")
    assert link.send(SpoolEntry(1, "recording", "x.mcap", b"")).refused
    link.close()

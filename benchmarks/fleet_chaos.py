"""Kill -9 of whatever is there, again and again, while vehicles send: is everything stored once, and how soon again.

Vehicles publish estimates to NATS JetStream; two processes (`sprung fleet consume`) fold them into PostgreSQL with
`fsync`.  Every so often one of the four is killed and started anew.  At the end the store is compared with one that was
filled by one process, in order, without any disturbance.
"""

from __future__ import annotations

import os
import random
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from sqlalchemy import func, select
from sqlalchemy.exc import SQLAlchemyError

from sprung.benchmarks.fleet_compare import differences
from sprung.model.identification.excitation import simulate_runs
from sprung.service.compute import Compute
from sprung.service.errors import UserError
from sprung.service.fleet import local_postgres as postgres
from sprung.service.fleet.backfill import engine_of
from sprung.service.fleet.ingest import Ingest
from sprung.service.fleet.message import Message, WindowEstimate, encode
from sprung.service.fleet.nats_broker import NatsLink
from sprung.service.fleet.spool import SpoolEntry
from sprung.service.pipeline import Pipeline
from sprung.service.settings import Settings
from sprung.service.store import Store, open_store
from sprung.service.store.schema import windows

Figures = Iterator[dict[str, Any]]
FIRST = 1_790_000_000_000_000_000  # ns
VEHICLES = 4
PER_MESSAGE = 5  # windows
MOST_WINDOWS = 240  # of a vehicle that are identified; the ride is repeated later in time
RECOVERY_TARGET = 10.0  # s


@dataclass
class KilledPart:
    """A process that is killed and started anew."""

    name: str
    start: Callable[[], subprocess.Popen[bytes] | None]
    kill: Callable[[subprocess.Popen[bytes] | None], None]
    process: subprocess.Popen[bytes] | None = None
    kills: int = 0


@dataclass
class ChaosTold:
    """What happened."""

    recoveries: list[tuple[str, float]] = field(default_factory=list)
    published: int = 0


def chaos(minutes: float, every: float) -> Figures:
    """Figures of one run; needs PostgreSQL and nats-server."""
    if reason := postgres.missing():
        raise UserError(f"bench fleet chaos: {reason}")
    program = shutil.which("nats-server") or shutil.which("nats-server", path="/usr/sbin:/usr/local/sbin")
    if program is None:
        raise UserError("bench fleet chaos: nats-server is not installed")
    settings = Settings()
    engine = engine_of(settings)
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="sprung-chaos-")))
        server = stack.enter_context(postgres.server(durable=True))
        url = server.database()
        watched = open_store(url)
        stack.callback(watched.close)
        address = f"nats://127.0.0.1:{_free_port()}"
        parts = [
            KilledPart("nats", lambda: _nats(program, address, folder), _kill),
            KilledPart("worker 1", lambda: _worker(address, url, folder / "1"), _kill),
            KilledPart("worker 2", lambda: _worker(address, url, folder / "2"), _kill),
            KilledPart("postgresql", lambda: _started(server), lambda process: os.kill(server.pid(), signal.SIGKILL)),
        ]
        for part in parts[:3]:
            part.process = part.start()
            stack.callback(_end_part, part)
        rounds = max(1, round(60 * minutes * 2 / MOST_WINDOWS))
        messages = _messages(engine, rounds)
        told = ChaosTold()
        publisher = threading.Thread(target=_publish, args=(address, messages, 60 * minutes, told), daemon=True)
        publisher.start()
        _disturb(parts, watched, 60 * minutes, every, told)
        publisher.join()
        expected = sum(len(m.windows) for m in messages)
        settled = _await(lambda: _count(watched) >= expected, 120.0)
        time.sleep(settings.late_seconds + 3.0)  # what waits behind a gap is folded at last
        stored = _count(watched)
        alone = _undisturbed(engine, messages, folder)
        found = differences(alone, watched, engine.digest, [f"chaos-{v}" for v in range(VEHICLES)])
        alone.close()
    worst = max((seconds for _, seconds in told.recoveries), default=0.0)
    yield {"figure": "minutes", "value": minutes, "kills": {part.name: part.kills for part in parts}}
    yield {"figure": "windows acknowledged to vehicles", "value": expected, "stored": stored, "settled": settled}
    yield {"figure": "windows lost", "value": expected - stored, "target": 0}
    for name in ("windows", "alarms", "states"):
        yield {"figure": f"{name} that differ from the undisturbed run", "value": found[name], "target": 0}
    yield {"figure": "largest difference of posteriors", "value": found["posteriors"], "target": 1e-12}
    yield {
        "figure": "longest recovery after a restart",
        "value": round(worst, 1),
        "unit": "s",
        "target": RECOVERY_TARGET,
    }
    yield {"figure": "recoveries", "value": [[name, round(seconds, 1)] for name, seconds in told.recoveries]}


def _messages(engine: Any, rounds: int) -> list[Message]:
    """Messages of all vehicles in turns."""
    system = engine.system
    level = 0.05 * np.random.default_rng(1).normal(size=(VEHICLES, len(system.parameters)))
    samples = system.window + system.hop * (MOST_WINDOWS - 1)
    values = simulate_runs(system, level, samples, np.random.default_rng(2)).values
    hop_ns = round(system.hop / system.sample_rate * 1e9)
    found: list[list[Any]] = []
    for first in range(MOST_WINDOWS):
        part = values[:, first * system.hop : first * system.hop + system.window]
        found.append(engine.identify(part, starts=[FIRST + first * hop_ns] * VEHICLES)[0])
    messages = []
    for first in range(0, rounds * MOST_WINDOWS, PER_MESSAGE):
        for v in range(VEHICLES):
            sent = [
                WindowEstimate(FIRST + i * hop_ns, "used", None, 0, False, found[i % MOST_WINDOWS][v])
                for i in range(first, first + PER_MESSAGE)
            ]
            messages.append(Message(f"chaos-{v}", engine.digest, tuple(sent)))
    return messages


def _publish(address: str, messages: list[Message], seconds: float, told: ChaosTold) -> None:
    """As an edge does: each until the broker has it, evenly over the time."""
    link, begun = NatsLink(address, "chaos"), time.monotonic()
    for i, message in enumerate(messages):
        time.sleep(max(0.0, begun + seconds * i / len(messages) - time.monotonic()))
        entry = SpoolEntry(i, "estimates", "", encode(message, "exact"))
        while not link.send(entry).stored:
            time.sleep(0.2)
        told.published += len(message.windows)
    link.close()


def _disturb(parts: list[KilledPart], store: Store, seconds: float, every: float, told: ChaosTold) -> None:
    rng, begun = random.Random(7), time.monotonic()
    order: list[KilledPart] = []
    while time.monotonic() - begun + every < seconds:
        time.sleep(every)
        order = order or rng.sample(parts, len(parts))
        part = order.pop()
        part.kill(part.process)
        part.kills += 1
        time.sleep(1.0)
        part.process = part.start() or part.process
        restarted, before = time.monotonic(), None
        while before is None or _count(store) <= before:
            before = _count(store) if before is None else before
            if before < 0:
                before = None
            if time.monotonic() - restarted > 60 or told.published < 0:
                break
            time.sleep(0.1)
        told.recoveries.append((part.name, time.monotonic() - restarted))


def _undisturbed(engine: Any, messages: list[Message], folder: Path) -> Store:
    store, compute = open_store(str(folder / "alone.db")), Compute(1)
    ingest = Ingest(Pipeline(engine, store, compute), 0.0)
    for first in range(0, len(messages), 40):
        ingest.take(messages[first : first + 40])
    compute.close()
    return store


def _count(store: Store) -> int:
    try:
        with store.read() as connection:
            return int(connection.execute(select(func.count()).select_from(windows)).scalar_one())
    except (SQLAlchemyError, OSError):
        return -1


def _await(fulfilled: Callable[[], bool], seconds: float) -> bool:
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        if fulfilled():
            return True
        time.sleep(0.2)
    return False


def _started(server: postgres.PostgresServer) -> None:
    """A server that was killed leaves its children a moment longer."""
    for _ in range(100):
        try:
            server.start()
            return
        except subprocess.CalledProcessError:
            time.sleep(0.2)


def _nats(program: str, address: str, folder: Path) -> subprocess.Popen[bytes]:
    port = address.rsplit(":", 1)[1]
    command = [program, "-a", "127.0.0.1", "-p", port, "-js", "-sd", str(folder / "nats")]
    running = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    _await(lambda: _listens(int(port)), 20.0)
    return running


def _worker(address: str, url: str, folder: Path) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-m", "sprung", "fleet", "consume", address, "--store", url]
    environment = os.environ | {"SPRUNG_DATA_DIR": str(folder)}
    return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, env=environment)


def _end_part(part: KilledPart) -> None:
    _kill(part.process)


def _kill(process: subprocess.Popen[bytes] | None) -> None:
    if process is not None:
        process.kill()
        process.wait()


def _listens(port: int) -> bool:
    try:
        socket.create_connection(("127.0.0.1", port), 1).close()
    except OSError:
        return False
    return True


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])

"""Kill -9 of whatever is there, again and again, while vehicles send: is everything stored once, and how soon again.

Some vehicles publish estimates to NATS JetStream, which two processes (`sprung fleet consume`) fold into PostgreSQL
with `fsync`; where Ray is installed, the others post theirs to Ray Serve (`sprung fleet serve`).  Every so often one of
these is killed and, unless Ray or the command does it, started anew: NATS, a consumer, the database, a replica of Serve
or its door, Ray's head, or the command with all of Ray.  At the end the store is compared with one that was filled by
one process, in order, undisturbed.
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
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from sqlalchemy import func, select
from sqlalchemy.exc import SQLAlchemyError

from sprung.benchmarks.fleet_compare import differences
from sprung.benchmarks.fleet_processes import descendants
from sprung.model.identification.excitation import simulate_runs
from sprung.service.errors import UserError
from sprung.service.fleet import local_postgres as postgres
from sprung.service.fleet.backfill import engine_of
from sprung.service.fleet.ingest import Ingest
from sprung.service.fleet.message import Message, WindowEstimate, encode
from sprung.service.fleet.nats_broker import NatsLink
from sprung.service.fleet.sending import HttpLink
from sprung.service.fleet.spool import SpoolEntry
from sprung.service.monitoring.compute import Compute
from sprung.service.monitoring.pipeline import Pipeline
from sprung.service.settings import Settings
from sprung.service.store import Store, open_store
from sprung.service.store.schema import windows

Figures = Iterator[dict[str, Any]]
FIRST = 1_790_000_000_000_000_000  # ns
VEHICLES = 4
ClosedLink = HttpLink | NatsLink
NAMES = tuple(f"chaos-{v}" for v in range(VEHICLES))
PER_MESSAGE = 5  # windows
MOST_WINDOWS = 240  # of a vehicle that are identified; the ride is repeated later in time
RECOVERY_TARGET = 10.0  # s
LONGEST_WAIT = 120.0  # s: for a recovery


@dataclass
class KilledPart:
    """A process that is killed and started anew."""

    name: str
    start: Callable[[], subprocess.Popen[bytes] | None]
    kill: Callable[[subprocess.Popen[bytes] | None], None]
    fed: Sequence[str]  # vehicles whose windows come through it
    process: subprocess.Popen[bytes] | None = None
    kills: int = 0


@dataclass(frozen=True)
class ChaosFleet:
    """What vehicles send to, and what is killed of it."""

    server: postgres.PostgresServer
    url: str  # of the store
    program: str  # nats-server
    address: str  # of NATS
    port: int  # of Ray Serve
    folder: Path

    @property
    def posting(self) -> tuple[str, ...]:
        """Vehicles that post to Ray Serve."""
        return NAMES[VEHICLES // 2 :] if find_spec("ray") else ()

    @property
    def published(self) -> tuple[str, ...]:
        """Vehicles that publish to NATS."""
        return tuple(name for name in NAMES if name not in self.posting)

    def parts(self) -> list[KilledPart]:
        """Not yet started, but for the database."""

        def kill_server(_: object) -> None:
            os.kill(self.server.pid(), signal.SIGKILL)

        nats = KilledPart("nats", lambda: _nats(self.program, self.address, self.folder), _kill, self.published)
        parts = [nats, self._consumer(1), self._consumer(2)]
        parts.append(KilledPart("postgresql", lambda: _started(self.server), kill_server, NAMES))
        if self.posting:
            folder = self.folder / "ray"
            ray = KilledPart("all of Ray", lambda: _serving(self.port, self.url, folder), _kill_all, self.posting)
            parts += [ray, *_parts_of(ray)]
        return parts

    def _consumer(self, number: int) -> KilledPart:
        folder = self.folder / str(number)
        return KilledPart(f"consumer {number}", lambda: _worker(self.address, self.url, folder), _kill, self.published)

    def links(self) -> list[tuple[ClosedLink, Sequence[str]]]:
        """Links, and the vehicles that send over each."""
        found: list[tuple[ClosedLink, Sequence[str]]] = [(NatsLink(self.address, "chaos"), self.published)]
        return found + [(HttpLink(f"http://127.0.0.1:{self.port}", None, name), [name]) for name in self.posting]


@dataclass
class ChaosOutcome:
    """What happened."""

    recoveries: list[tuple[str, float, float]] = field(default_factory=list)  # what, after how many s, load then
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
        address, port = f"nats://127.0.0.1:{postgres.free_port()}", postgres.free_port()
        fleet = ChaosFleet(server, url, program, address, port, folder)
        parts = fleet.parts()
        for part in parts:
            if part.name != "postgresql":
                part.process = part.start()
                stack.callback(_end_part, part)
        messages = _messages(engine, rounds=max(1, round(60 * minutes * 2 / MOST_WINDOWS)))
        outcome = ChaosOutcome()
        _ride(fleet.links(), messages, parts, watched, (60 * minutes, every), outcome)
        expected = sum(len(m.windows) for m in messages)
        settled = _await(lambda: _count(watched, NAMES) >= expected, 120.0)
        time.sleep(settings.late_seconds + 3.0)  # what waits behind a gap is folded at last
        stored = _count(watched, NAMES)
        alone = _undisturbed(engine, messages, folder)
        found = differences(alone, watched, engine.digest, list(NAMES))
        alone.close()
    yield {"figure": "minutes", "value": minutes, "kills": {part.name: part.kills for part in parts}}
    yield {"figure": "windows acknowledged to vehicles", "value": expected, "stored": stored, "settled": settled}
    yield {"figure": "windows lost", "value": expected - stored, "target": 0}
    for name in ("windows", "alarms", "states"):
        yield {"figure": f"{name} that differ from the undisturbed run", "value": found[name], "target": 0}
    yield {"figure": "largest difference of posteriors", "value": found["posteriors"], "target": 1e-12}
    yield from _recoveries(outcome)


def _recoveries(outcome: ChaosOutcome) -> Figures:
    worst = max((seconds for _, seconds, _ in outcome.recoveries), default=0.0)
    yield {
        "figure": "longest recovery after a restart",
        "value": round(worst, 1),
        "unit": "s",
        "target": RECOVERY_TARGET,
        "load": os.getloadavg()[0],
    }
    each = [[name, round(seconds, 1), round(load, 1)] for name, seconds, load in outcome.recoveries]
    yield {"figure": "recoveries, with the load of the machine then", "value": each}


def _ride(
    links: list[tuple[ClosedLink, Sequence[str]]],
    messages: list[Message],
    parts: list[KilledPart],
    store: Store,
    times: tuple[float, float],
    outcome: ChaosOutcome,
) -> None:
    """Send over all links at once for times[0] seconds, disturbed every times[1]; returns when all is taken."""
    senders = []
    for link, vehicles in links:
        mine = [message for message in messages if message.vehicle in vehicles]
        sender = threading.Thread(target=_publish, args=(link, mine, times[0], outcome), daemon=True)
        sender.start()
        senders.append(sender)
    _disturb(parts, store, *times, outcome)
    for sender in senders:
        sender.join()


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


def _publish(link: ClosedLink, messages: list[Message], seconds: float, outcome: ChaosOutcome) -> None:
    """As an edge does: each until it is taken, evenly over the time."""
    begun = time.monotonic()
    for i, message in enumerate(messages):
        time.sleep(max(0.0, begun + seconds * i / len(messages) - time.monotonic()))
        entry = SpoolEntry(i, "estimates", "", encode(message, "exact"))
        while not link.send(entry).stored:
            time.sleep(0.2)
        outcome.published += len(message.windows)
    link.close()


def _disturb(parts: list[KilledPart], store: Store, seconds: float, every: float, outcome: ChaosOutcome) -> None:
    rng, begun = random.Random(7), time.monotonic()
    order: list[KilledPart] = []
    while time.monotonic() - begun + every < seconds:
        time.sleep(every)
        order = order or rng.sample(parts, len(parts))
        part = order.pop()
        part.kill(part.process)
        part.kills += 1
        time.sleep(1.0)
        restarted, before = time.monotonic(), -1
        part.process = part.start() or part.process
        while time.monotonic() - restarted < LONGEST_WAIT:
            now = _count(store, part.fed)
            if 0 <= before < now:
                break
            before = now if before < 0 else before
            time.sleep(0.1)
        outcome.recoveries.append((part.name, time.monotonic() - restarted, os.getloadavg()[0]))


def _undisturbed(engine: Any, messages: list[Message], folder: Path) -> Store:
    store, compute = open_store(str(folder / "alone.db")), Compute(1)
    ingest = Ingest(Pipeline(engine, store, compute), 0.0)
    for first in range(0, len(messages), 40):
        ingest.take(messages[first : first + 40])
    compute.close()
    return store


def _count(store: Store, vehicles: Sequence[str]) -> int:
    """Windows that are stored of some vehicles; -1 when the database does not answer."""
    query = select(func.count()).select_from(windows).where(windows.c.vehicle_id.in_(vehicles))
    try:
        with store.read() as connection:
            return int(connection.execute(query).scalar_one())
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


def _serving(port: int, url: str, folder: Path) -> subprocess.Popen[bytes]:
    """Ray Serve on this machine; returns when requests are taken."""
    command = [sys.executable, "-m", "sprung", "fleet", "serve", "--store", url, "--port", str(port), "--cores", "0.4"]
    sizes = ["--workers", "2", "--replicas", "2", "--least", "2"]
    running = subprocess.Popen(
        [*command, *sizes], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        env=os.environ | {"SPRUNG_DATA_DIR": str(folder)}, start_new_session=True,
    )  # fmt: skip
    _await(lambda: _listens(port) or running.poll() is not None, 240.0)
    return running


def _parts_of(ray: KilledPart) -> list[KilledPart]:
    """Processes that the command, or Ray, starts anew."""
    named = {
        "head of Ray": ("gcs_server",),
        "replica of Serve": ("ServeReplica:sprung:compute",),
        "door of Serve": ("ServeReplica:sprung:door",),
    }
    return [
        KilledPart(name, lambda: None, partial(_kill_process, ray, texts), ray.fed) for name, texts in named.items()
    ]


def _kill_process(part: KilledPart, names: Sequence[str], _: object) -> None:
    """Kill one of the processes of a part, which starts another one itself."""
    found = [pid for name in names for pid in _below(part.process, name)]
    if found:
        os.kill(random.Random(part.kills).choice(found), signal.SIGKILL)


def _kill_all(process: subprocess.Popen[bytes] | None) -> None:
    """Kill a process and all that it has started, as a machine that fails."""
    if process is not None:
        below = [one.pid for one in descendants(process.pid)]
        process.kill()
        for pid in below:
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        process.wait()


def _below(process: subprocess.Popen[bytes] | None, text: str) -> list[int]:
    """Processes that descend from one and have a text in their command."""
    return [] if process is None else [one.pid for one in descendants(process.pid) if text in one.command]


def _end_part(part: KilledPart) -> None:
    if part.name == "all of Ray" and part.process is not None:
        part.process.terminate()  # it ends what it has started
        try:
            part.process.wait(60)
        except subprocess.TimeoutExpired:
            _kill(part.process)
    else:
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

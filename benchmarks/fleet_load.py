"""Windows through HTTP: one process asked by one client, against Ray Serve asked by many at once."""

from __future__ import annotations

import http.client
import json
import os
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from sprung.benchmarks.fleet_processes import busy_seconds, descendants
from sprung.benchmarks.serve import window_body
from sprung.model.system import load_system
from sprung.service.errors import UserError
from sprung.service.fleet import local_postgres as postgres
from sprung.service.times import to_iso

Figures = Iterator[dict[str, Any]]
FIRST = 1_790_000_000_000_000_000  # ns
CLIENTS = 48
TOGETHER = 10  # windows of a vehicle in one request: five seconds of a ride
VEHICLES = 2_000
SLOWER = 100  # than real time
HOP = 500_000_000  # ns


class LoadClient(threading.Thread):
    """Some vehicles in turns, each one's windows in order: evenly at a rate or as fast as they are taken."""

    def __init__(
        self, port: int, load: SentLoad, vehicles: Sequence[str], number: int, times: tuple[float, float, float]
    ) -> None:
        """vehicles: their ids; number: of requests before; times: when it begins and ends, and s between requests, 0:
        as fast as they are taken."""
        super().__init__(daemon=True)
        self._port, self._load, self._vehicles, self.number = port, load, vehicles, number
        self._first, self._until, self._period = times
        self.seconds: list[float] = []  # of requests that were taken
        self.refused = 0

    def run(self) -> None:
        connection = http.client.HTTPConnection("127.0.0.1", self._port, timeout=60)
        number, due = self.number, self._first
        while time.monotonic() < self._until:
            round_of, turn = divmod(number, len(self._vehicles))
            body = self._load.body(self._vehicles[turn], round_of)
            time.sleep(max(0.0, due - time.monotonic()))
            begun = time.monotonic()
            connection.request("POST", self._load.path, body, {"content-type": "application/json"})
            answer = connection.getresponse()
            answer.read()
            if answer.status == 200:
                self.seconds.append(time.monotonic() - (due if self._period else begun))
                number += 1
                self.number = number
            else:
                self.refused += 1
                time.sleep(0.2)
            due = max(due + self._period, time.monotonic() - 5 * self._period)
        connection.close()


def ingest(workers: int, seconds: float, minutes: float, together: Sequence[int] = (1, TOGETHER)) -> Figures:
    """Windows a second, latencies at 70 % of the most, and many vehicles at a hundredth of their rate.

    together: windows of a vehicle in a request, one after the other.
    """
    if find_spec("ray") is None:
        raise UserError("bench fleet ingest: Ray is not installed; pip install 'sprung[fleet]'")
    if reason := postgres.missing():
        raise UserError(f"bench fleet ingest: {reason}")
    body = json.loads(window_body(load_system()))
    with ExitStack() as stack:
        folder = stack.enter_context(tempfile.TemporaryDirectory(prefix="sprung-load-"))
        server = stack.enter_context(postgres.server(durable=True))
        single = SentLoad("/identify?track=true", body, _named(1))
        with ExitStack() as alone:
            store = {"SPRUNG_STORE": server.database()}
            port = served(alone, ["serve", "--port"], folder, store, "/health/live")
            single.send(port, min(5.0, seconds), 0.0)  # warm
            at_rest = _busy(server)
            one = single.send(port, seconds, 0.0)
            spent = (_busy(server) - at_rest) / one.windows
        yield {"figure": "windows per second, one process, one client", "value": round(one.rate, 1)} | _cost(spent)
        more = {
            "SPRUNG_STORE": server.database(),
            "SPRUNG_LATE_SECONDS": "0",
            "SPRUNG_CLIENT_REQUESTS_PER_SECOND": "1e6",
        }
        command = ["fleet", "serve", "--workers", str(workers), "--replicas", "2", "--least", "2", "--port"]
        fleet = served(stack, command, f"{folder}/fleet", more, "/health/ready")
        for windows in together:
            many = SentLoad("/ingest/windows", body, _named(CLIENTS), together=windows)
            yield from _fleet_figures(fleet, server, many, one.rate, spent, seconds)
        if minutes:
            yield from _many_vehicles(fleet, body, minutes)


def _fleet_figures(
    port: int, server: postgres.PostgresServer, many: SentLoad, rate_alone: float, spent_alone: float, seconds: float
) -> Figures:
    many.send(port, min(10.0, seconds), 0.0)  # warm: replicas are added
    at_rest = _busy(server)
    most = many.send(port, seconds, 0.0)
    spent = (_busy(server) - at_rest) / most.windows
    yield {"figure": "windows per second, Ray Serve", "value": round(most.rate, 1)} | most.figures() | _cost(spent)
    ratio = {"figure": "ratio", "value": round(most.rate / rate_alone, 2), "target": 4.0}
    # of processor time: one client keeps one core busy at the most, many keep all of them busy
    yield ratio | {"of_all_cores": round((os.cpu_count() or 1) * spent_alone / spent, 2), "load": os.getloadavg()[0]}
    eased = many.send(port, seconds, CLIENTS * many.together / (0.7 * most.rate))
    low, high = np.percentile(eased.seconds, [50, 99])
    yield {"figure": "latency at 70 % load, p99", "value": round(float(high), 3), "unit": "s", "target": 1.0}
    yield {"figure": "latency at 70 % load, p50", "value": round(float(low), 3), "unit": "s"} | eased.figures()


def _busy(server: postgres.PostgresServer) -> float:
    """Processor time of everything that takes part, s: client, server, Ray, database."""
    postmaster = int((server.folder / "data" / "postmaster.pid").read_text().split()[0])
    return busy_seconds() + sum(one.seconds for one in descendants(postmaster))


def _cost(spent: float) -> dict[str, float]:
    return {"processor_ms_a_window": round(1e3 * spent, 1)}


def _many_vehicles(port: int, body: dict[str, Any], minutes: float) -> Figures:
    """Vehicles that run at a hundredth of their rate: a request of some windows whenever so many would be there."""
    named = _named(VEHICLES)
    rate = VEHICLES / (HOP / 1e9) / SLOWER
    load = SentLoad("/ingest/windows", body, named, CLIENTS, TOGETHER)
    sent = load.send(port, 60 * minutes, CLIENTS * TOGETHER / rate)
    low, high = np.percentile(sent.seconds, [50, 99])
    yield {
        "figure": f"{VEHICLES} vehicles at 1/{SLOWER} of the real rate, latency p99",
        "value": round(float(high), 3), "p50": round(float(low), 3), "unit": "s", "target": 1.0, "minutes": minutes,
        "windows_per_second": round(sent.rate, 1), "wanted": rate,
    } | sent.figures()  # fmt: skip


@dataclass(frozen=True, slots=True)
class Answered:
    """What became of a load."""

    rate: float  # windows a second that were stored
    seconds: list[float]  # latencies of their requests
    refused: int
    clients: int
    together: int  # windows of a request

    @property
    def windows(self) -> int:
        """How many were stored."""
        return len(self.seconds) * self.together

    def figures(self) -> dict[str, Any]:
        """Beside a figure."""
        return {
            "clients": self.clients,
            "windows": self.windows,
            "in_a_request": self.together,
            "refused": self.refused,
        }


class SentLoad:
    """Windows of some vehicles to one path; sent again, they go on: most vehicles of a fleet are known."""

    def __init__(
        self, path: str, body: dict[str, Any], vehicles: Sequence[str], clients: int | None = None, together: int = 1
    ) -> None:
        """body: of one window; together: windows of a vehicle in a request."""
        self.path, self._vehicles, self.together = path, vehicles, together
        # written once: the client shares the machine with what it measures
        self._rate, self._channels = json.dumps(body["sample_rate"]), json.dumps(body["channels"])
        self._clients = clients or len(vehicles)
        self._numbers = [0] * self._clients  # requests of each client so far

    def body(self, vehicle: str, number: int) -> bytes:
        """A vehicle's request, counted from 0."""
        first = FIRST + number * self.together * HOP
        windows = [f'"start": "{to_iso(first + i * HOP)}", "channels": {self._channels}' for i in range(self.together)]
        head = f'"vehicle": "{vehicle}", "sample_rate": {self._rate}'
        if self.together == 1:
            return f"{{{head}, {windows[0]}}}".encode()
        return f'{{{head}, "windows": [{", ".join(f"{{{window}}}" for window in windows)}]}}'.encode()

    def send(self, port: int, seconds: float, period: float) -> Answered:
        """For so long, every client a request each `period` seconds; 0: as fast as they are taken."""
        begun = time.monotonic()
        running = []
        for i, number in enumerate(self._numbers):
            times = (begun + period * i / self._clients, begun + seconds, period)
            running.append(LoadClient(port, self, self._vehicles[i :: self._clients], number, times))
        for client in running:
            client.start()
        for client in running:
            client.join()
        self._numbers = [client.number for client in running]
        latencies = [one for client in running for one in client.seconds]
        rate = self.together * len(latencies) / (time.monotonic() - begun)
        return Answered(rate, latencies, sum(client.refused for client in running), self._clients, self.together)


def _named(count: int) -> list[str]:
    """New vehicles."""
    name = f"load{os.urandom(2).hex()}"
    return [f"{name}-{i}" for i in range(count)]


def served(stack: ExitStack, command: list[str], folder: str, more: dict[str, str], ready: str) -> int:
    """Start a command in a process of its own and wait until it answers; its port."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = int(probe.getsockname()[1])
    Path(folder).mkdir(parents=True, exist_ok=True)
    process = subprocess.Popen(
        [sys.executable, "-m", "sprung", *command, str(port)],
        env=os.environ | {"SPRUNG_DATA_DIR": folder} | more,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )

    def end() -> None:
        process.send_signal(signal.SIGTERM)
        try:
            process.wait(60)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()

    stack.callback(end)
    deadline = time.monotonic() + 240
    while time.monotonic() < deadline and process.poll() is None:
        try:
            connection = http.client.HTTPConnection("127.0.0.1", port, timeout=5)
            connection.request("GET", ready)
            if connection.getresponse().status == 200:
                return port
        except (OSError, http.client.HTTPException):
            pass
        time.sleep(0.5)
    raise UserError(f"sprung {' '.join(command)} did not come up")

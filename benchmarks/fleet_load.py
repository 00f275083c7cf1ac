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
from collections.abc import Iterator
from contextlib import ExitStack
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from sprung.benchmarks.serve import window_body
from sprung.model.system import load_system
from sprung.service.errors import UserError
from sprung.service.fleet import local_postgres as postgres
from sprung.service.times import to_iso

Figures = Iterator[dict[str, Any]]
FIRST = 1_790_000_000_000_000_000  # ns
CLIENTS = 48
HOP = 500_000_000  # ns


class LoadClient(threading.Thread):
    """One vehicle: its windows one after the other, evenly at a rate or as fast as they are taken."""

    def __init__(self, port: int, path: str, body: dict[str, Any], vehicle: str, until: float, period: float) -> None:
        super().__init__(daemon=True)
        self._port, self._path, self._body = port, path, body | {"vehicle": vehicle}
        self._until, self._period = until, period
        self.seconds: list[float] = []
        self.refused = 0

    def run(self) -> None:
        connection = http.client.HTTPConnection("127.0.0.1", self._port, timeout=60)
        number, due = 0, time.monotonic()
        while time.monotonic() < self._until:
            body = json.dumps(self._body | {"start": to_iso(FIRST + number * HOP)})
            time.sleep(max(0.0, due - time.monotonic()))
            begun = time.monotonic()
            connection.request("POST", self._path, body, {"content-type": "application/json"})
            answer = connection.getresponse()
            answer.read()
            if answer.status == 200:
                self.seconds.append(time.monotonic() - (due if self._period else begun))
                number += 1
            else:
                self.refused += 1
                time.sleep(0.2)
            due = max(due + self._period, time.monotonic() - 5 * self._period)
        connection.close()


def ingest(workers: int, seconds: float) -> Figures:
    """Windows a second, and latencies at 70 % of the most."""
    if find_spec("ray") is None:
        raise UserError("bench fleet ingest: Ray is not installed; pip install 'sprung[fleet]'")
    if reason := postgres.missing():
        raise UserError(f"bench fleet ingest: {reason}")
    body = json.loads(window_body(load_system()))
    with ExitStack() as stack:
        folder = stack.enter_context(tempfile.TemporaryDirectory(prefix="sprung-load-"))
        server = stack.enter_context(postgres.server(durable=True))
        port = _served(stack, ["serve", "--port"], folder, {"SPRUNG_STORE": server.database()}, "/health/live")
        alone, _, _ = load(port, "/identify?track=true", body, 1, seconds, 0.0)
        yield {"figure": "windows per second, one process, one client", "value": round(alone, 1)}
        more = {
            "SPRUNG_STORE": server.database(),
            "SPRUNG_LATE_SECONDS": "0",
            "SPRUNG_CLIENT_REQUESTS_PER_SECOND": "1e6",
        }
        command = ["fleet", "serve", "--workers", str(workers), "--cores", "0.5", "--port"]
        fleet = _served(stack, command, f"{folder}/fleet", more, "/health/ready")
        load(fleet, "/ingest/windows", body, CLIENTS, min(10.0, seconds), 0.0)  # warm
        most, _, refused = load(fleet, "/ingest/windows", body, CLIENTS, seconds, 0.0)
        yield {
            "figure": "windows per second, Ray Serve",
            "value": round(most, 1),
            "clients": CLIENTS,
            "refused": refused,
        }
        yield {"figure": "ratio", "value": round(most / alone, 2), "target": 4.0, "load": os.getloadavg()[0]}
        period = CLIENTS / (0.7 * most)
        rate, times, _ = load(fleet, "/ingest/windows", body, CLIENTS, seconds, period)
        low, high = np.percentile(times, [50, 99])
        yield {"figure": "latency at 70 % load, p99", "value": round(float(high), 3), "unit": "s", "target": 1.0}
        yield {
            "figure": "latency at 70 % load, p50",
            "value": round(float(low), 3),
            "unit": "s",
            "rate": round(rate, 1),
        }


def load(
    port: int, path: str, body: dict[str, Any], clients: int, seconds: float, period: float
) -> tuple[float, list[float], int]:
    """Windows a second that were stored, their latencies, and how many were refused."""
    begun = time.monotonic()
    name = f"load{os.urandom(2).hex()}"
    running = [LoadClient(port, path, body, f"{name}-{i}", begun + seconds, period) for i in range(clients)]
    for client in running:
        client.start()
    for client in running:
        client.join()
    times = [one for client in running for one in client.seconds]
    return len(times) / (time.monotonic() - begun), times, sum(client.refused for client in running)


def _served(stack: ExitStack, command: list[str], folder: str, more: dict[str, str], ready: str) -> int:
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

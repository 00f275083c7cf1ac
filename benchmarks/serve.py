"""`sprung bench serve`: latency of POST /identify against a bare FastAPI echo of the same body.

Both are served by uvicorn in processes of their own and asked in turns over one kept-alive connection each, by the
same client, so that whatever else the machine does falls on both.
"""

from __future__ import annotations

import http.client
import json
import multiprocessing
import os
import socket
import tempfile
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import uvicorn
from fastapi import FastAPI

from sprung.benchmarks.serve_beside import beside_an_own_model
from sprung.model.identification.excitation import simulate_runs
from sprung.model.system import System, load_system
from sprung.service.app import create_app
from sprung.service.core import build_core
from sprung.service.monitoring.engine import load_engine
from sprung.service.monitoring.numerics import numerics
from sprung.service.settings import Settings

TARGET_MS = 15.0
WARM_UP = 20
BESIDE = 10  # vehicles with a window a second, beside one with a model of its own


def run(requests: int = 300, *, clients: int = 32, seconds: float = 5.0) -> Iterator[dict[str, Any]]:
    """Figures: latencies one request after the other, throughput with several clients, latencies beside a vehicle with
    a model of its own."""
    system = load_system()
    body = window_body(system)
    context = multiprocessing.get_context("spawn")
    with tempfile.TemporaryDirectory(prefix="sprung-bench-") as folder:
        ports = [free_port(), free_port()]
        servers = [
            context.Process(target=_serve_echo, args=(ports[0],), daemon=True),
            context.Process(target=serve_sprung, args=(ports[1], folder)),  # no daemon: it has children
        ]
        for server in servers:
            server.start()
        try:
            echo, identify = KeptConnection(ports[0], "/echo", body), KeptConnection(ports[1], "/identify", body)
            echo.wait()
            identify.wait()
            echo.connection = None  # idle while the other server started: it may have been closed
            times = np.array([(echo.ask(), identify.ask()) for _ in range(WARM_UP + requests)])[WARM_UP:] * 1e3
            yield from _latencies(times, len(body))
            yield from _throughput(ports[1], body, clients, seconds)
            others = partial(_ask_together, ports[1], body, BESIDE, 2 * seconds, rate=float(BESIDE))
            yield from beside_an_own_model(ports[1], body, lambda: others()[1])
        finally:
            for server in servers:
                server.terminate()
                server.join(20)


def window_body(system: System) -> bytes:
    """One simulated window of the nominal vehicle as a client would send it."""
    truth = np.zeros((1, len(system.parameters)))
    values = simulate_runs(system, truth, system.window, np.random.default_rng(5)).values[0]
    channels = {c.name: values[:, i].tolist() for i, c in enumerate(system.channels)}
    return json.dumps({"vehicle": "bench", "sample_rate": system.sample_rate, "channels": channels}).encode()


@dataclass(slots=True)
class KeptConnection:
    """One kept-alive connection."""

    port: int
    path: str
    body: bytes
    connection: http.client.HTTPConnection | None = None

    def wait(self, seconds: float = 120.0) -> None:
        """Until the server answers."""
        deadline = time.monotonic() + seconds
        while True:
            try:
                self.ask()
                return
            except (OSError, http.client.HTTPException):
                self.connection = None
                if time.monotonic() > deadline:
                    raise
                time.sleep(0.2)

    def ask(self) -> float:
        """Seconds from the request to the whole answer."""
        if self.connection is None:
            self.connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=30)
            self.connection.connect()
            self.connection.sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        started = time.perf_counter()
        self.connection.request("POST", self.path, self.body, {"content-type": "application/json"})
        answer = self.connection.getresponse()
        text = answer.read()
        ended = time.perf_counter()
        if answer.status != 200:
            raise ValueError(f"{self.path}: status {answer.status}: {text[:200]!r}")
        return ended - started


def _latencies(times: Any, size: int) -> Iterator[dict[str, Any]]:
    for name, column in (("echo", times[:, 0]), ("identify", times[:, 1])):
        low, middle, high = np.percentile(column, [50, 95, 99])
        yield {
            "figure": f"latency, {name}",
            "value": round(float(low), 2),
            "unit": "ms",
            "p95": round(float(middle), 2),
            "p99": round(float(high), 2),
            "requests": len(column),
            "body_bytes": size,
        }
    yield {
        "figure": "p50 of identify less p50 of echo",
        "value": round(float(np.median(times[:, 1]) - np.median(times[:, 0])), 2),
        "unit": "ms",
        "target": f"<= {TARGET_MS:g}",
        "cores": os.cpu_count(),
    }


def _throughput(port: int, body: bytes, clients: int, seconds: float) -> Iterator[dict[str, Any]]:
    """Windows per second of one client and of many, who share batches; then latencies at half of what was reached."""
    alone, _ = _ask_together(port, body, 1, seconds)
    yield {"figure": "windows identified per second over HTTP, one client", "value": round(alone, 1), "unit": "1/s"}
    many, _ = _ask_together(port, body, clients, seconds)
    yield {
        "figure": "windows identified per second over HTTP",
        "value": round(many, 1),
        "unit": "1/s",
        "clients": clients,
        "times_one_client": round(many / alone, 2),
        "target": ">= 4 times one client",
    }
    reached, times = _ask_together(port, body, clients, seconds, rate=many / 2)
    low, high = np.percentile(times, [50, 99]) * 1e3
    yield {
        "figure": "latency at half load, p99 over p50",
        "value": round(float(high / low), 2),
        "p50_ms": round(float(low), 1),
        "p99_ms": round(float(high), 1),
        "windows_per_second": round(reached, 1),
        "target": "<= 3",
    }


def _ask_together(
    port: int, body: bytes, clients: int, seconds: float, rate: float | None = None
) -> tuple[float, np.ndarray[Any, Any]]:
    """Windows per second, and the seconds of each, of clients that ask at once.

    rate: windows a second of all clients together; None: as many as they can.
    """
    times: list[list[float]] = [[] for _ in range(clients)]
    begun = time.monotonic() + 0.2

    def ask(number: int) -> None:
        client = KeptConnection(port, "/identify", body)
        period = 0.0 if rate is None else clients / rate
        due = begun + number * period / clients
        while max(due, time.monotonic()) < begun + seconds:
            time.sleep(max(0.0, due - time.monotonic()))
            times[number].append(client.ask())
            due += period

    threads = [threading.Thread(target=ask, args=(number,)) for number in range(clients)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    found = np.concatenate([np.array(part) for part in times])
    return len(found) / seconds, found


def free_port() -> int:
    """One that nobody listens on just now."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
    return port


def _serve_echo(port: int) -> None:
    app = FastAPI()

    @app.post("/echo")
    async def echo(body: dict[str, Any]) -> dict[str, Any]:
        return body

    uvicorn.run(app, port=port, log_level="error", access_log=False)


def serve_sprung(port: int, folder: str) -> None:
    """The service on the store of a folder, until the process is ended."""
    settings = Settings(data_dir=Path(folder))
    with numerics(load_engine(settings), settings) as found:
        app = create_app(build_core(settings, found.engine, found.following, found.processes))
        uvicorn.run(app, port=port, log_level="error", access_log=False)

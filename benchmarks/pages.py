"""`sprung bench pages`: what a person waits for: the list of a large fleet, a vehicle's page, a month of its history.

The service runs in a process of its own on a store that was filled before; the client asks over one kept-alive
connection, as a browser does, and takes compressed answers.
"""

from __future__ import annotations

import http.client
import multiprocessing
import re
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import urlencode

import numpy as np
from sqlalchemy import insert

from sprung.benchmarks.serve import free_port, serve_sprung
from sprung.model.identification.excitation import simulate_runs
from sprung.model.signals import Window
from sprung.model.system import System
from sprung.service.core import Core, build_core
from sprung.service.monitoring.engine import load_engine
from sprung.service.settings import Settings
from sprung.service.store import fleet, status
from sprung.service.store.schema import rollups
from sprung.service.store.windows import pack
from sprung.service.times import NANOSECONDS, now_ns

VEHICLE = "car-0099"  # the first that is out of specification
ASSETS = re.compile(r'<(?:script|img)[^>]* src="([^"]+)"|<link[^>]* href="([^"]+)"')
WARM_UP = 5
DAYS = 30
LISTS = ("/", "/?page=20", "/?q=car-1", "/?health=out_of_specification", "/vehicles?sort=urgency&limit=100")


def run(vehicles: int = 2000, requests: int = 100, seed: int = 1) -> Iterator[dict[str, Any]]:
    """Figures: latencies of the fleet's lists, bytes of a vehicle's page, a month of every parameter."""
    with tempfile.TemporaryDirectory(prefix="sprung-bench-") as folder:
        last = filled(Path(folder), vehicles, seed)
        with _served(folder) as port:
            yield from _latencies(Asking(port), requests, vehicles)
            yield _first_load(Asking(port))
            yield _month(Asking(port), requests, last)


@dataclass(slots=True)
class WireAnswer:
    """What came, as it came over the wire."""

    body: bytes
    text: str  # what it means, if it is not compressed
    seconds: float


class Asking:
    """One kept-alive connection."""

    def __init__(self, port: int) -> None:
        self._connection = http.client.HTTPConnection("127.0.0.1", port, timeout=60)

    def get(self, path: str, compressed: bool = True) -> WireAnswer:
        """Raises ValueError for anything but 200."""
        begun = time.perf_counter()
        self._connection.request("GET", path, headers={"Accept-Encoding": "gzip"} if compressed else {})
        answer = self._connection.getresponse()
        body = answer.read()
        seconds = time.perf_counter() - begun
        if answer.status != 200:
            raise ValueError(f"{path}: status {answer.status}: {body[:200]!r}")
        return WireAnswer(body, "" if compressed else body.decode(), seconds)


def filled(folder: Path, vehicles: int, seed: int) -> int:
    """Fill a store: vehicles, every hundredth out of specification, a month of one; where the month ends, s."""
    core = build_core(Settings(data_dir=folder), load_engine(Settings(data_dir=folder)))
    rng = np.random.default_rng(seed)
    end = now_ns() // NANOSECONDS // 3600 * 3600
    try:
        with core.store.write() as connection:
            for number in range(vehicles):
                vehicle, bad = f"car-{number:04d}", number % 100 == 99
                fleet.ensure_vehicle(connection, vehicle, number)
                drift = float(rng.normal(0, 0.02)) - (0.3 if bad else 0.0)
                stands = status.Status(
                    "out_of_specification" if bad else "ok",
                    int(bad),
                    0,
                    "secondary_1l.damping",
                    drift,
                    0.01,
                    0.03,
                    1.0,
                    "o" * len(core.engine.system.file.elements),
                    now_ns(),
                )
                new = status.NewStatus(vehicle, core.pipeline.model_id, 1, stands, Counter(used=1000))
                status.save_statuses(connection, [new], now_ns())
        core.pipeline.process(VEHICLE, _windows(core.engine.system, end, rng))
        _add_month(core, end, rng)
    finally:
        core.close()
    return end


def _windows(system: System, end: int, rng: np.random.Generator, count: int = 4) -> list[Window]:
    truth = np.zeros((count, len(system.parameters)))
    values = simulate_runs(system, truth, system.window, rng).values
    return [Window((end - count + i) * NANOSECONDS, system.sample_rate, values[i], "used", None) for i in range(count)]


def _add_month(core: Core, end: int, rng: np.random.Generator) -> None:
    """Minutes and hours of thirty days, as they are left when single windows are forgotten."""
    size = len(core.engine.system.tracked)
    rows = []
    for level in (60, 3600):
        for bucket in range(end - DAYS * 86_400, end - 3600, level):
            mean, std = pack(rng.normal(0.0, 0.01, size)), pack(np.full(size, 0.01))
            place = {"vehicle_id": VEHICLE, "model_id": core.pipeline.model_id, "resolution_s": level}
            counted = {"bucket_ns": bucket * NANOSECONDS, "windows": 2 * level, "updated_ns": bucket * NANOSECONDS}
            rows.append(place | counted | {"mean": mean, "std": std, "low": mean, "high": mean})
    with core.store.write() as connection:
        connection.execute(insert(rollups), rows)


@contextmanager
def _served(folder: str) -> Iterator[int]:
    port = free_port()
    server = multiprocessing.get_context("spawn").Process(target=serve_sprung, args=(port, folder), daemon=True)
    server.start()
    try:
        deadline = time.monotonic() + 120.0
        while True:
            try:
                Asking(port).get("/health/live")
                break
            except OSError:
                if time.monotonic() > deadline:
                    raise
                time.sleep(0.2)
        yield port
    finally:
        server.terminate()
        server.join(20)


def _latencies(asking: Asking, requests: int, vehicles: int) -> Iterator[dict[str, Any]]:
    for path in LISTS:
        times = np.array([asking.get(path).seconds for _ in range(WARM_UP + requests)])[WARM_UP:] * 1e3
        low, high = np.percentile(times, [50, 95])
        yield {
            "figure": f"GET {path}",
            "value": round(float(high), 1),
            "unit": "ms, p95",
            "p50_ms": round(float(low), 1),
            "vehicles": vehicles,
            "target": "<= 200",
        }


def _first_load(asking: Asking) -> dict[str, Any]:
    page = f"/pages/vehicles/{VEHICLE}"
    named = {first or second for first, second in ASSETS.findall(asking.get(page, compressed=False).text)}
    history = f"/vehicles/{VEHICLE}/history?parameter=secondary_1l.damping&format=columns"  # what its script asks for
    loaded = [page, *sorted(name for name in named if not name.startswith("data:")), history]
    size = sum(len(asking.get(path).body) for path in loaded)
    return {
        "figure": "first load of a vehicle's page",
        "value": round(size / 1e3, 1),
        "unit": "kB, compressed",
        "requests": len(loaded),
        "target": "<= 300",
    }


def _month(asking: Asking, requests: int, end: int) -> dict[str, Any]:
    names = re.findall(r'id="p-([^"]+)"', asking.get(f"/pages/vehicles/{VEHICLE}", compressed=False).text)
    span = {"since": end - DAYS * 86_400, "until": end, "format": "columns"}
    path = f"/vehicles/{VEHICLE}/history?{urlencode([*span.items(), *(('parameter', name) for name in names)])}"
    answers = [asking.get(path) for _ in range(WARM_UP + requests // 4)][WARM_UP:]
    low, high = np.percentile([1e3 * answer.seconds for answer in answers], [50, 95])
    return {
        "figure": f"{DAYS} days of {len(names)} parameters",
        "value": round(float(high), 1),
        "unit": "ms, p95",
        "p50_ms": round(float(low), 1),
        "kilobytes": round(len(answers[0].body) / 1e3, 1),
        "target": "<= 300",
    }

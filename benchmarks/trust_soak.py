"""An hour of ordinary work: windows of several vehicles, recordings, people who look; whether memory grows."""

from __future__ import annotations

import http.client
import json
import time
from collections import Counter
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from sprung.benchmarks.generator import read_vehicle
from sprung.benchmarks.generator.files import write_mcap
from sprung.benchmarks.trust_clients import multipart
from sprung.benchmarks.trust_load import START_SECONDS, watched
from sprung.model.identification.excitation import simulate_runs
from sprung.model.signals import FloatArray
from sprung.model.system import MANCHESTER, System, load_system
from sprung.service.times import NANOSECONDS

VEHICLES, CLIENTS = 6, 3  # each vehicle sends a window a second
WARM_UP = 1 / 7  # of the time: ten minutes of seventy
UPLOAD_EVERY, UPLOAD_SECONDS = 180.0, 30.0  # s; of a recording
LOOK_EVERY = 10.0  # s
LOOKED_AT = (
    "/",
    "/vehicles/load-1",
    "/vehicles/load-1/history?parameter=secondary_1l.stiffness",
    "/metrics",
    "/vehicles",
)


def soak(folder: Path, minutes: float) -> Iterator[dict[str, Any]]:
    """Figures of one run: latencies, losses, and how the memory of the service grew."""
    beside = Counter[str]()
    others = (partial(_upload, folder=folder, beside=beside), partial(_look, beside=beside))
    yield from watched(folder / "soak", minutes, VEHICLES, CLIENTS, others, WARM_UP)
    yield {"figure": "beside the windows", "value": dict(sorted(beside.items()))}


def _upload(port: int, ends: float, folder: Path, beside: Counter[str]) -> None:
    """A recording now and then, of a vehicle of its own whose time goes on; each until its job has ended."""
    system, vehicle = load_system(), read_vehicle(MANCHESTER)
    values = _ride(system)
    number = 0
    while time.monotonic() < ends - UPLOAD_EVERY:
        start = (START_SECONDS + round(number * UPLOAD_SECONDS)) * NANOSECONDS
        path = folder / "upload.mcap"
        write_mcap(path, vehicle, values, "upload", start)
        form = multipart(path.read_bytes(), f"{number}.mcap", "upload")
        status, job = _ask(port, "POST", "/recordings", form, "multipart/form-data; boundary=frontier")
        while status == 202 and job.get("state") in ("queued", "running"):
            time.sleep(1.0)
            job = _ask(port, "GET", f"/jobs/{job['id']}")[1]
        beside[f"uploads {job.get('state', status)}"] += 1
        number += 1
        time.sleep(UPLOAD_EVERY)


def _look(port: int, ends: float, beside: Counter[str]) -> None:
    """Pages, metrics and lists, in turn."""
    number = 0
    while time.monotonic() < ends:
        status, _ = _ask(port, "GET", LOOKED_AT[number % len(LOOKED_AT)])
        beside[f"looked at {status}"] += 1
        number += 1
        time.sleep(LOOK_EVERY)


def _ride(system: System) -> FloatArray:
    """Samples of one upload, shape (T, C)."""
    truth = np.zeros((1, len(system.parameters)))
    samples = round(UPLOAD_SECONDS * system.sample_rate)
    values: FloatArray = simulate_runs(system, truth, samples, np.random.default_rng(6)).values[0]
    return values


def _ask(port: int, method: str, path: str, body: bytes = b"", kind: str = "application/json") -> tuple[int, Any]:
    """Status, and JSON where the answer is some; 0 for none."""
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=60)
    try:
        connection.request(method, path, body or None, {"content-type": kind} if body else {})
        answer = connection.getresponse()
        text = answer.read()
        answered = json.loads(text) if "json" in (answer.getheader("content-type") or "") else {}
        return answer.status, answered
    except (OSError, http.client.HTTPException):
        return 0, {}
    finally:
        connection.close()

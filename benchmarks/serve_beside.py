"""How long windows of vehicles with the service's file take while one vehicle has a model of its own."""

from __future__ import annotations

import http.client
import json
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from typing import Any

import numpy as np

from sprung.model.system import MANCHESTER

LAW = "laws: [{coulomb_friction: {force: {value: 300, std: 30}, smoothing: {value: 0.02, fixed: true}}}]"
LAWS = 4  # one in each secondary damper
START_SECONDS = 1_790_000_000
Ask = Callable[[], "np.ndarray[Any, Any]"]


def beside_an_own_model(port: int, body: bytes, ask: Ask) -> Iterator[dict[str, Any]]:
    """Figures of the others, alone and beside.

    body: a window of vehicle "bench"; ask: sends windows of the others for a while and gives their seconds.
    """
    own = OwnVehicle(port, body)
    own.prepare()
    alone = ask()
    with own:
        beside = ask()
    low, high = (float(np.percentile(times, 99) * 1e3) for times in (alone, beside))
    yield {
        "figure": "p99 of other vehicles, beside one with a model of its own over alone",
        "value": round(high / low, 2),
        "p99_ms": round(high, 1),
        "p99_alone_ms": round(low, 1),
        "p50_ms": round(float(np.median(beside) * 1e3), 1),
        "p50_alone_ms": round(float(np.median(alone) * 1e3), 1),
        "laws": LAWS,
    }
    yield {
        "figure": "windows of the vehicle with a model of its own",
        "value": len(own.seconds),
        "p50_seconds": round(float(np.median(own.seconds)), 2) if own.seconds else None,
    }


class OwnVehicle:
    """A vehicle whose dampers have friction, and which sends a window as soon as the one before is answered."""

    def __init__(self, port: int, body: bytes) -> None:
        self.seconds: list[float] = []  # that each window took
        self._port = port
        self._parts = body.split(b'"bench"')
        self._sent = 0
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run)

    def prepare(self) -> None:
        """Make the vehicle known and give it its model."""
        self._window()
        nominal = "damping: 2.0e+4}"
        text = MANCHESTER.read_text("utf-8").replace(nominal, f"{nominal[:-1]}, {LAW}}}", LAWS)
        self._ask("/vehicles/own/model", json.dumps({"system": text}).encode())
        self._window()

    def __enter__(self) -> OwnVehicle:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._ended.is_set():
            begun = time.perf_counter()
            self._window()
            self.seconds.append(time.perf_counter() - begun)

    def _window(self) -> None:
        self._sent += 1
        start = f', "start": "{START_SECONDS + self._sent}"}}'.encode()
        self._ask("/identify?track=true", self._parts[0] + b'"own"' + self._parts[1][:-1] + start)

    def _ask(self, path: str, body: bytes) -> None:
        with closing(http.client.HTTPConnection("127.0.0.1", self._port, timeout=120)) as connection:
            connection.request("POST", path, body, {"content-type": "application/json"})
            answer = connection.getresponse()
            text = answer.read()
        if answer.status != 200:
            raise ValueError(f"{path}: status {answer.status}: {text[:300]!r}")

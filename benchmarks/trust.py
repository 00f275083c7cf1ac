"""`sprung bench trust`: the service is killed at random moments while windows are sent; what it acknowledged counts.

Each kill is SIGKILL to a real `sprung serve` on an SQLite store; the client sends on as soon as the next one answers.
At the end every acknowledged window must be in the store, once.
"""

from __future__ import annotations

import http.client
import json
import os
import random
import signal
import socket
import sqlite3
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from sprung.benchmarks.serve import window_body
from sprung.model.system import load_system

START_SECONDS = 1_790_000_000
HOP_SECONDS = 0.5
READY_SECONDS = 180.0


def run(kills: int = 5, *, seconds: float = 3.0, seed: int = 1) -> Iterator[dict[str, Any]]:
    """Figures: windows acknowledged, lost and doubled; the store's own check.

    seconds: the longest time from ready to the kill.
    """
    randomly = random.Random(seed)
    body = json.loads(window_body(load_system()))
    with tempfile.TemporaryDirectory(prefix="sprung-trust-") as folder:
        sender = Sender(body)
        sender.start()
        restarts = []
        for _ in range(kills):
            with Served(Path(folder)) as served:
                restarts.append(served.ready())
                sender.port = served.port
                time.sleep(randomly.uniform(0.05, seconds))
                served.kill()
        with Served(Path(folder)) as served:
            restarts.append(served.ready())
            sender.port = served.port
            time.sleep(seconds)
            sender.stop()
        yield from _figures(Path(folder) / "sprung.db", sender.acknowledged, kills, max(restarts))


class Served:
    """A `sprung serve` in a process of its own."""

    def __init__(self, folder: Path) -> None:
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            self.port: int = probe.getsockname()[1]
        command = [sys.executable, "-m", "sprung", "serve", "--port", str(self.port), "--data-dir", str(folder)]
        self.process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)

    def __enter__(self) -> Served:
        return self

    def __exit__(self, *_: object) -> None:
        self.kill()

    def ready(self) -> float:
        """Seconds until it answers."""
        begun = time.monotonic()
        while time.monotonic() - begun < READY_SECONDS:
            try:
                connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=5)
                connection.request("GET", "/health/ready")
                if connection.getresponse().status == 200:
                    return time.monotonic() - begun
            except OSError:
                time.sleep(0.1)
        raise ValueError("the service did not become ready")

    def kill(self) -> None:
        """SIGKILL."""
        if self.process.poll() is None:
            os.kill(self.process.pid, signal.SIGKILL)
        self.process.wait()


class Sender(threading.Thread):
    """Sends one window after the other, each until it is acknowledged."""

    def __init__(self, body: dict[str, Any]) -> None:
        super().__init__(daemon=True)
        self.port: int | None = None
        self.acknowledged: list[int] = []  # starts, ns
        self._body = body
        self._stopping = threading.Event()

    def stop(self) -> None:
        """End after the window that is being sent."""
        self._stopping.set()
        self.join(30)

    def run(self) -> None:
        """Send until stopped."""
        number = 0
        while not self._stopping.is_set():
            start = START_SECONDS + number * HOP_SECONDS
            if self._send(start):
                self.acknowledged.append(round(start * 1e9))
                number += 1
            else:
                time.sleep(0.05)

    def _send(self, start: float) -> bool:
        if self.port is None:
            return False
        text = json.dumps(self._body | {"start": str(start)}).encode()
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=30)
        try:
            connection.request("POST", "/identify?track=true", text, {"content-type": "application/json"})
            answer = connection.getresponse()
            answer.read()
            return answer.status == 200
        except (OSError, http.client.HTTPException):
            return False
        finally:
            connection.close()


def _figures(path: Path, acknowledged: list[int], kills: int, slowest: float) -> Iterator[dict[str, Any]]:
    with sqlite3.connect(path) as store:
        stored = [row[0] for row in store.execute("SELECT start_ns FROM windows")]
        check = store.execute("PRAGMA integrity_check").fetchone()[0]
    store.close()
    yield {"figure": "windows acknowledged", "value": len(acknowledged), "kills": kills}
    yield {"figure": "acknowledged windows lost", "value": len(set(acknowledged) - set(stored)), "target": "0"}
    yield {"figure": "windows doubled", "value": len(stored) - len(set(stored)), "target": "0"}
    yield {"figure": "integrity check of the store", "value": check, "target": "ok"}
    yield {"figure": "slowest start to ready", "value": round(slowest, 1), "unit": "s"}

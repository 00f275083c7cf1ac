"""`sprung fleet demo`: the fleet variant on one machine, with vehicles that replay the bundled recording."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from urllib.request import urlopen

from sprung.service.errors import UserError
from sprung.service.fleet import local_postgres as postgres
from sprung.service.fleet.tasks import ray_installed

RECORDING = Path(__file__).resolve().parents[2] / "tests" / "data" / "drift-600s.blf"
SPEED = "10"  # times real time


def run(vehicles: int, port: int) -> int:
    """Start a database, the pages, the ingest and some vehicles; end them all when stopped."""
    if not RECORDING.exists():
        raise UserError(f"{RECORDING}: is not here; the demo needs a clone of the repository")
    with ExitStack() as stack:
        folder = stack.enter_context(tempfile.TemporaryDirectory(prefix="sprung-fleet-"))
        environment = os.environ | {"SPRUNG_DATA_DIR": folder}
        reason = postgres.missing()
        if reason:
            print(f"sprung fleet demo: {reason}; the store is SQLite, and one process takes all")
        else:
            environment["SPRUNG_STORE"] = stack.enter_context(postgres.server(durable=True)).database()
        started: list[subprocess.Popen[bytes]] = []
        stack.callback(_end, started)
        signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))

        def start(*arguments: str) -> None:
            command = [sys.executable, "-m", "sprung", *arguments]
            # out of this terminal's reach: Ctrl-C ends them once, in order, and not twice and all at once
            started.append(subprocess.Popen(command, env=environment, start_new_session=True))

        start("serve", "--port", str(port))
        pages = server = f"http://127.0.0.1:{port}"
        if not reason and ray_installed():
            start("fleet", "serve", "--port", str(port + 100), "--workers", "2", "--cores", "0.5")
            server = f"http://127.0.0.1:{port + 100}"
        print("sprung fleet demo: the vehicles start once the services answer", file=sys.stderr, flush=True)
        try:
            wait_ready({pages, server}, started)
            for number in range(vehicles):
                name = f"demo-{number + 1:04d}"
                where = f"{folder}/{name}.db"
                ways = ("--server", server, "--recordings", pages)
                start("edge", str(RECORDING), "--vehicle", name, *ways, "--speed", SPEED, "--spool", where)
            while started[0].poll() is None:
                time.sleep(0.5)
        except KeyboardInterrupt:
            pass
    return 0


def wait_ready(services: set[str], started: Sequence[subprocess.Popen[bytes]]) -> None:
    """Return when every service is ready: earlier messages of vehicles would only wait on board.

    Raises UserError when one of the processes that were started ends before.
    """
    while services:
        if any(process.poll() is not None for process in started):
            raise UserError("a service of the fleet ended before it was ready; its last lines say why")
        services = {service for service in services if not _ready(service)}
        time.sleep(0.5)


def _ready(service: str) -> bool:
    try:
        with urlopen(f"{service}/health/ready", timeout=5):  # nosec B310: http, of this machine
            return True
    except OSError:  # not listening yet, or not ready
        return False


def _end(started: list[subprocess.Popen[bytes]]) -> None:
    for process in reversed(started):
        process.send_signal(signal.SIGINT)
    for process in started:
        try:
            process.wait(30)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()

"""A service at work: a real server in a thread, a vehicle that is in trouble."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

from sprung.model.system import System
from sprung.service.api.server import make_server
from sprung.service.app import create_app
from sprung.service.core import Core
from tests.service_fakes import make_window


@contextmanager
def served(core: Core) -> Iterator[int]:
    """The port of a real server."""
    server = make_server(create_app(core), core.settings, core.stopping.set)
    with socket.create_server(("127.0.0.1", 0)) as listening:
        thread = threading.Thread(target=server.run, kwargs={"sockets": [listening]}, daemon=True)
        thread.start()
        deadline = time.monotonic() + 30
        while not server.started:
            assert time.monotonic() < deadline
            time.sleep(0.02)
        yield listening.getsockname()[1]
        server.should_exit = True
        thread.join(20)


def worsen(core: Core, system: System) -> str:
    """Feed a vehicle whose parameters all grow by a third; its name."""
    core.pipeline.process("a", [make_window(system, i) for i in range(80)])
    core.pipeline.process("a", [make_window(system, 80 + i, 0.3) for i in range(60)])
    return "a"

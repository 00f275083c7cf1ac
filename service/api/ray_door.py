"""The door of the fleet variant in a replica of Ray Serve: with a server of its own, or behind Serve's proxies."""

from __future__ import annotations

import asyncio
import socket
from typing import Any

from sprung.service.fleet.serving_sizes import ServingSizes
from sprung.service.processes.imports import lasting_imports
from sprung.service.settings import Settings
from sprung.service.store import open_store

POLL_SECONDS = 0.02
BACKLOG = 1024  # connections that wait to be taken


def door_app(settings: Settings, sizes: ServingSizes, migrated: bool, compute: Any) -> Any:
    """The door's ASGI application; runs in its replica, and what it needs is imported there alone.

    migrated: the store has been, and need not be looked at; compute: handle of the deployment that it passes work to.
    """
    with lasting_imports():
        from ray import serve

        from sprung.service.api.live_ingest import ingest_app
        from sprung.service.fleet.ray_behind import RayBehind

    return ingest_app(settings, open_store(settings.store_url, migrated), RayBehind(compute, sizes, serve.batch))


class ListeningDoor:
    """Takes connections itself, with the same server and doorkeeper as the single process.

    Serve's proxy would pass every request on to another process, which costs as much as all that the door does.
    """

    async def __init__(  # type: ignore[misc]  # Serve awaits it
        self, settings: Settings, sizes: ServingSizes, migrated: bool, compute: Any
    ) -> None:
        """As `door_app`; returns when requests are taken."""
        app = door_app(settings, sizes, migrated, compute)
        with lasting_imports():
            from sprung.service.api.server import make_server
        self._server = make_server(app, settings, lambda: None)
        listening = bound(settings.host, settings.port)
        listening.listen(BACKLOG)
        self._serving = asyncio.create_task(self._server.serve([listening]))
        while not self._server.started:
            await self.check_health()
            await asyncio.sleep(POLL_SECONDS)

    async def check_health(self) -> None:
        """Serve asks now and then: raises where the server has ended."""
        if self._serving.done():
            raise RuntimeError("the door's server has ended")

    async def finish(self) -> None:
        """Take no more requests; returns when those that have come are answered."""
        self._server.should_exit = True
        await self._serving


def bound(host: str, port: int) -> socket.socket:
    """A socket at an address.  Raises OSError where another program has it."""
    family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
    made = socket.socket(family, kind, protocol)
    try:
        made.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        made.bind(address)
    except OSError:
        made.close()
        raise
    return made

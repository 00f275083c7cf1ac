"""The door of the fleet variant in a replica of Ray Serve: with a server of its own, or behind Serve's proxies."""

from __future__ import annotations

import asyncio
from typing import Any

from sprung.service.api.listening import open_socket
from sprung.service.fleet.serving_sizes import ServingSizes
from sprung.service.processes.imports import lasting_imports
from sprung.service.settings import Settings
from sprung.service.store import open_store

POLL_SECONDS = 0.02


def door_app(settings: Settings, sizes: ServingSizes, migrated: bool, compute: Any) -> Any:
    """The door's ASGI application; runs in its replica, and what it needs is imported there alone.

    migrated: the store has been, and need not be looked at; compute: handle of the deployment that it passes work to.
    """
    with lasting_imports():
        from ray import serve

        from sprung.service.api.live_ingest import ingest_app
        from sprung.service.fleet.ray_backend import RayBackend

    return ingest_app(settings, open_store(settings.store_url, migrated), RayBackend(compute, sizes, serve.batch))


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
        self._serving = asyncio.create_task(self._server.serve([open_socket(settings)]))
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

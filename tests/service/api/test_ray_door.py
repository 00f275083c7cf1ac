"""The door of the fleet variant as a server of its own: answers what has come, and says when it ends."""

from __future__ import annotations

import asyncio
import http.client
import socket
from pathlib import Path
from typing import Any

import pytest
from fastapi import FastAPI

from sprung.service.api import ray_door, ray_serving
from sprung.service.api.ray_door import ListeningDoor
from sprung.service.errors import UserError
from sprung.service.fleet.serving_sizes import ServingSizes
from sprung.service.settings import Settings


def slow_app(*_: Any) -> FastAPI:
    app = FastAPI()

    @app.get("/slow")
    async def slow() -> dict[str, str]:
        await asyncio.sleep(0.5)
        return {"status": "ok"}

    return app


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


async def opened(settings: Settings) -> ListeningDoor:
    """As a replica of Serve makes it."""
    door = ListeningDoor.__new__(ListeningDoor)
    await door.__init__(settings, ServingSizes(), True, None)  # type: ignore[misc]
    return door


def answered(port: int) -> int:
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=10)
    connection.request("GET", "/slow")
    status = connection.getresponse().status
    connection.close()
    return status


def test_requests_that_have_come_are_answered_before_it_ends(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ray_door, "door_app", slow_app)
    settings = Settings(data_dir=tmp_path, port=free_port())

    async def asked() -> None:
        door = await opened(settings)
        await door.check_health()
        asking = asyncio.create_task(asyncio.to_thread(answered, settings.port))
        await asyncio.sleep(0.2)
        await door.finish()
        assert await asking == 200
        with pytest.raises(RuntimeError, match="has ended"):
            await door.check_health()
        with pytest.raises(OSError):
            answered(settings.port)

    asyncio.run(asked())


def test_an_address_that_another_one_has_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ray_door, "door_app", slow_app)

    async def asked() -> None:
        with socket.socket() as other:
            other.bind(("127.0.0.1", 0))
            other.listen()
            with pytest.raises(OSError):
                await opened(Settings(data_dir=tmp_path, port=other.getsockname()[1]))

    asyncio.run(asked())


@pytest.mark.filterwarnings("ignore")  # Ray's own, when it is imported
def test_what_cannot_be_served_is_said_before_ray_starts(tmp_path: Path) -> None:
    pytest.importorskip("ray")
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        with pytest.raises(UserError, match=f"127.0.0.1:{port}: "):
            ray_serving.start(Settings(data_dir=tmp_path, port=port), ServingSizes(), None, 1)
    certificate = tmp_path / "certificate.pem"
    certificate.touch()
    secret = Settings(data_dir=tmp_path, tls_certificate=certificate)
    with pytest.raises(UserError, match="without TLS"):
        ray_serving.start(secret, ServingSizes(), "127.0.0.1:1", None)

"""The door of the fleet variant, with somebody behind it who folds at once: who may, what is refused, 429."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient

from sprung.model.signals import FloatArray
from sprung.model.system import System
from sprung.service.api.live_ingest import ingest_app
from sprung.service.engine import Engine
from sprung.service.errors import Busy
from sprung.service.fleet.ingest import Ingest, Taken, read_messages
from sprung.service.fleet.message import MEDIA_TYPE, Message, WindowEstimate, encode
from sprung.service.pipeline import Pipeline
from sprung.service.settings import Settings
from sprung.service.store import Store
from tests.service.fleet.test_ingest import messages


class AtOnce:
    """Does what Ray would have done, here."""

    def __init__(self, pipeline: Pipeline) -> None:
        self.engine = pipeline.engine
        self.ingest = Ingest(pipeline, 0.0)
        self.busy = False

    async def fold(self, body: bytes) -> Taken:
        if self.busy:
            raise Busy("too many requests wait; try again in a second")
        return (await asyncio.to_thread(self.ingest.take, read_messages([body])))[0]

    async def identify_and_fold(self, vehicle: str, start: int, values: FloatArray) -> Taken:
        estimate = self.engine.identify(values[None], starts=[start])[0][0]
        window = WindowEstimate(start, "used", None, 0, False, estimate)
        return await self.fold(encode(Message(vehicle, self.engine.digest, (window,)), "exact"))


@pytest.fixture
def behind(pipeline: Pipeline) -> AtOnce:
    return AtOnce(pipeline)


@pytest.fixture
def client(engine: Engine, store: Store, behind: AtOnce, tmp_path: Path) -> Iterator[TestClient]:
    with TestClient(ingest_app(Settings(data_dir=tmp_path), engine, store, behind)) as running:
        yield running


def window(system: System, **more: Any) -> dict[str, Any]:
    channels = {channel.name: [0.01] * system.window for channel in system.channels}
    return {"vehicle": "north-1", "sample_rate": 100.0, "channels": channels} | more


def test_windows_and_estimates_are_folded(client: TestClient, system: System, engine: Engine, behind: AtOnce) -> None:
    sent = messages(engine, system, 10, 10)[0]
    answer = client.post("/ingest/estimates", content=encode(sent, "exact"), headers={"content-type": MEDIA_TYPE})
    assert (answer.status_code, answer.json()["folded"]) == (200, 10)
    answer = client.post("/ingest/windows", json=window(system, start="2026-09-21T14:13:25Z"))
    assert (answer.status_code, answer.json()["folded"]) == (200, 1)
    again = client.post("/ingest/windows", json=window(system, start="2026-09-21T14:13:25Z"))
    assert again.json()["known"] == 1
    assert client.get("/health/ready").status_code == 200


def test_what_waits_too_long_is_429(client: TestClient, system: System, behind: AtOnce) -> None:
    behind.busy = True
    answer = client.post("/ingest/windows", json=window(system, start="2026-09-21T14:13:25Z"))
    assert answer.status_code == 429
    assert answer.headers["retry-after"] == "1"


@pytest.mark.parametrize(("change", "status"), [({"vehicle": None}, 422), ({"sample_rate": 50.0}, 422), ({}, 422)])
def test_windows_without_vehicle_start_or_the_right_rate_are_refused(
    client: TestClient, system: System, change: dict[str, Any], status: int
) -> None:
    more = {"start": "2026-09-21T14:13:25Z"} if change else {}
    assert client.post("/ingest/windows", json=window(system, **more) | change).status_code == status

"""The door of the fleet variant, with somebody behind it who folds at once: who may, what is refused, 429."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient

from sprung.model.system import System
from sprung.service.api.live_ingest import ingest_app
from sprung.service.errors import Busy
from sprung.service.fleet.ingest import Ingest
from sprung.service.fleet.message import (
    MEDIA_TYPE,
    IngestResult,
    Message,
    SentWindows,
    WindowEstimate,
    encode,
    read_messages,
)
from sprung.service.monitoring.engine import Engine
from sprung.service.monitoring.form import WindowForm
from sprung.service.monitoring.pipeline import Pipeline
from sprung.service.settings import Settings
from sprung.service.store import Store
from tests.service.fleet.test_ingest import messages


class AtOnce:
    """Does what Ray would have done, here."""

    def __init__(self, pipeline: Pipeline) -> None:
        self.engine = pipeline.engine
        self.ingest = Ingest(pipeline, 0.0)
        self.busy = False

    async def form(self) -> WindowForm:
        return self.engine.form

    async def fold(self, body: bytes) -> IngestResult:
        if self.busy:
            raise Busy("too many requests wait; try again in a second")
        return (await asyncio.to_thread(self.ingest.take, read_messages([body])))[0]

    async def identify_and_fold(self, sent: SentWindows) -> IngestResult:
        found = self.engine.identify(sent.values, starts=sent.starts)[0]
        windows = [WindowEstimate(s, "used", None, 0, False, e) for s, e in zip(sent.starts, found, strict=True)]
        return await self.fold(encode(Message(sent.vehicle, self.engine.digest, tuple(windows)), "exact"))


@pytest.fixture
def behind(pipeline: Pipeline) -> AtOnce:
    return AtOnce(pipeline)


@pytest.fixture
def client(engine: Engine, store: Store, behind: AtOnce, tmp_path: Path) -> Iterator[TestClient]:
    with TestClient(ingest_app(Settings(data_dir=tmp_path), store, behind)) as running:
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


def test_several_windows_of_a_vehicle_travel_in_one_request(client: TestClient, system: System) -> None:
    whole = window(system)
    parts = [{"start": f"2026-09-21T14:13:{20 + i}Z", "channels": whole["channels"]} for i in range(3)]
    body = {"vehicle": "north-1", "sample_rate": 100.0, "windows": parts}
    answer = client.post("/ingest/windows", json=body)
    assert (answer.status_code, answer.json()["folded"]) == (200, 3)
    again = client.post("/ingest/windows", json=body | {"windows": parts[1:]})
    assert (again.json()["folded"], again.json()["known"]) == (0, 2)


def test_what_is_wrong_with_several_windows_names_the_one(client: TestClient, system: System) -> None:
    good = {"start": "2026-09-21T14:13:20Z", "channels": window(system)["channels"]}
    short = good | {"channels": good["channels"] | {system.channels[0].name: [0.0]}}
    cases = {
        "windows.1.channels": [good, short],
        "windows.1.start is no": [good, good | {"start": "yesterday"}],
        "windows.1.start is more than": [good, good | {"start": "2099-09-21T14:13:20Z"}],
        "windows.1.start is needed": [good, {"channels": good["channels"]}],
        "windows should be": [],
    }
    for said, parts in cases.items():
        answer = client.post("/ingest/windows", json={"vehicle": "north-1", "sample_rate": 100.0, "windows": parts})
        assert answer.status_code == 422 and said in answer.text, (said, answer.text)

"""`POST /ingest/estimates`: who may, what is refused, and that sending twice is no harm."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from fastapi.testclient import TestClient

from sprung.model.system import System
from sprung.service.app import create_app
from sprung.service.core import build_core
from sprung.service.fleet.message import MEDIA_TYPE, Message, encode
from sprung.service.monitoring.engine import Engine
from sprung.service.settings import Settings
from tests.service.fleet.test_ingest import messages

HEADERS = {"content-type": MEDIA_TYPE}


@pytest.fixture
def client(engine: Engine, data_dir: Path) -> Iterator[TestClient]:
    with TestClient(create_app(build_core(Settings(data_dir=data_dir, late_seconds=0), engine))) as running:
        yield running


@pytest.fixture
def sent(engine: Engine, system: System) -> Message:
    return messages(engine, system, 20, 20)[0]


@pytest.mark.parametrize("coding", ["exact", "small"])
def test_estimates_reach_the_vehicle_once(client: TestClient, sent: Message, coding: str) -> None:
    for expected in ((20, 0), (0, 20)):
        answer = client.post("/ingest/estimates", content=encode(sent, coding), headers=HEADERS)  # type: ignore[arg-type]
        assert answer.status_code == 200, answer.text
        assert (answer.json()["folded"], answer.json()["known"]) == expected
    found = client.get("/vehicles/north-1").json()
    assert found["windows"]["used"] == 20
    assert found["parameters"][0]["identifiable"] is True


def test_estimates_of_another_model_are_a_conflict(client: TestClient, sent: Message) -> None:
    answer = client.post("/ingest/estimates", content=encode(replace(sent, model="x"), "small"), headers=HEADERS)
    assert answer.status_code == 409
    assert "same system file and weights" in answer.json()["detail"]


@pytest.mark.parametrize(
    ("content", "kind", "status"),
    [(b"nonsense", MEDIA_TYPE, 422), (b"", MEDIA_TYPE, 422), (b"{}", "application/json", 415)],
)
def test_what_is_no_message_is_refused(client: TestClient, content: bytes, kind: str, status: int) -> None:
    assert client.post("/ingest/estimates", content=content, headers={"content-type": kind}).status_code == status


def test_a_name_that_is_no_vehicle_is_refused(client: TestClient, sent: Message) -> None:
    body = encode(replace(sent, vehicle="../etc/passwd"), "small")
    assert client.post("/ingest/estimates", content=body, headers=HEADERS).status_code == 422


def test_a_token_of_another_fleet_or_without_the_scope_is_refused(client: TestClient, sent: Message) -> None:
    made: dict[str, str] = {}
    for name, scopes, fleet in (("admin", ["admin"], ""), ("south", ["ingest"], "south-"), ("reader", ["read"], "")):
        headers = {"authorization": f"Bearer {made['admin']}"} if made else {}
        answer = client.post("/tokens", json={"name": name, "scopes": scopes, "fleet": fleet}, headers=headers)
        made[name] = answer.json()["token"]
    for name, status in (("south", 403), ("reader", 403), ("admin", 200)):
        headers = HEADERS | {"authorization": f"Bearer {made[name]}"}
        assert client.post("/ingest/estimates", content=encode(sent, "small"), headers=headers).status_code == status

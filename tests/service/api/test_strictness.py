"""What is wrong is said: methods, query parameters, cursors, times and bodies."""

from __future__ import annotations

import asyncio

import pytest
from fastapi.testclient import TestClient
from pydantic import BaseModel
from starlette.types import Message, Receive, Scope, Send

from sprung.service.api import models
from sprung.service.api.limits import BodyLimit


@pytest.mark.parametrize(
    ("method", "path", "allowed"),
    [
        ("PUT", "/vehicles/day", "DELETE, GET, HEAD, PATCH"),
        ("PUT", "/vehicles", "GET, HEAD"),
        ("GET", "/vehicles/a/notes", "POST"),
        ("POST", "/openapi.json", "GET, HEAD"),
        ("POST", "/static/icon.svg", "GET, HEAD"),
    ],
)
def test_a_wrong_method_is_told_the_right_ones(client: TestClient, method: str, path: str, allowed: str) -> None:
    answer = client.request(method, path)
    assert answer.status_code == 405 and answer.headers["allow"] == allowed


@pytest.mark.parametrize(
    ("path", "field"),
    [
        ("/openapi.json?x=1", "x"),
        ("/vehicles?after=garbage", "after"),
        ("/vehicles?after=", "after"),
        ("/vehicles?after=%00", "after"),
        ("/vehicles?sort=drift&after=garbage", "after"),
        ("/alarms?after=1:%C2%B2", "after"),
        ("/alarms?after=1:99999999999999999999", "after"),
        ("/alarms?after=1_0:1", "after"),
        ("/jobs?after=99999999999999999999:a", "after"),
        ("/reports?after=%D9%A3:a", "after"),
        ("/vehicles?after=99999999999999999999:a", "after"),
        ("/vehicles?q=%00", "q"),
        ("/reports?verdict=missing_physic", "query.verdict"),
        ("/reports?verdict=", "query.verdict"),
        ("/vehicles/a/history?parameter=primary_11l.stiffness&since=20&until=10", "until"),
        ("/vehicles/a/history?format=csv&since=20&until=20", "until"),
    ],
)
def test_a_wrong_query_is_refused(client: TestClient, path: str, field: str) -> None:
    answer = client.get(path)
    assert answer.status_code == 422 and [error["field"] for error in answer.json()["errors"]] == [field]


@pytest.mark.parametrize("key", ["", "k" * 201])
def test_a_key_that_names_no_request_is_refused(client: TestClient, key: str) -> None:
    """Two requests without a key of their own would be taken for one, and the second never carried out."""
    for _ in range(2):
        answer = client.post("/vehicles/a/notes", json={"text": "wheels turned"}, headers={"Idempotency-Key": key})
        assert answer.status_code == 422
        assert [error["field"] for error in answer.json()["errors"]] == ["header.Idempotency-Key"]


@pytest.mark.parametrize(
    ("stated", "headers", "taken"),
    [(3_000_000, [], True), (3_000_000, [(b"expect", b"100-continue")], False), (2_000_000_000, [], False)],
)
def test_a_body_past_the_limit_is_taken_before_it_is_refused(
    stated: int, headers: list[tuple[bytes, bytes]], taken: bool
) -> None:
    """A connection that is closed on unread bytes is reset: the client would not see why."""
    events: list[str] = []
    pieces = iter(range(3))

    async def receive() -> Message:
        piece = next(pieces)
        events.append("taken")
        return {"type": "http.request", "body": b" " * 1_000_000, "more_body": piece < 2}

    async def send(message: Message) -> None:
        events.append(str(message.get("status", "body")))

    async def inner(scope: Scope, receive: Receive, send: Send) -> None:
        raise AssertionError

    scope = {
        "type": "http",
        "method": "POST",
        "path": "/identify",
        "headers": [(b"content-length", str(stated).encode()), *headers],
    }
    asyncio.run(BodyLimit(inner, 2_000_000, {})(scope, receive, send))
    assert events == [*(["taken"] * 3 if taken else []), "413", "body"]


@pytest.mark.parametrize(("body", "said"), [(b'{"text":', "is no JSON"), (b"[]", "object"), (b"3", "object")])
def test_a_body_that_is_none_is_reported_as_the_body(client: TestClient, body: bytes, said: str) -> None:
    answer = client.post("/vehicles/a/notes", content=body, headers={"Content-Type": "application/json"})
    assert answer.status_code == 422
    (error,) = answer.json()["errors"]
    assert error["field"] == "body" and said in error["detail"] and answer.json()["detail"].startswith("body: ")


def test_a_page_goes_on_from_a_cursor_and_from_an_id(client: TestClient, broken: str) -> None:
    following = client.get("/vehicles?limit=1").json()["next"]
    assert client.get("/vehicles", params={"after": following}).json()["vehicles"] == []
    assert client.get("/vehicles?after=a").json()["vehicles"] == []


def test_browsers_find_an_icon(client: TestClient) -> None:
    answer = client.get("/favicon.ico")
    assert client.get("/favicon.ico", headers={"Range": "bytes=999999-"}).content == answer.content
    assert answer.status_code == 200 and answer.headers["content-type"].startswith("image/svg+xml")
    assert client.get("/static/icon.svg?v=1").status_code == 200  # files keep a version in their address


def test_files_of_the_pages_are_sent_again_only_where_they_changed(client: TestClient) -> None:
    first = client.get("/static/vendor/swagger-ui-bundle.js")
    assert first.status_code == 200 and int(first.headers["content-length"]) == len(first.content) > 1_000_000
    assert first.headers["content-type"].startswith("text/javascript")
    again = client.get("/static/vendor/swagger-ui-bundle.js", headers={"If-None-Match": f"W/{first.headers['etag']}"})
    assert (again.status_code, again.content, again.headers["etag"]) == (304, b"", first.headers["etag"])
    assert client.get("/static/vendor").status_code == client.get("/static/%2e%2e/render.py").status_code == 404


def test_files_of_the_history_are_described(client: TestClient) -> None:
    found = client.get("/openapi.json").json()["paths"]["/vehicles/{id}/history"]["get"]["responses"]["200"]["content"]
    assert all(content["schema"] for content in found.values()) and len(found) >= 4


def test_answers_that_clients_are_made_from_have_examples(client: TestClient) -> None:
    paths = client.get("/openapi.json").json()["paths"]
    wanted = [
        ("/ingest/estimates", "post", "200", models.IngestAnswer),
        ("/fleet/knowledge", "get", "200", models.KnowledgeAnswer),
        ("/vehicles/{id}/models", "get", "200", models.VehicleModels),
        ("/reports/{id}", "get", "200", None),
        ("/tokens", "post", "201", None),
    ]
    for path, method, status, model in wanted:
        example = paths[path][method]["responses"][status]["content"]["application/json"]["example"]
        assert example, path
        if model is not None:
            assert issubclass(model, BaseModel)
            assert model.model_validate(example).model_dump().keys() == example.keys(), path

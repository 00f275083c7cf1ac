"""Every route of the description with ids and bodies that are none: an error that says what it is, never 500."""

from __future__ import annotations

from collections.abc import Iterator
from urllib.parse import quote

import pytest
from fastapi.testclient import TestClient

from sprung.service.api.bodies import VEHICLE_ID

IDS = ("..", "../../etc/passwd", "%2f", "a\0b", "\u202eabc", "x" * 300, "-1", "9" * 30, "'; --", "<script>", "NaN", " ")
BODIES = (b"", b"{}", b"[]", b'{"a": 1e400}', b"\xff\xfe")
JSON = {"content-type": "application/json"}


def wrong_requests(client: TestClient) -> Iterator[tuple[str, str, bytes | None]]:
    """Method, path and body of each route with each wrong id, of those without one with each wrong body."""
    for path, methods in client.get("/openapi.json").json()["paths"].items():
        for method in methods:
            if "{" in path:
                for one in IDS:
                    filled = "/".join(quote(one, safe="") if part.startswith("{") else part for part in path.split("/"))
                    yield method.upper(), filled, None if method == "get" else b"{}"
            elif method != "get":
                for body in BODIES:
                    yield method.upper(), path, body


@pytest.mark.parametrize("known", [False, True], ids=["empty", "with a vehicle"])
def test_wrong_ids_and_bodies_are_problems_on_every_route(
    client: TestClient, known: bool, request: pytest.FixtureRequest
) -> None:
    if known:
        request.getfixturevalue("broken")
    count = 0
    for method, path, body in wrong_requests(client):
        answer = client.request(method, path, content=body, headers=JSON, follow_redirects=False)
        asked = f"{method} {path} {body!r}: {answer.status_code}"
        assert answer.status_code < 500, asked
        if answer.status_code >= 400:
            assert answer.headers["content-type"] == "application/problem+json", asked
            assert {"type", "title", "status", "detail"} <= answer.json().keys(), asked
            count += 1
    assert count > 200


@pytest.mark.parametrize("path", ["/alarms", "/jobs", "/reports", "/recordings", "/events"])
def test_a_vehicle_that_cannot_be_is_no_filter(client: TestClient, path: str) -> None:
    """An empty list would say that such a vehicle has none."""
    for one in (*IDS, "car 17", "Über", ""):
        if VEHICLE_ID.fullmatch(one):
            continue  # may be one
        answer = client.get(path, params={"vehicle": one})
        assert answer.status_code == 422 and "vehicle: " in answer.json()["detail"], (one, answer.text)
    if path != "/events":
        assert client.get(path, params={"vehicle": "nobody-1"}).status_code == 200

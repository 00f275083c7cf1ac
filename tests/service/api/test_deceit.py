"""Names, texts and requests that would deceive who reads them somewhere else: a terminal, a proxy, another database."""

from __future__ import annotations

import gzip
import json
import logging
import socket
from pathlib import Path

import pytest
from fastapi.testclient import TestClient

from sprung.model.system import System
from sprung.service.core import Core, build_core
from sprung.service.monitoring.engine import Engine
from sprung.service.observability.logs import PlainLines
from tests.served import served
from tests.service.api.test_server import settings
from tests.service_fakes import make_window

DECEIVING = ["a\0b", "\x1b[31mred", "a\rb", "\x85", "\u202egnp.exe", "\u2066x", "a\u200bb", "a\u2028b"]


@pytest.mark.parametrize("route", ["/recordings", "/diagnose"])
@pytest.mark.parametrize(
    ("fields", "told"),
    [
        ([("vehicle", "car-1"), ("vehicle", "7")], "the form gives vehicle twice"),  # it was that of car-17
        ([("vehcile", "car-17")], "'vehcile' is no field of the form; it has file, vehicle, start"),
        ([("start", ""), ("start", "1790000000")], "the form gives start twice"),
        ([("file", "time,car_1l")], "file comes without its name"),
    ],
)
def test_a_form_that_says_something_twice_or_what_nobody_knows_is_refused(
    client: TestClient, core: Core, route: str, fields: list[tuple[str, str]], told: str
) -> None:
    parts = [f'--b\r\nContent-Disposition: form-data; name="{name}"\r\n\r\n{text}\r\n' for name, text in fields]
    file = '--b\r\nContent-Disposition: form-data; name="file"; filename="a.csv"\r\n\r\ntime,car_1l\r\n--b--\r\n'
    headers = {"content-type": "multipart/form-data; boundary=b"}
    answer = client.post(route, content="".join([*parts, file]).encode(), headers=headers)
    assert answer.status_code == 422 and told in answer.json()["detail"]
    assert client.get("/jobs").json()["jobs"] == [] and not list(core.settings.uploads.glob("*"))


@pytest.mark.parametrize("text", [*DECEIVING, "two\nlines"])
def test_labels_are_one_line_without_hidden_characters(
    core: Core, client: TestClient, system: System, text: str
) -> None:
    core.pipeline.process("a", [make_window(system, 0)])
    assert client.patch("/vehicles/a", json={"label": text}).status_code == 422
    assert client.patch("/vehicles/a", json={"label": "Größe 😀 <b>"}).status_code == 200


def test_notes_may_have_lines_and_tabs_and_nothing_else_hidden(core: Core, client: TestClient, system: System) -> None:
    core.pipeline.process("a", [make_window(system, 0)])
    for text in (text for text in DECEIVING if text != "a\rb"):
        assert client.post("/vehicles/a/notes", json={"text": text}).status_code == 422, text
    assert client.post("/vehicles/a/notes", json={"text": "two\r\nlines\tand more"}).status_code == 201


def test_people_are_told_which_character_is_hidden_and_where(core: Core, client: TestClient, system: System) -> None:
    core.pipeline.process("a", [make_window(system, 0)])
    told = client.post("/vehicles/a/notes", json={"text": "oil \u202echecked"}).json()["detail"]
    assert told == "text: holds the hidden character U+202E at place 5; leave it out"
    assert "128 characters" in client.patch("/vehicles/a", json={"label": "a" * 129}).json()["detail"]


def test_an_upload_is_called_without_hidden_characters(core: Core, client: TestClient) -> None:
    name = "\x1b[31m\u202ea.csv"
    form = f'--b\r\nContent-Disposition: form-data; name="file"; filename="{name}"\r\n\r\nx\r\n--b--\r\n'.encode()
    answer = client.post("/recordings", content=form, headers={"Content-Type": "multipart/form-data; boundary=b"})
    assert answer.status_code == 202
    detail = client.get("/audit").json()[0]["detail"]
    assert detail["name"] == "_[31m_a.csv"


def test_a_terminal_is_told_nothing_by_a_log() -> None:
    told = {"name": "x", "levelno": 40, "levelname": "ERROR", "msg": "%s", "args": ("\x1b[2Jof\x07\nx.csv",)}
    assert PlainLines().format(logging.makeLogRecord(told)) == r"sprung: ERROR: \x1b[2Jof\x07 x.csv"


def test_a_body_of_two_lengths_is_refused_and_the_connection_closed(engine: Engine, data_dir: Path) -> None:
    with (
        served(build_core(settings(data_dir), engine)) as port,
        socket.create_connection(("127.0.0.1", port), timeout=10) as line,
    ):
        two = b"POST /identify HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\nContent-Length: 5\r\n"
        line.sendall(two + b"Transfer-Encoding: chunked\r\n\r\n0\r\n\r\nGET /health/live HTTP/1.1\r\nHost: x\r\n\r\n")
        answer = b""
        while piece := line.recv(65536):  # until it is closed
            answer += piece
        assert answer.startswith(b"HTTP/1.1 400 ") and answer.count(b"HTTP/1.1") == 1
        assert b"give Content-Length or Transfer-Encoding" in answer


@pytest.mark.parametrize(
    "request_",
    [b"\x16\x03\x01\x02\x00", b"GET /\r\n\r\n", b"POST /identify HTTP/1.1\r\nHost: x\r\nContent-Length: +2\r\n\r\n{}"],
)
def test_what_is_no_http_is_answered_as_every_error(engine: Engine, data_dir: Path, request_: bytes) -> None:
    with (
        served(build_core(settings(data_dir), engine)) as port,
        socket.create_connection(("127.0.0.1", port), timeout=10) as line,
    ):
        line.sendall(request_ + b"\r\n\r\n")
        answer = b""
        while piece := line.recv(65536):
            answer += piece
    head, body = answer.split(b"\r\n\r\n")
    assert head.startswith(b"HTTP/1.1 400 ") and b"application/problem+json" in head
    assert json.loads(body)["status"] == 400


@pytest.mark.parametrize("version", ["0.9", "2.0", "3.0", "9.9", "1.0", "1.1", "1.9"])
def test_only_requests_in_a_version_that_is_spoken_here_are_answered(
    engine: Engine, data_dir: Path, version: str
) -> None:
    with (
        served(build_core(settings(data_dir), engine)) as port,
        socket.create_connection(("127.0.0.1", port), timeout=10) as line,
    ):
        line.sendall(f"GET /health/live HTTP/{version}\r\nHost: localhost\r\nConnection: close\r\n\r\n".encode())
        answer = b""
        while piece := line.recv(65536):
            answer += piece
    assert answer.startswith(b"HTTP/1.1 200 " if version[0] == "1" else b"HTTP/1.1 505 ")


@pytest.mark.parametrize("path", ["/vehicles/", "/signin/", "/identify/", "/static", "/vehicles//"])
def test_nobody_is_sent_to_the_host_that_he_names(client: TestClient, path: str) -> None:
    for method in ("GET", "POST"):
        answer = client.request(method, path, headers={"Host": "evil.localhost"}, follow_redirects=False)
        assert answer.status_code in (404, 405) and "location" not in answer.headers


@pytest.mark.parametrize("more", [b"Content-Length: 5\r\n", b""], ids=["refused at once", "read to its end"])
def test_a_body_that_goes_wrong_on_its_way_is_answered_once_and_logged_as_no_mistake_of_the_service(
    engine: Engine, data_dir: Path, caplog: pytest.LogCaptureFixture, more: bytes
) -> None:
    """Also when it comes in one piece with its head, before the application has begun to answer."""
    head = b"POST /identify HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\n"
    with (
        served(build_core(settings(data_dir), engine)) as port,
        socket.create_connection(("127.0.0.1", port), timeout=10) as line,
    ):
        line.sendall(head + more + b"Transfer-Encoding: chunked\r\n\r\n5\r\n{}   \r\n-1\r\n")
        answer = b""
        while piece := line.recv(65536):
            answer += piece
    assert answer.startswith(b"HTTP/1.1 400 ") and answer.count(b"HTTP/1.1 ") == 1
    assert [record.message for record in caplog.records if record.exc_info or record.levelno >= logging.ERROR] == []


def test_a_compressed_body_is_not_guessed_at(client: TestClient) -> None:
    headers = {"Content-Type": "application/json", "Content-Encoding": "gzip"}
    answer = client.post("/identify", content=gzip.compress(b"0" * 1_000_000), headers=headers)
    assert answer.status_code == 415 and answer.headers["accept-encoding"] == "identity"
    assert (
        client.post("/identify", content=b"{}", headers=headers | {"Content-Encoding": "Identity"}).status_code == 422
    )


def test_a_query_that_says_two_things_is_refused(client: TestClient) -> None:
    assert client.get("/vehicles?limit=5&limit=7").json()["detail"] == "limit: is there more than once"
    several = "/vehicles/a/history?parameter=primary_11l.stiffness&parameter=primary_11r.stiffness"
    assert client.get(several).status_code == 404  # of the vehicle

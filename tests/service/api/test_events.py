"""`GET /events`: who may follow, and what is sent."""

from __future__ import annotations

import json
from contextlib import ExitStack, closing
from http.client import HTTPConnection, HTTPResponse
from pathlib import Path

import pytest

from sprung.model.system import System
from sprung.service.api.guard import COOKIE
from sprung.service.core import build_core
from sprung.service.monitoring.engine import Engine
from sprung.service.settings import Settings
from tests.served import served
from tests.service_fakes import make_window


def test_whoever_may_read_follows_what_changes_and_nobody_else(engine: Engine, system: System, data_dir: Path) -> None:
    core = build_core(Settings(data_dir=data_dir, min_free_bytes=0), engine)
    texts = {scope: core.tokens.create(scope, [scope])[0] for scope in ("read", "ingest", "operate", "admin")}
    with served(core) as port:

        def follow(text: str) -> tuple[int, HTTPConnection, HTTPResponse]:
            connection = HTTPConnection("127.0.0.1", port, timeout=20)
            connection.request("GET", "/events", headers={"authorization": f"Bearer {text}"})
            answer = connection.getresponse()
            return answer.status, connection, answer

        for scope, text in texts.items():
            status, connection, _ = follow(text)
            connection.close()
            assert status == (403 if scope == "ingest" else 200), scope
        _, connection, answer = follow(texts["read"])
        with closing(connection):
            assert answer.headers["content-type"].startswith("text/event-stream")
            assert answer.readline() == b"retry: 3000\n"
            core.pipeline.process("north-1", [make_window(system, 2)])
            lines = [answer.readline().decode() for _ in range(3)]
        assert lines[1] == "event: vehicle\n" and json.loads(lines[2].removeprefix("data: "))["vehicle"] == "north-1"


def test_a_stream_ends_with_the_token_or_the_session_that_it_was_begun_with(
    engine: Engine, data_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("events.ASK_SECONDS", "events.LEAST_SECONDS"):
        monkeypatch.setattr(f"sprung.service.api.{name}", 0.02)
    core = build_core(Settings(data_dir=data_dir, min_free_bytes=0), engine)
    (first, row), (second, _) = (core.tokens.create(name, ["read"]) for name in ("first", "second"))
    session, _ = core.tokens.sign_in(second)
    given = [{"authorization": f"Bearer {text}"} for text in (first, second)] + [{"cookie": f"{COOKIE}={session}"}]
    with served(core) as port, ExitStack() as open_until_here:
        streams = []
        for headers in given:
            connection = open_until_here.enter_context(closing(HTTPConnection("127.0.0.1", port, timeout=20)))
            connection.request("GET", "/events", headers=headers)
            streams.append(open_until_here.enter_context(connection.getresponse()))
        core.tokens.revoke(row.id)
        assert streams[0].read() == b"retry: 3000\n\n"  # to its end
        core.tokens.sign_out(session)
        assert streams[2].read() == b"retry: 3000\n\n"
        assert not streams[1].isclosed()

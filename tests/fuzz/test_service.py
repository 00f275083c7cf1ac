"""A service under requests of somebody who means no good."""

from __future__ import annotations

from pathlib import Path

import pytest

from sprung.service.core import build_core
from sprung.service.monitoring.engine import Engine
from sprung.service.settings import Settings
from tests.fuzz.service import judged, run
from tests.served import served


def test_every_request_is_answered_or_refused(engine: Engine, data_dir: Path, caplog: pytest.LogCaptureFixture) -> None:
    settings = Settings(data_dir=data_dir, client_requests_per_second=1e6, client_broken_per_second=1e6)
    with served(build_core(settings, engine)) as port:
        found = run(port, 5.0, 2027)
    assert found.wrong == []
    assert [record.message for record in caplog.records if record.exc_info] == []
    assert {"200", "404", "422"} <= found.statuses.keys()


@pytest.mark.parametrize(
    ("answer", "wrong"),
    [
        (b"HTTP/1.1 500 X\r\n\r\n", "no reason"),
        (b"HTTP/1.1 503 X\r\n\r\n", ""),
        (b"HTTP/1.1 404 X\r\nContent-Type: text/plain\r\n\r\n", "no problem+json"),
        (b"HTTP/1.1 200 X\r\nSet-Cookie:x=1\r\n\r\n", "a head of the request's"),
        (b"HTTP/1.1 200 X\r\n\r\nroot:x:0:0", "a file of the machine"),
        (b"HTTP/1.1 200 X\r\n\r\nTraceback (most recent", "a traceback"),
    ],
)
def test_wrong_answers_are_seen(answer: bytes, wrong: str) -> None:
    assert judged(b"GET / HTTP/1.1", answer, 0.1) == wrong
    assert judged(b"GET / HTTP/1.1", b"HTTP/1.1 200 X\r\n\r\n", 9.0) == "slow"

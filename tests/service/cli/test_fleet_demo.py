"""The fleet's demo: vehicles begin when somebody takes what they send."""

from __future__ import annotations

import subprocess
import sys
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, HTTPServer

import pytest

from sprung.service.cli.fleet_demo import wait_ready
from sprung.service.errors import UserError


class Starting(BaseHTTPRequestHandler):
    """Not ready the first two times."""

    asked = 0

    def do_GET(self) -> None:
        type(self).asked += 1
        self.send_response(200 if self.path == "/health/ready" and self.asked > 2 else 503)
        self.end_headers()

    def log_message(self, *_given: object) -> None:
        """Says nothing."""


@pytest.fixture
def service() -> Iterator[str]:
    with HTTPServer(("127.0.0.1", 0), Starting) as server:
        threading.Thread(target=server.serve_forever, args=(0.05,), daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()


def test_it_waits_until_every_service_is_ready(service: str) -> None:
    wait_ready({service}, [])
    assert Starting.asked == 3


def test_a_service_that_ends_before_ends_the_demo() -> None:
    with subprocess.Popen([sys.executable, "-c", ""]) as ended:
        ended.wait()
        with pytest.raises(UserError, match="ended before it was ready"):
            wait_ready({"http://127.0.0.1:9"}, [ended])

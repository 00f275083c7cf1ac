"""Who holds connections: in total, from several addresses, and without taking what is answered."""

from __future__ import annotations

import asyncio
import gc
import socket
import time
import weakref
from collections.abc import Iterator
from contextlib import ExitStack, closing, suppress
from http.client import HTTPConnection
from pathlib import Path

import pytest

from sprung.service.api import server
from sprung.service.api.server import STALLED_SECONDS
from sprung.service.core import build_core
from sprung.service.monitoring.engine import Engine
from tests.served import served
from tests.service.api.test_server import ask, settings
from tests.service_fakes import eventually

HALF = b"GET /vehicles HTTP/1.1\r\nHost: loc"
UPLOAD = b"POST /recordings HTTP/1.1\r\nHost: localhost\r\nContent-Type: multipart/form-data; boundary=b\r\n"
UPLOAD += b'Content-Length: 1000\r\n\r\n--b\r\nContent-Disposition: form-data; name="file"; filename="a.csv"\r\n\r\n1'
ONE = b"GET /static/vendor/swagger-ui-bundle.js HTTP/1.1\r\nHost: localhost\r\n\r\n"  # 1.5 MB, without a token
LARGE = 5 * ONE  # more than the kernel holds for a client


def client(stack: ExitStack, port: int, host: str, data: bytes) -> socket.socket:
    """A client of an address of this machine that takes next to nothing by itself."""
    one = stack.enter_context(socket.socket())
    one.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2048)
    one.bind((host, 0))
    one.settimeout(10)
    one.connect(("127.0.0.1", port))
    one.sendall(data)
    return one


@pytest.mark.parametrize("data", [HALF, LARGE])
def test_many_addresses_together_do_not_lock_others_out(engine: Engine, data_dir: Path, data: bytes) -> None:
    limits = {"connections": 24, "client_connections": 10, "header_seconds": 60, "body_idle_seconds": 60}
    core = build_core(settings(data_dir, **limits), engine)
    with served(core) as port, ExitStack() as stack:
        for address in [f"127.0.0.{k}" for k in (2, 3, 4)] * 10:
            client(stack, port, address, data)
        deadline, served_others = time.monotonic() + STALLED_SECONDS + 20, 0
        while served_others < 3:
            with suppress(ConnectionError):  # the first seconds: their answers are still on the way
                served_others += b"200 OK" in ask(port)
            assert time.monotonic() < deadline
            time.sleep(0.2)


def test_an_answer_that_nobody_takes_is_given_up(engine: Engine, data_dir: Path) -> None:
    core = build_core(settings(data_dir, body_idle_seconds=1), engine)
    with served(core) as port, ExitStack() as stack:
        for data in (LARGE, 4 * ONE + ONE.replace(b"\r\n\r\n", b"\r\nConnection: close\r\n\r\n")):
            silent, taken = client(stack, port, "127.0.0.2", data), 0
            time.sleep(3.0)
            with suppress(ConnectionError):
                while piece := silent.recv(65536):
                    taken += len(piece)
            assert taken < 6_000_000
        assert len(ask(port, "/static/vendor/swagger-ui-bundle.js")) > 1_400_000


def test_others_are_served_while_slow_clients_are_answered(engine: Engine, data_dir: Path) -> None:
    """They take a little all the time, so that none of them only waits."""
    core = build_core(settings(data_dir, connections=24, client_connections=12), engine)
    with served(core) as port, ExitStack() as stack:
        slow = [client(stack, port, f"127.0.0.{2 + k % 2}", LARGE) for k in range(24)]
        for _ in range(5):
            for one in slow:
                with suppress(OSError):
                    one.recv(512)
            assert b"200 OK" in ask(port)
            time.sleep(0.1)


def test_who_is_refused_hears_why(engine: Engine, data_dir: Path) -> None:
    core = build_core(settings(data_dir, client_connections=2), engine)
    with served(core) as port, ExitStack() as stack:
        following = b"GET /events HTTP/1.1\r\nHost: localhost\r\n\r\n"
        for one in [client(stack, port, "127.0.0.1", following) for _ in range(2)]:
            assert one.recv(100).startswith(b"HTTP/1.1 200")
        answer = ask(port, headers="X-Long: " + 5000 * "x" + "\r\n")
        assert answer.startswith(b"HTTP/1.1 503")
        assert b"retry-after" in answer


@pytest.mark.parametrize("begun", [HALF, UPLOAD])
def test_requests_that_are_begun_and_broken_off_cost_their_client_the_next_connections(
    engine: Engine, data_dir: Path, begun: bytes
) -> None:
    core = build_core(settings(data_dir, client_broken_per_second=0.5), engine)
    with served(core) as port, ExitStack() as stack:
        for _ in range(3):
            client(stack, port, "127.0.0.2", begun).close()
        deadline = time.monotonic() + 10
        answer = b""
        while b"503" not in answer:  # as soon as the server has seen that the client is gone
            assert time.monotonic() < deadline
            answer = client(stack, port, "127.0.0.2", b"GET /health/live HTTP/1.1\r\nHost: localhost\r\n\r\n").recv(100)
        assert b"200 OK" in ask(port)


def test_what_is_given_up_does_not_stay_in_the_kernel(engine: Engine, data_dir: Path) -> None:
    core = build_core(settings(data_dir, body_idle_seconds=1), engine)
    with served(core) as port, ExitStack() as stack:
        silent, taken = client(stack, port, "127.0.0.2", ONE), 0
        time.sleep(3.0)
        with pytest.raises(ConnectionResetError):
            while taken < 1_500_000:
                taken += len(silent.recv(65536)) or 1_500_000
        assert taken < 400_000


@pytest.mark.parametrize("chunked", [False, True], ids=["stated", "in chunks"])
@pytest.mark.parametrize("path", ["/identify", "/vehicles/v/notes"])
def test_who_sends_far_too_much_reads_why(engine: Engine, data_dir: Path, path: str, chunked: bool) -> None:
    """It sends all before it reads: a connection that were closed meanwhile would be reset, and the answer lost."""
    body: bytes | Iterator[bytes] = (b" " * 1_000_000 for _ in range(40)) if chunked else b" " * 40_000_000
    with served(build_core(settings(data_dir), engine)) as port:
        with closing(HTTPConnection("127.0.0.1", port, timeout=20)) as connection:
            connection.request("POST", path, body, {"content-type": "application/json"}, encode_chunked=chunked)
            answer = connection.getresponse()
            assert answer.status == 413 and b"the body is longer than" in answer.read()
        assert b"200 OK" in ask(port)


def test_a_body_without_end_is_not_taken_for_ever(
    engine: Engine, data_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(server, "REST_SECONDS", 2.0)
    with served(build_core(settings(data_dir), engine)) as port, ExitStack() as stack:
        for path, kind in (("/identify", "application/json"), ("/recordings", "application/json")):  # 413, 415
            head = (
                f"POST {path} HTTP/1.1\r\nHost: localhost\r\nContent-Type: {kind}\r\nTransfer-Encoding: chunked\r\n\r\n"
            )
            endless, begun = client(stack, port, "127.0.0.2", head.encode()), time.monotonic()
            with suppress(ConnectionError):
                while time.monotonic() < begun + 15:
                    endless.sendall(b"10000\r\n" + b" " * 65536 + b"\r\n")
                    time.sleep(0.01)
            assert 1.5 < time.monotonic() - begun < 10, path


def test_what_a_connection_held_of_a_body_goes_with_it(
    engine: Engine, data_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Not when Python looks for circles: where memory is short no connection would find room for what it sends."""
    seen: list[weakref.ref[server.GuardedProtocol]] = []
    begin = server.GuardedProtocol.connection_made

    def noted(self: server.GuardedProtocol, transport: asyncio.Transport) -> None:
        seen.append(weakref.ref(self))
        begin(self, transport)

    monkeypatch.setattr(server.GuardedProtocol, "connection_made", noted)
    with served(build_core(settings(data_dir), engine)) as port:
        gc.collect()
        gc.disable()
        try:
            for _ in range(3):
                with closing(HTTPConnection("127.0.0.1", port, timeout=20)) as connection:
                    connection.request(
                        "POST", "/identify", b"[" + b" " * 1_500_000, {"content-type": "application/json"}
                    )
                    assert connection.getresponse().status == 422
            eventually(lambda: len(seen) >= 3 and not any(one() for one in seen))
        finally:
            gc.enable()

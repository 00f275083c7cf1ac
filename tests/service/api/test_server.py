"""The server itself: connections that do not finish, bodies that are wrong or too large, uploads that have no room."""

from __future__ import annotations

import asyncio
import json
import re
import socket
import ssl
import subprocess
import threading
import time
from collections.abc import AsyncIterator, Iterator
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

import httpx
import pytest
from fastapi.testclient import TestClient

from sprung.model.system import System
from sprung.service.api.bodies import read_window
from sprung.service.api.problems import ApiProblem
from sprung.service.core import Core, build_core
from sprung.service.errors import NoSpace
from sprung.service.monitoring.engine import Engine
from sprung.service.settings import Settings
from sprung.service.upload_room import UploadRoom
from tests.served import served
from tests.service_fakes import hold


def ask(port: int, path: str = "/health/live", seconds: float = 10.0, headers: str = "") -> bytes:
    with socket.create_connection(("127.0.0.1", port), timeout=seconds) as connection:
        connection.sendall(f"GET {path} HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n{headers}\r\n".encode())
        found = b""
        while chunk := connection.recv(65536):
            found += chunk
        return found


def closed_within(connection: socket.socket, seconds: float) -> bool:
    connection.settimeout(seconds)
    try:
        while connection.recv(65536):
            pass  # an answer, in one piece or several
        return True
    except TimeoutError:
        return False
    except ConnectionError:
        return True


def settings(tmp_path: Path, **changes: Any) -> Settings:
    return Settings(data_dir=tmp_path, min_free_bytes=0, **changes)


def test_half_sent_requests_do_not_make_the_service_unreachable(engine: Engine, data_dir: Path) -> None:
    core = build_core(settings(data_dir, client_connections=40, header_seconds=60), engine)
    with served(core) as port, ExitStack() as stack:
        for _ in range(120):
            held = stack.enter_context(socket.create_connection(("127.0.0.1", port), timeout=10))
            held.sendall(b"POST /identify HTTP/1.1\r\nHost: localhost\r\nContent-Le")
        begun = time.monotonic()
        assert b"200 OK" in ask(port)
        assert time.monotonic() - begun < 10.0


def test_a_header_that_does_not_come_is_not_waited_for(engine: Engine, data_dir: Path) -> None:
    core = build_core(settings(data_dir, header_seconds=0.5), engine)
    with served(core) as port, socket.create_connection(("127.0.0.1", port)) as slow:
        slow.sendall(b"GET / HTTP/1.1\r\nHost:")
        assert closed_within(slow, 10)


def test_nothing_at_all_is_not_waited_for_either(engine: Engine, data_dir: Path) -> None:
    core = build_core(settings(data_dir, header_seconds=0.5), engine)
    with served(core) as port, socket.create_connection(("127.0.0.1", port)) as silent:
        assert closed_within(silent, 10)


def test_a_body_that_stops_coming_is_given_up(engine: Engine, data_dir: Path) -> None:
    core = build_core(settings(data_dir, body_idle_seconds=0.5), engine)
    with served(core) as port, socket.create_connection(("127.0.0.1", port)) as slow:
        kind = b"Content-Type: application/json\r\n"
        slow.sendall(b"POST /identify HTTP/1.1\r\nHost: localhost\r\n" + kind + b"Content-Length: 5000\r\n\r\n{")
        assert closed_within(slow, 10)
        assert b"200 OK" in ask(port)


@pytest.mark.parametrize("trusted", [False, True])
def test_what_a_proxy_says_is_accepted_of_trusted_ones_only(engine: Engine, data_dir: Path, trusted: bool) -> None:
    proxies = ("127.0.0.0/8",) if trusted else ()
    core = build_core(settings(data_dir, client_requests_per_second=0.1, trusted_proxies=proxies), engine)
    with served(core) as port:
        said = [f"X-Forwarded-For: 192.0.2.{i}\r\nX-Forwarded-Proto: https\r\n" for i in range(3)]
        found = [ask(port, "/signin", headers=text) for text in said]
    assert [b" 429 " in answer for answer in found] == [False, not trusted, not trusted]
    assert all((b"strict-transport-security" in answer.lower()) == trusted for answer in found)


@pytest.mark.parametrize("wrong", ["*", "proxy.example", "10.0.0"])
def test_proxies_are_named_by_address(tmp_path: Path, wrong: str) -> None:
    with pytest.raises(ValueError, match=re.escape(wrong)):
        settings(tmp_path, trusted_proxies=(wrong,))


def test_a_connection_that_is_kept_alive_stays_between_requests(engine: Engine, data_dir: Path) -> None:
    core = build_core(settings(data_dir, header_seconds=0.5, body_idle_seconds=0.5), engine)
    with served(core) as port, socket.create_connection(("127.0.0.1", port), timeout=10) as kept:
        for _ in range(3):
            kept.sendall(b"GET /health/live HTTP/1.1\r\nHost: localhost\r\n\r\n")
            found = b""
            while b'"ok"}' not in found:
                found += kept.recv(65536)
            assert b"200 OK" in found
            time.sleep(1.7)


def certificate(folder: Path, name: str, by: Path | None = None) -> Path:
    """A certificate and its key in one file, signed by itself or by another's."""
    path = folder / f"{name}.pem"
    command = ["openssl", "req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes"]
    command += ["-days", "2", "-subj", f"/CN={name}", "-addext", "subjectAltName=IP:127.0.0.1"]
    command += ["-keyout", f"{path}.key", "-out", f"{path}.crt"]
    if by is None:  # what a strict reader (Python 3.13) asks of an authority
        command += ["-addext", "keyUsage=critical,keyCertSign,cRLSign"]
    else:
        command += ["-CA", f"{by}", "-CAkey", f"{by}", "-addext", "basicConstraints=critical,CA:FALSE"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        pytest.skip(f"openssl: {done.stderr[-200:]}")
    path.write_text(Path(f"{path}.key").read_text() + Path(f"{path}.crt").read_text())
    return path


def test_mutual_tls_lets_in_who_shows_a_certificate_and_nobody_else(engine: Engine, data_dir: Path) -> None:
    authority = certificate(data_dir, "authority")
    server, client = certificate(data_dir, "server", authority), certificate(data_dir, "client", authority)
    core = build_core(settings(data_dir, tls_certificate=server, tls_client_ca=authority, header_seconds=3), engine)
    with served(core) as port, socket.create_connection(("127.0.0.1", port)) as silent:
        context = ssl.create_default_context(cafile=str(authority))

        def status() -> bytes:
            with (
                socket.create_connection(("127.0.0.1", port), timeout=10) as plain,
                context.wrap_socket(plain, server_hostname="127.0.0.1") as connection,
            ):
                connection.sendall(b"GET /health/live HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n")
                return connection.recv(65536)

        with suppress(ssl.SSLError, ConnectionError):
            assert status() == b""
        context.load_cert_chain(str(client))
        assert b"200 OK" in status()
        assert b"200 OK" not in ask(port)  # no plain HTTP
        assert closed_within(silent, 10)  # no handshake begun


def test_wrong_bodies_cost_milliseconds(engine: Engine, system: System) -> None:
    strings = {f"x{i}": ["1.5"] * 100 for i in range(900)}
    wrong: list[dict[str, Any]] = [
        {c.name: ["a"] * system.window for c in system.channels},
        strings,
        {str(i): [] for i in range(160_000)},
        {"x": [1] * 900_000},
        {c.name: [[]] * 20_000 for c in system.channels},
    ]
    for channels in wrong:
        body = json.dumps({"sample_rate": 100.0, "channels": channels}).encode()
        begun = time.process_time()
        with pytest.raises(ApiProblem) as caught:
            read_window(body, engine.form)
        assert time.process_time() - begun < 1.0, len(body)
        assert 1 <= len(caught.value.errors) <= 20 and caught.value.status == 422


def test_a_key_flood_is_not_looked_at(engine: Engine) -> None:
    with pytest.raises(ApiProblem, match="too many strings"):
        read_window(json.dumps({str(i): i for i in range(100_000)}).encode(), engine.form)


@pytest.mark.parametrize(
    "start", ["1970-01-01T00:01:00Z", "1999-12-31T00:00:00Z", "2200-01-01T00:00:00Z", "2399-01-01T00:00:00Z"]
)
def test_a_window_of_the_future_or_of_a_clock_that_was_not_set_is_refused_before_it_is_identified(
    client: TestClient, body: Any, start: str
) -> None:
    response = client.post("/identify?track=true", json=body | {"start": start})
    assert response.status_code == 422
    assert response.json()["errors"][0]["field"] == "start"


@pytest.mark.parametrize(
    "start", ["\uff11\uff17\uff19\uff10", "1_790_000_000", " 1790000000", "1790000000\n", "0x6AB1"]
)
def test_a_start_that_only_python_would_take_for_a_number_is_none(client: TestClient, body: Any, start: str) -> None:
    assert client.post("/identify?track=true", json=body | {"start": start}).status_code == 422


@pytest.mark.parametrize("boundary", ["b" * 71, "b" * 5000, "\xff"])
def test_a_boundary_that_is_none_is_reported(client: TestClient, boundary: str) -> None:
    content_type = f"multipart/form-data; boundary={boundary}".encode("latin-1")
    assert client.post("/recordings", content=b"x", headers={b"content-type": content_type}).status_code == 422


@pytest.mark.parametrize("headers", [{"x": "a" * 40_000}, {f"x-{number}": "a" for number in range(200)}])
def test_headers_without_end_are_not_taken(client: TestClient, headers: dict[str, str]) -> None:
    answer = client.get("/health/live", headers=headers)
    assert answer.status_code == 431 and answer.headers["content-type"] == "application/problem+json"


def test_numbers_beyond_those_of_the_store_are_wrong_and_no_fault_of_ours(client: TestClient) -> None:
    for path in ("/audit?before=", "/audit?limit=", "/vehicles?limit=", "/?page=", "/alarms?limit="):
        assert client.get(f"{path}{10**30}").status_code == 422, path


@pytest.fixture
def core(engine: Engine, data_dir: Path) -> Core:
    return build_core(settings(data_dir, max_uploads_bytes=50_000), engine)


@pytest.fixture
def body(system: System) -> dict[str, Any]:
    channels = {channel.name: [0.01] * system.window for channel in system.channels}
    return {"vehicle": "demo-0001", "sample_rate": 100.0, "channels": channels}


def nothing_left(core: Core) -> bool:
    return not core.settings.uploads.exists() or not list(core.settings.uploads.iterdir())


@pytest.mark.parametrize("path", ["/recordings", "/diagnose"])
def test_an_upload_past_the_quota_is_507_and_leaves_nothing(client: TestClient, core: Core, path: str) -> None:
    answer = client.post(path, files={"file": ("a.mcap", b"x" * 60_000)})
    assert answer.status_code == 507 and answer.headers["retry-after"]

    def unstated() -> Iterator[bytes]:
        yield b'--b\r\nContent-Disposition: form-data; name="file"; filename="a.mcap"\r\n\r\n'
        for _ in range(60):
            yield b"x" * 1000
        yield b"\r\n--b--\r\n"

    headers = {"content-type": "multipart/form-data; boundary=b"}
    assert client.post(path, content=unstated(), headers=headers).status_code == 507
    assert nothing_left(core)


def test_the_quota_counts_what_is_kept(client: TestClient) -> None:
    assert client.post("/recordings", files={"file": ("a.mcap", b"x" * 30_000)}).status_code == 202
    assert client.post("/recordings", files={"file": ("b.mcap", b"x" * 30_000)}).status_code == 507


@pytest.mark.parametrize("path", ["/recordings", "/diagnose"])
@pytest.mark.parametrize("stated", [True, False])
def test_uploads_at_the_same_time_share_the_quota(client: TestClient, core: Core, path: str, stated: bool) -> None:
    head = b'--b\r\nContent-Disposition: form-data; name="file"; filename="%d.mcap"\r\n\r\n'
    headers = {"content-type": "multipart/form-data; boundary=b"}

    async def send(to: httpx.AsyncClient, number: int) -> int:
        parts = [head % number, b"x" * 6000, b"y" * 6000, b"\r\n--b--\r\n"]
        length = {"content-length": str(sum(map(len, parts)))} if stated else {}

        async def body() -> AsyncIterator[bytes]:
            for part in parts:
                yield part
                await asyncio.sleep(0.05)

        return (await to.post(path, content=body(), headers=headers | length)).status_code

    async def send_all() -> list[int]:
        async with httpx.AsyncClient(transport=httpx.ASGITransport(client.app), base_url="http://localhost") as to:
            return await asyncio.gather(*(send(to, number) for number in range(8)))

    statuses = asyncio.run(send_all())
    assert set(statuses) == {202, 507}
    assert (
        sum(path.stat().st_size for path in core.settings.uploads.iterdir()) == 12_000 * statuses.count(202) <= 50_000
    )
    left = 50_000 - 12_000 * statuses.count(202) - 300  # what the others had taken was given back
    assert client.post(path, files={"file": ("last.mcap", b"z" * left)}).status_code == 202


def test_an_upload_that_is_refused_leaves_its_room_to_the_others(core: Core, tmp_path: Path) -> None:
    """Eight uploads that come in two pieces, of which four fit: all first pieces are there before any second one."""
    room = UploadRoom(Settings(data_dir=tmp_path, max_uploads_bytes=50_000, min_free_bytes=0), core.store)
    shares = [room.share() for _ in range(8)]
    for share in shares:
        share.take(6_000)
    received = 0
    for share in shares:
        with suppress(NoSpace):
            share.take(6_000)
            received += 1
    assert received == 4


def test_uploads_at_the_same_time_leave_the_disk_its_free_bytes(
    core: Core, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    free = 100_000
    monkeypatch.setattr("sprung.service.upload_room.free_bytes", lambda folder: free)
    room = UploadRoom(Settings(data_dir=tmp_path, min_free_bytes=50_000), core.store)
    first, second = room.share(), room.share()
    first.take(30_000)
    with pytest.raises(NoSpace):
        second.take(30_000)
    second.take(15_000)
    first.written, free = 30_000, 70_000
    second.take(4_000)
    with pytest.raises(NoSpace):
        second.take(4_000)
    second.give_back()
    room.share().take(19_000)


def test_a_file_of_no_known_kind_is_refused_before_its_content_came(client: TestClient, core: Core) -> None:
    sent = 0

    def endless() -> Iterator[bytes]:
        nonlocal sent
        yield b'--b\r\nContent-Disposition: form-data; name="file"; filename="a.exe"\r\n\r\n'
        for _ in range(10_000):
            sent += 1
            yield b"x" * 1000

    # the test client hands over the whole body; a real one stops at the answer: what counts is that it is not kept
    response = client.post(
        "/recordings", content=endless(), headers={"content-type": "multipart/form-data; boundary=b"}
    )
    assert response.status_code in (413, 415)
    assert nothing_left(core)


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"--b--\r\n",
        b"rubbish",
        b'--b\r\nContent-Disposition: form-data; name="file"; filename="a.mcap"\r\n\r\nabc',
        b'--b\r\nContent-Disposition: form-data; name="other"; filename="a.mcap"\r\n\r\nabc\r\n--b--\r\n',
        b'--b\r\nContent-Disposition: form-data; name="file"\r\n\r\nno file\r\n--b--\r\n',
        b'--b\r\nContent-Disposition: form-data; name="vehicle"\r\n\r\n' + b"v" * 5000 + b"\r\n--b--\r\n",
        b'--b\r\nContent-Disposition: form-data; name="x"\r\n\r\n1\r\n' * 20 + b"--b--\r\n",
    ],
)
def test_wrong_forms_are_refused_and_leave_nothing(client: TestClient, core: Core, content: bytes) -> None:
    response = client.post("/recordings", content=content, headers={"content-type": "multipart/form-data; boundary=b"})
    assert response.status_code == 422, response.text
    assert nothing_left(core)
    assert client.post("/recordings", content=content, headers={"content-type": "text/plain"}).status_code == 415


def test_clients_that_ask_at_once_share_a_batch_and_each_gets_its_own(
    client: TestClient, core: Core, body: dict[str, Any], system: System
) -> None:
    sizes: list[int] = []
    real = core.engine.identifier.identify

    def noted(values: Any, *rest: Any, **named: Any) -> Any:
        sizes.append(len(values))
        return real(values, *rest, **named)

    core.engine.identifier.identify = noted  # type: ignore[method-assign,assignment]
    release, started = threading.Event(), threading.Event()
    core.compute.submit(lambda: hold(started, release))
    started.wait(5)
    answers: dict[int, float] = {}

    def one(number: int) -> None:
        channels = {name: [0.01 * number] * system.window for name in body["channels"]}
        answer = client.post("/identify", json=body | {"channels": channels}).json()
        answers[number] = answer["parameters"][0]["ratio"]

    threads = [threading.Thread(target=one, args=(number,)) for number in range(6)]
    for thread in threads:
        thread.start()
    deadline = time.monotonic() + 10
    while core.batcher.waiting < 6 and time.monotonic() < deadline:
        time.sleep(0.01)
    release.set()
    for thread in threads:
        thread.join(10)
    assert sizes == [6]
    assert [round(answers[number], 3) for number in range(6)] == [1.0, 1.01, 1.02, 1.03, 1.041, 1.051]

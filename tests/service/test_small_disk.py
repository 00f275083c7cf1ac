"""Uploads onto a disk that is too small for them, for real: told, nothing of them kept, the next one taken."""

from __future__ import annotations

import http.client
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, suppress
from pathlib import Path

import pytest

from sprung.benchmarks.trust_ride import RestlessRide
from sprung.benchmarks.trust_scarcity import DISK_MB, ScarceService, missing
from tests.service_fakes import eventually

HEAD = b'--x\r\nContent-Disposition: form-data; name="file"; filename="ride.csv"\r\n\r\n'
TAIL = b"\r\n--x--\r\n"
PART = 1_000_000


def sent(port: int, size: int, stated: bool) -> int:
    """Status of the answer to an upload of so many MB; stated: whether its length is."""
    length = {"content-length": str(len(HEAD) + size * PART + len(TAIL))} if stated else {}

    def body() -> Iterator[bytes]:
        yield HEAD
        for _ in range(size):
            yield b"0" * PART
        yield TAIL

    with closing(http.client.HTTPConnection("127.0.0.1", port, timeout=60)) as connection:
        with suppress(BrokenPipeError, ConnectionResetError):  # the answer came before the end
            headers = {"content-type": "multipart/form-data; boundary=x"} | length
            connection.request("POST", "/recordings", body(), headers, encode_chunked=not stated)
        return connection.getresponse().status


@pytest.mark.slow
def test_uploads_that_do_not_fit_are_507_and_leave_nothing(tmp_path: Path) -> None:
    if reason := missing():
        pytest.skip(f"no disk of its own: {reason}")
    watched = ScarceService(tmp_path / "disk", RestlessRide())
    with watched.served as served:
        served.ready()

        def kept() -> list[Path]:
            return list((watched.data / "uploads").iterdir())

        assert sent(served.port, DISK_MB + 10, stated=False) == 507
        eventually(lambda: not kept())
        assert sent(served.port, DISK_MB + 10, stated=True) == 507
        with ThreadPoolExecutor(4) as clients:
            statuses = list(clients.map(lambda _: sent(served.port, DISK_MB // 2, stated=False), range(4)))
        assert set(statuses) <= {202, 507} and statuses.count(507) >= 3
        eventually(lambda: len(kept()) == statuses.count(202))
        assert sent(served.port, DISK_MB // 4, stated=False) == 202

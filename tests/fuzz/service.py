"""Requests at random to a running service: `python -m tests.fuzz.service --seconds 600 --seed 7`.

Every route of the description with ids, queries, heads and bodies that somebody would try who means no good, framed as
HTTP has it and otherwise.  What is told: 5xx without a reason, an error that is no problem+json, a file of the machine,
a head that a request has put into an answer, nothing within three seconds, and every traceback in the log.
"""

from __future__ import annotations

import argparse
import gzip
import http.client
import json
import os
import random
import re
import signal
import socket
import subprocess
import sys
import tempfile
import time
import zlib
from collections import Counter
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import quote

SECONDS = 3.0  # within which a request is answered
MOST_BYTES = 200_000  # of an answer that are looked at
PAGES = ("/", "/pages/work", "/pages/alarms", "/pages/vehicles/car-1", "/metrics", "/docs", "/signin", "/favicon.ico")
PLACES = (
    "/static/../../etc/passwd",
    "/static/%2e%2e/%2e%2e/settings.py",
    "/reports/x/page",
    "/debug/profile?seconds=0.1",
)
IDS = (
    *("car-1", "..", "../..", "%2e%2e%2f%2e%2e%2fetc%2fpasswd", "%00", "a%0ab", "a%0d%0aSet-Cookie:x=1", "саr-1"),
    *("%E2%80%AEcar", "%F0%9F%9A%82", "%ff%fe", "a" * 200, "A" * 9000, "%3Cscript%3E", ".", "con", "car-1;x"),
    *("car-1%2f..%2fx", "' OR 1=1--", "{{7*7}}", "${jndi:ldap://x}", "%25n%25s", "-1", "9" * 400, "null", "٣", "１２"),
)
NUMBERS = (
    *(
        "0",
        "-1",
        "1e308",
        "1e400",
        "-0",
        "NaN",
        "Infinity",
        "9" * 30,
        "9" * 5000,
        "0x10",
        "1_000",
        "٣",
        "1.5",
        "",
        "true",
    ),
    *("[]", "%00", "1e-400", "2147483648", "9223372036854775808", "-9223372036854775809", "+1", " 1"),
)
TIMES = (
    *("1970-01-01T00:00:00Z", "9999-12-31T23:59:59Z", "0001-01-01T00:00:00Z", "-1", "1e18", "2026-02-30T00:00:00Z"),
    *(
        "2026-01-01T24:00:00Z",
        "2026-01-01T00:00:60Z",
        "2026-01-01T00:00:00+99:99",
        "2026-01-01T00:00:00.9999999999999Z",
    ),
    *("NaN", "10000-01-01T00:00:00Z", "2026-W01-1", "20260101", "٢٠٢٦-01-01", "0", "1e308", "2262-04-12T00:00:00Z"),
)
KEYS = (
    *(
        "since",
        "until",
        "limit",
        "after",
        "before",
        "q",
        "resolution",
        "parameter",
        "state",
        "track",
        "start",
        "vehicle",
    ),
    *("to", "format", "key", "fleet", "retired", "sort", "seconds", "%00", "a[]"),
)
HEADS = (
    *("Range: bytes=0-0,1-1,2-2", "Range: bytes=-1", "Range: bytes=99999999999999999999-", "Range: chickens=1"),
    "Range: bytes=" + ",".join(f"{i}-{i}" for i in range(500)),
    *(
        "If-None-Match: *",
        'If-None-Match: "x"',
        'If-None-Match: W/"\xff"',
        "If-Modified-Since: nonsense",
        "If-Match: *",
    ),
    *("If-Modified-Since: Thu, 32 Foo 99999 25:61:61 GMT", "If-Range: x", "Accept: */*;q=NaN", "Accept: text/html"),
    *("Accept: " + "a/b," * 2000, "Accept-Encoding: gzip;q=1e999", "Accept-Language: " + "x" * 5000),
    *("Authorization: Bearer " + "a" * 3000, "Authorization: Bearer \xff\xfe", "Authorization: Basic ::::"),
    *('Cookie: sprung_session="unterminated', "Cookie: " + "a=b;" * 3000, "Cookie: sprung_session=%00"),
    *("X-Request-ID: " + "x" * 500, "X-Request-Id: a b\tc", "Idempotency-Key: " + "k" * 300, "Idempotency-Key: k1"),
    *("Origin: null", "Origin: http://evil.example", "Host: evil.example", "Host: 127.0.0.1:99999", "Host: [::1"),
    *('Forwarded: for="[::1]"', "X-Forwarded-For: " + "1.2.3.4, " * 100, "X-Forwarded-Proto: https"),
    *("Expect: 100-continue", "Connection: close, upgrade", "Upgrade: websocket", "TE: trailers"),
    *("Content-Encoding: gzip", "Content-Encoding: br", "Content-Type: application/json; charset=utf-16"),
    *("Content-Type: text/plain", "Content-Type: multipart/form-data", "Content-Type: multipart/form-data; boundary="),
    *("Content-Type: application/vnd.sprung.estimates", "Content-Type: application/x-www-form-urlencoded"),
    *("Last-Event-ID: " + "9" * 20, "Sec-Fetch-Site: cross-site", "X\x01: y", "Name With Space: x", ": novalue"),
    "X: " + "v" * 40_000,
)
FILES = (
    *(
        "a.csv",
        "../../etc/passwd",
        "a.csv\0.exe",
        "CON.csv",
        "a" * 300 + ".csv",
        "a.mcap",
        "x.tar.gz",
        "..\\a.csv",
        ".csv",
    ),
    *("a.exe", "a\r\nX: y.csv", "a.json", "a.h5", "a.blf"),
)
METHODS = ("HEAD", "OPTIONS", "PUT", "DELETE", "PATCH", "TRACE", "CONNECT", "GET", "POST", "PROPFIND", "get", "G" * 300)
FORM, JSON = "Content-Type: multipart/form-data; boundary=xyz", "Content-Type: application/json"
BOMBS = (gzip.compress(bytes(50_000_000)), zlib.compress(bytes(60_000_000)))


@dataclass
class HostileRequests:
    """Requests to the routes of one service."""

    rng: random.Random
    port: int
    routes: list[tuple[str, str]]  # method, path
    channels: list[str]
    window: int  # samples

    @classmethod
    def of(cls, port: int, seed: int) -> HostileRequests:
        """To a service that answers."""
        paths = asked(port, "/openapi.json")["paths"]
        routes = [(method.upper(), path) for path, methods in paths.items() for method in methods]
        routes += [("GET", path) for path in (*PAGES, *PLACES)]
        system = asked(port, "/system")
        channels = [one["name"] if isinstance(one, dict) else one for one in system["channels"]]
        return cls(random.Random(seed), port, routes, channels, system["window"])

    def next(self) -> bytes:
        """One request, or what is to pass for one."""
        rng = self.rng
        method, path = rng.choice(self.routes)
        if rng.random() < 0.12:
            method = rng.choice(METHODS)
        heads = rng.choices(HEADS, k=rng.choice((0, 0, 0, 1, 1, 2, 4)))
        framing, body = "", b""
        if method in ("POST", "PUT", "PATCH", "DELETE") or rng.random() < 0.05:
            kind, body = self._body(path)
            heads += [kind] if kind else []
            framing, body = self._framed(body)
        if not any(head.startswith("Host") for head in heads):
            heads.insert(0, f"Host: 127.0.0.1:{self.port}")
        heads += ["Connection: close"] if rng.random() < 0.7 else []
        lines = [f"{method} {self._path(path)} HTTP/1.1", *heads]
        return "".join(f"{line}\r\n" for line in lines).encode("utf-8") + f"{framing}\r\n".encode() + body

    def _path(self, path: str) -> str:
        rng = self.rng

        def filled(_found: re.Match[str]) -> str:
            return quote(rng.choice(IDS), safe="%/.") if rng.random() < 0.8 else "car-1"

        path = re.sub(r"\{[^}]*\}", filled, path)
        count = rng.choice((0, 0, 1, 2, 5))
        pairs = [f"{rng.choice(KEYS)}={quote(rng.choice(NUMBERS + TIMES + IDS), safe='%')}" for _ in range(count)]
        if rng.random() < 0.01:
            pairs.append("x=" + "y" * rng.choice((5000, 60_000, 1_000_000)))
        if rng.random() < 0.02:
            pairs = ["limit=1"] * 2000
        return path + ("?" + "&".join(pairs) if pairs else "")

    def _body(self, path: str) -> tuple[str, bytes]:
        """Its content type, if any, and itself."""
        rng = self.rng
        if "recordings" in path and rng.random() < 0.7:
            return FORM, self._form()
        if "estimates" in path and rng.random() < 0.6:
            body = rng.choice((BOMBS[1], zlib.compress(rng.randbytes(200)), rng.randbytes(100)))
            return "Content-Type: application/vnd.sprung.estimates", body
        return JSON if rng.random() < 0.8 else "", self._json()

    def _json(self) -> bytes:
        rng = self.rng
        deep = rng.choice((10, 1000, 100_000))
        odd: tuple[Any, ...] = (
            float("nan"),
            float("inf"),
            1e308,
            "\0",
            None,
            [],
            {},
            "x" * 100_000,
            -1,
            True,
            "\u202e",
        )
        names = (
            "text",
            "parameters",
            "name",
            "scopes",
            "label",
            "confirm",
            "time",
            "recording",
            "vehicle",
            "structure",
        )
        token = {
            "name": rng.choice(("t", "\n")),
            "scopes": rng.choice((["read"], [], ["root"])),
            "days": rng.choice(odd),
        }
        bodies = (
            lambda: b"[" * deep + b"]" * rng.choice((0, 1000)),
            lambda: b'{"a":' * deep + b"1",
            lambda: json.dumps({rng.choice(names): rng.choice(odd) for _ in range(rng.randrange(6))}).encode(),
            lambda: json.dumps(token).encode(),
            lambda: b'{"text":"\xff\xfe"}',
            lambda: b'{"text":"\\ud800"}',
            lambda: b'{"text":1e999999999}',
            lambda: b'{"text":' + b"9" * 100_000 + b"}",
            lambda: b'{"text":"a","text":"b"}',
            lambda: b"\xef\xbb\xbf{}",
            lambda: '{"text":"a"}'.encode("utf-16"),
            lambda: json.dumps(self._window()).encode(),
            lambda: rng.choice(BOMBS),
            lambda: b"",
            lambda: rng.randbytes(rng.randrange(300)),
        )
        return rng.choice(bodies)()

    def _window(self) -> dict[str, Any]:
        rng = self.rng
        channels: dict[str, Any] = {
            name: [round(rng.uniform(-0.01, 0.01), 5) for _ in range(self.window)] for name in self.channels
        }
        for name in rng.sample(self.channels, rng.randrange(4)):
            samples = channels[name]
            wrong = rng.choice((float("nan"), 1e308, None, True, "1", 1e12))
            channels[name] = rng.choice((samples[:-1], [0] * len(samples), [wrong, *samples[1:]], {"a": samples}))
        vehicles = ("car-1", "north-2", "a" * 128, "-x", "x\ny", "саr", "..", "", None, 5, ["a"], {"$gt": ""})
        found: dict[str, Any] = {
            "vehicle": rng.choice(vehicles),
            "sample_rate": rng.choice((100.0, 1e308, -1, 0, None, "100")),
        }
        found |= {"start": rng.choice(TIMES), "channels": channels}
        if rng.random() < 0.3:
            found["windows"] = [{"start": rng.choice(TIMES), "channels": channels}] * rng.choice((1, 2, 31))
        return found

    def _form(self) -> bytes:
        rng = self.rng
        table = b"time,car_1l\n" + b"".join(b"%d.%02d,0.1\n" % (i, i % 100) for i in range(200))
        contents = (table, bytes(1000), b"car-1", b"\xff" * 100, b"[[[[", b"NaN,Infinity\n1e999,-1e999\n", b"")
        parts = []
        for _ in range(rng.randrange(1, 4)):
            name = rng.choice(("file", "vehicle", "start", 'name"; filename="x', "\0", "files"))
            file = f'; filename="{rng.choice(FILES)}"' if rng.random() < 0.8 else ""
            head = f'Content-Disposition: form-data; name="{name}"{file}'.encode("latin-1", "replace")
            parts.append(b"--xyz\r\n" + head + b"\r\n\r\n" + rng.choice(contents) + b"\r\n")
        return b"".join(parts) + rng.choice((b"--xyz--\r\n", b"--xyz", b"", b"--xyz--\r\n" + b"junk" * 100))

    def _framed(self, body: bytes) -> tuple[str, bytes]:
        """Heads that say where a body ends, true or not, and the body as it is sent."""
        rng, length = self.rng, len(body)
        if rng.random() < 0.8:
            return f"Content-Length: {length}\r\n", body
        chunked = "Transfer-Encoding: chunked\r\n"
        size = rng.choice((1, 7, 1000, 100_000))
        pieces = [body[i : i + size] for i in range(0, min(length, 300 * size), size)]
        whole = b"".join(b"%x;a=b\r\n%b\r\n" % (len(piece), piece) for piece in pieces)
        ends = (b"0\r\n\r\n", b"0\r\nX: y\r\n\r\n", b"", b"f" * 18 + b"\r\n", b"-1\r\n")
        wrong = (
            (chunked, whole + rng.choice(ends)),
            (f"Content-Length: {length + 10}\r\n", body),
            ("Content-Length: -1\r\n", body),
            ("Content-Length: 5\r\nContent-Length: 6\r\n", body),
            (f"Content-Length: 5\r\n{chunked}", body),
            (f"Content-Length: {'9' * 20}\r\n", body),
        )
        return rng.choice(wrong)


@dataclass
class FuzzedService:
    """What came of it."""

    statuses: Counter[str] = field(default_factory=Counter)
    wrong: list[str] = field(default_factory=list)
    slowest: float = 0.0  # s, of /health/live


def run(port: int, seconds: float, seed: int) -> FuzzedService:
    """Send requests one after the other, and ask in between whether the service lives."""
    made, found = HostileRequests.of(port, seed), FuzzedService()
    end, look = time.monotonic() + seconds, 0.0
    while time.monotonic() < end:
        if time.monotonic() > look:
            began = time.monotonic()
            asked(port, "/health/live")
            found.slowest, look = max(found.slowest, time.monotonic() - began), time.monotonic() + 1.0
        request, began = made.next(), time.monotonic()
        answer = sent(port, request)
        status = answer[9:12].decode("latin-1") or "none"
        found.statuses[status] += 1
        if wrong := judged(request, answer, time.monotonic() - began):
            found.wrong.append(f"{wrong}: {request[:300]!r} -> {answer[:200]!r}")
    return found


def asked(port: int, path: str) -> Any:
    """What a route answers, in JSON."""
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=60)
    try:
        connection.request("GET", path)
        return json.loads(connection.getresponse().read())
    finally:
        connection.close()


def sent(port: int, request: bytes) -> bytes:
    """The answer to a request, as far as it came within SECONDS."""
    answer = b""
    with socket.create_connection(("127.0.0.1", port), 10) as line, suppress(OSError):
        line.settimeout(SECONDS)
        with suppress(ConnectionError):  # it is answered before it has come whole
            line.sendall(request)
        while len(answer) < MOST_BYTES and (piece := line.recv(1 << 16)):
            answer += piece
            head, end, body = answer.partition(b"\r\n\r\n")
            length = re.search(rb"(?i)\r\ncontent-length: (\d+)", head)
            if b"event-stream" in head or (end and length and (len(body) >= int(length[1]) or request[:4] == b"HEAD")):
                break
    return answer


def judged(request: bytes, answer: bytes, seconds: float) -> str:
    """What is wrong with an answer; empty where nothing is."""
    status, head = answer[9:12], answer.partition(b"\r\n\r\n")[0].lower()
    waits = status == b"100" or b"event-stream" in head or not answer  # not answered: it never came whole
    checks = {
        "no reason": status[:1] == b"5" and status not in (b"503", b"507", b"501", b"505"),
        "a traceback": b"Traceback" in answer,
        "a file of the machine": b"root:x:0" in answer,
        "a head of the request's": b"\r\nset-cookie:x" in head or b"\r\nx: y" in head,
        "no problem+json": status[:1] == b"4"
        and request[:4] != b"HEAD"
        and not any(kind in head for kind in (b"problem+json", b"text/html")),
        "slow": seconds > SECONDS and not waits,
    }
    return next((what for what, holds in checks.items() if holds), "")


def main() -> int:
    """Start a service, send, tell."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz.service", description=__doc__)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = int(probe.getsockname()[1])
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder, Path(folder, "log").open("w+b") as log:
        many = {"SPRUNG_CLIENT_REQUESTS_PER_SECOND": "1e6", "SPRUNG_CLIENT_BROKEN_PER_SECOND": "1e6"}
        command = [sys.executable, "-m", "sprung", "serve", "--port", str(port), "--data-dir", f"{folder}/data"]
        service = subprocess.Popen(command, env=os.environ | many, stdout=log, stderr=log)
        try:
            while True:
                with suppress(OSError):
                    asked(port, "/health/live")
                    break
                assert service.poll() is None, "the service has ended"
                time.sleep(0.5)
            found = run(port, options.seconds, options.seed)
            memory = Path(f"/proc/{service.pid}/status").read_text().partition("VmRSS:")[2].split()[0]
        finally:
            service.send_signal(signal.SIGTERM)
            service.wait(60)
        log.seek(0)
        tracebacks = log.read().count(b"Traceback")
    for wrong in found.wrong:
        print(wrong)
    print(f"{found.statuses.total()} requests: {dict(sorted(found.statuses.items()))}")
    print(f"{len(found.wrong)} wrong answers, {tracebacks} tracebacks in the log")
    print(f"/health/live within {found.slowest:.2f} s; {int(memory) // 1024} MB at the end")
    return 1 if found.wrong or tracebacks else 0


if __name__ == "__main__":
    sys.exit(main())

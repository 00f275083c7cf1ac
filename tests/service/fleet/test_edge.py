"""On board: a spool that survives, a sender that does not give up, raw data around alarms only."""

from __future__ import annotations

import sqlite3
import threading
from collections.abc import Iterator
from dataclasses import replace
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sprung.model.system import System
from sprung.replay import open_recording
from sprung.service.errors import UserError
from sprung.service.fleet.message import decode
from sprung.service.fleet.onboard import Onboard, OnboardSettings
from sprung.service.fleet.sending import Answer, HttpLink, LinksByKind, Sending
from sprung.service.fleet.spool import Spool, SpoolEntry
from sprung.service.monitoring.engine import Engine
from tests.service_fakes import eventually, make_window


@pytest.fixture
def spool(tmp_path: Path) -> Iterator[Spool]:
    opened = Spool(tmp_path / "edge.db", 1_000_000)
    yield opened
    opened.close()


def test_what_waits_survives_and_estimates_go_first(tmp_path: Path) -> None:
    first = Spool(tmp_path / "edge.db", 1000)
    first.add("recording", b"raw", "x.mcap")
    first.add("estimates", b"one", tracker={"used": 1})
    first.add("estimates", b"two", tracker={"used": 2})
    first.close()
    second = Spool(tmp_path / "edge.db", 1000)
    assert second.waiting == (3, 9)
    assert second.fact("tracker") == {"used": 2}
    bodies = []
    while (entry := second.first()) is not None:
        bodies.append(entry.body)
        second.done(entry)
    assert bodies == [b"one", b"two", b"raw"]
    second.close()


def test_a_full_spool_gives_up_recordings_then_the_oldest_estimates(tmp_path: Path) -> None:
    spool = Spool(tmp_path / "edge.db", 100)
    spool.add("recording", bytes(50), "x.mcap")
    assert spool.add("estimates", b"a" * 40) == 0
    assert spool.add("estimates", b"b" * 40) == 1  # the recording
    assert spool.add("estimates", b"c" * 40) == 1
    assert spool.waiting == (2, 80)
    found = spool.first()
    assert found is not None and found.body == b"b" * 40
    spool.close()


def test_a_place_that_cannot_be_used_is_one_clear_line() -> None:
    with pytest.raises(UserError, match="cannot hold messages to be sent"):
        Spool(Path("/proc/nowhere/edge.db"), 1000)
    with pytest.raises(UserError, match="https://sprung"):
        HttpLink("sprung.example.org", None, "a")


class Unsteady:
    """A link that fails, refuses and takes, as told."""

    def __init__(self, answers: list[Answer]) -> None:
        self.answers = answers
        self.seen: list[bytes] = []

    def send(self, entry: SpoolEntry) -> Answer:
        self.seen.append(entry.body)
        return self.answers.pop(0) if self.answers else Answer(True)

    def close(self) -> None:
        """Nothing is open."""


def test_the_sender_tries_until_it_is_taken_and_gives_up_what_never_will_be(spool: Spool) -> None:
    down = Answer(False, trouble="connection refused")
    link = Unsteady([down, down, Answer(True), Answer(False, refused="409 another model")])
    for body in (b"one", b"two", b"three"):
        spool.add("estimates", body)
    sending = Sending(spool, link, first_pause=0.001)
    sending.start()
    assert sending.close(10.0)
    assert link.seen == [b"one", b"one", b"one", b"two", b"three"]
    assert (sending.sent, sending.refused, sending.trouble) == (2, 1, "")


def test_a_disk_that_is_full_ends_neither_the_sender_nor_the_spool(
    spool: Spool, monkeypatch: pytest.MonkeyPatch
) -> None:
    spool.add("estimates", b"1")
    refusals = 2

    class FullDisk:
        """The spool's connection: it refuses to commit, or has ended the transaction by itself."""

        def __init__(self, real: sqlite3.Connection) -> None:
            self.real = real

        def __getattr__(self, name: str) -> Any:
            return getattr(self.real, name)

        def execute(self, statement: str, *given: Any) -> Any:
            nonlocal refusals
            if statement == "COMMIT" and refusals:
                refusals -= 1
                if refusals:
                    self.real.execute("ROLLBACK")
                raise sqlite3.OperationalError("database or disk is full")
            return self.real.execute(statement, *given)

    monkeypatch.setattr(spool, "_file", FullDisk(spool._file))
    with pytest.raises(OSError, match="messages cannot be kept: database or disk is full"):
        spool.add("estimates", b"2")
    sending = Sending(spool, Unsteady([]), first_pause=0.01)
    sending.start()
    eventually(lambda: sending.sent == 1)
    assert sending.close(5)
    assert (refusals, sending.trouble) == (0, "")


class EdgeReceiver(ThreadingHTTPServer):
    """Answers with the statuses it was given, then 200; keeps what came."""

    def __init__(self, statuses: list[int]) -> None:
        self.statuses = statuses
        self.requests: list[tuple[str, dict[str, str], bytes]] = []
        super().__init__(("127.0.0.1", 0), ReceiverHandler)


class ReceiverHandler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"

    def do_POST(self) -> None:
        assert isinstance(self.server, EdgeReceiver)
        body = self.rfile.read(int(self.headers["Content-Length"]))
        self.server.requests.append((self.path, dict(self.headers), body))
        status = self.server.statuses.pop(0) if self.server.statuses else 200
        self.send_response(status)
        self.send_header("Content-Length", "2")
        self.end_headers()
        self.wfile.write(b"{}")

    def log_message(self, format: str, *args: Any) -> None:
        """Nothing."""


def test_statuses_say_whether_to_try_again() -> None:
    receiver = EdgeReceiver([200, 429, 503, 401, 404, 422, 409])
    thread = threading.Thread(target=receiver.serve_forever, daemon=True)
    thread.start()
    link = HttpLink(f"http://127.0.0.1:{receiver.server_port}/base", "sprung_x_y", "north-1")
    found = [link.send(SpoolEntry(i, "estimates", "", b"body")) for i in range(7)]
    recording = link.send(SpoolEntry(9, "recording", "north-1-x.mcap", b"\x89MCAP"))
    receiver.shutdown()
    receiver.server_close()
    link.close()
    assert [answer.stored for answer in found] == [True] + 6 * [False]
    assert [bool(answer.refused) for answer in found] == 5 * [False] + [True, True]
    path, headers, body = receiver.requests[0]
    assert (path, headers["Authorization"], body) == ("/base/ingest/estimates", "Bearer sprung_x_y", b"body")
    assert recording.stored
    path, headers, body = receiver.requests[-1]
    assert path == "/base/recordings" and b'name="vehicle"\r\n\r\nnorth-1' in body and b"\x89MCAP" in body
    dead = HttpLink(f"http://127.0.0.1:{receiver.server_port}", None, "x").send(SpoolEntry(1, "estimates", "", b""))
    assert not dead.stored and dead.trouble and not dead.refused


def test_a_recording_whose_first_attempt_is_still_worked_on_is_sent_again() -> None:
    receiver = EdgeReceiver([409])
    threading.Thread(target=receiver.serve_forever, daemon=True).start()
    link = HttpLink(f"http://127.0.0.1:{receiver.server_port}", None, "north-1")
    entry = SpoolEntry(9, "recording", "north-1-x.mcap", b"\x89MCAP")
    busy, again = link.send(entry), link.send(entry)
    link.close()
    receiver.shutdown()
    receiver.server_close()
    assert busy.trouble and not busy.refused
    assert again.stored


def test_raw_samples_go_to_the_server_that_takes_them() -> None:
    """The ingest takes estimates only; what it says of a recording names the option."""
    ingest, pages = EdgeReceiver([200, 404]), EdgeReceiver([])
    for receiver in (ingest, pages):
        threading.Thread(target=receiver.serve_forever, daemon=True).start()
    urls = [f"http://127.0.0.1:{receiver.server_port}" for receiver in (ingest, pages)]
    estimates, recording = SpoolEntry(1, "estimates", "", b"body"), SpoolEntry(2, "recording", "a.mcap", b"\x89MCAP")
    link = LinksByKind(HttpLink(urls[0], None, "a"), HttpLink(urls[1], None, "a", "--recordings"))
    assert link.send(estimates).stored and link.send(recording).stored
    link.close()
    alone = HttpLink(urls[0], None, "a")
    assert "--recordings" in alone.send(recording).refused
    alone.close()
    for receiver in (ingest, pages):
        receiver.shutdown()
        receiver.server_close()
    assert [path for path, _, _ in ingest.requests] == ["/ingest/estimates", "/recordings"]
    assert [path for path, _, _ in pages.requests] == ["/recordings"]
    with pytest.raises(UserError, match="--recordings nowhere"):
        HttpLink("nowhere", None, "a", "--recordings")


def test_messages_hold_every_window_and_a_restart_goes_on(engine: Engine, system: System, spool: Spool) -> None:
    settings = OnboardSettings(together_seconds=2, message_seconds=5, raw_seconds=0)
    windows = [replace(make_window(system, i, level=0.01), outcome="dropped" if i == 7 else "used") for i in range(26)]
    onboard = Onboard(engine, "north-1", spool, settings)
    onboard.process("north-1", windows[:13])  # then the power goes: what no message holds is lost
    kept = spool.fact("tracker")
    again = Onboard(engine, "north-1", spool, settings)
    assert again.state.to_dict() == kept["state"]
    assert again.state.used == 11
    again.process("north-1", windows[13:])
    again.flush()
    starts = []
    while (entry := spool.first()) is not None:
        starts += [w.start for w in decode(entry.body).windows]
        spool.done(entry)
    assert starts == [w.start for w in windows[:12]] + [w.start for w in windows[13:]]
    other = Onboard(engine, "north-2", spool, settings)
    assert other.state.used == 0


def test_raw_samples_are_sent_around_an_alarm_only(
    engine: Engine, system: System, spool: Spool, tmp_path: Path
) -> None:
    """A spring that breaks: a minute of samples, of which 20 s are from after the alarm."""
    settings = OnboardSettings(raw_seconds=60)
    onboard = Onboard(engine, "north-1", spool, settings)
    rng = np.random.default_rng(2)
    level = np.r_[np.zeros(400), np.full(120, -0.4)] + 0.001 * rng.normal(size=520)
    onboard.process("north-1", [make_window(system, i, level=float(level[i])) for i in range(520)])
    onboard.flush()
    assert onboard.counts.alarms > 0
    assert onboard.counts.raw_files == 1
    while (entry := spool.first()) is not None and entry.kind == "estimates":
        spool.done(entry)
    assert entry is not None
    path = tmp_path / entry.name
    path.write_bytes(entry.body)
    recording = open_recording(path, system.channels)
    blocks = list(recording.at_rate(system.sample_rate))
    assert recording.vehicle == "north-1"
    seconds = (max(b.time.max() for b in blocks) - min(b.time.min() for b in blocks)) / 1e9
    assert 55 < seconds <= 60.5

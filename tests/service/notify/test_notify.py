"""Notifications: accepted with what they tell of, signed, tried again, given up in sight of everybody."""

from __future__ import annotations

import base64
import hashlib
import hmac
import json
import socket
import socketserver
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field, replace
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient

from sprung.model.system import System
from sprung.model.tracking.state import Alarm
from sprung.service.app import create_app
from sprung.service.core import Core, build_core
from sprung.service.errors import UserError
from sprung.service.housekeeping import Housekeeping
from sprung.service.main import Feeds, add_live_feeds
from sprung.service.monitoring.engine import Engine
from sprung.service.monitoring.views import changed_part
from sprung.service.monitoring.words import spoken
from sprung.service.notify.events import alarm_event, sentence
from sprung.service.notify.notices import AT_ONCE, PAUSES, Notices
from sprung.service.notify.senders import signature
from sprung.service.settings import Settings
from sprung.service.sources.live import FeedStatus
from sprung.service.store import Store
from sprung.service.store.fleet import AlarmChange
from sprung.service.store.lists import list_deliveries
from sprung.service.store.outbox import newest_of_sources, settle
from sprung.service.times import NANOSECONDS, now_ns
from tests.service_fakes import make_window

SECRET = "whsec_" + base64.b64encode(b"a secret of many letters").decode()


@dataclass
class Received:
    """What a receiver was sent, and what it answers."""

    status: int = 200
    requests: list[tuple[dict[str, str], bytes]] = field(default_factory=list)


@pytest.fixture
def received() -> Received:
    return Received()


@pytest.fixture
def receiver(received: Received) -> Iterator[str]:
    class Handler(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            body = self.rfile.read(int(self.headers["content-length"]))
            received.requests.append(({k.lower(): v for k, v in self.headers.items()}, body))
            self.send_response(received.status)
            self.send_header("Location", "http://127.0.0.1:1/elsewhere")
            self.end_headers()

        def log_message(self, *_: Any) -> None:
            """Quiet."""

    server = HTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    yield f"http://127.0.0.1:{server.server_port}/hook"
    server.shutdown()
    thread.join()
    server.server_close()


@pytest.fixture
def core(engine: Engine, data_dir: Path, receiver: str) -> Core:
    settings = Settings(
        data_dir=data_dir,
        webhooks=(receiver,),
        webhook_networks=("127.0.0.0/8",),
        webhook_secret=SECRET,
        public_url="https://sprung.example.org",
    )
    return build_core(settings, engine)


def alarm(core: Core, system: System) -> None:
    core.pipeline.process("a", [make_window(system, i) for i in range(80)])
    core.pipeline.process("a", [make_window(system, 80 + i, 0.3) for i in range(60)])


def test_alarms_are_reported_as_signed_cloud_events(core: Core, system: System, received: Received) -> None:
    alarm(core, system)
    assert core.notices.deliver(now_ns()) > 0
    headers, body = received.requests[0]
    event = json.loads(body)
    assert headers["content-type"] == "application/cloudevents+json"
    assert event["specversion"] == "1.0" and event["type"] == "sprung.alarm.opened" and event["subject"] == "a"
    assert event["data"]["alarm"]["severity"] in ("warning", "alarm")
    assert "All of them at once" in event["data"]["advisory"]  # nobody can inspect `*`
    assert event["data"]["page"] == "https://sprung.example.org/pages/vehicles/a"
    signed = f"{headers['webhook-id']}.{headers['webhook-timestamp']}.".encode() + body
    digest = hmac.new(b"a secret of many letters", signed, hashlib.sha256).digest()
    assert headers["webhook-signature"] == "v1," + base64.b64encode(digest).decode()
    assert core.notices.deliver(now_ns()) == 0  # once
    core.operations.maintenance("me", "a", "overhaul", None, None)
    core.notices.deliver(now_ns())
    assert {json.loads(body)["type"] for _, body in received.requests} == {
        "sprung.alarm.opened",
        "sprung.alarm.closed",
    }


def test_a_change_of_severity_is_reported(core: Core, system: System, received: Received) -> None:
    core.pipeline.process("a", [make_window(system, i) for i in range(80)])
    core.pipeline.process("a", [make_window(system, 80 + i, 0.12) for i in range(60)])
    core.pipeline.process("a", [make_window(system, 140 + i, 0.4) for i in range(200)])
    while core.notices.deliver(now_ns()):
        pass
    changed = [json.loads(b) for _, b in received.requests if b'"sprung.alarm.changed"' in b]
    assert changed and changed[0]["data"]["alarm"]["previous_severity"] == "warning"


def test_what_fails_is_tried_again_later_and_given_up_in_sight(core: Core, system: System, received: Received) -> None:
    received.status = 302  # redirects are not followed: they count as failures
    with TestClient(create_app(core)) as client:
        core.notices.close()  # this test drives the clock
        core.notices._stopping.clear()
        alarm(core, system)
        now = now_ns()
        assert core.notices.deliver(now) == 0
        waiting = client.get("/deliveries?state=waiting").json()["deliveries"]
        assert waiting and waiting[0]["error"] == "the receiver answered 302"
        before = len(received.requests)
        assert core.notices.deliver(now + NANOSECONDS) == 0 and len(received.requests) == before  # not yet
        received.status = 503
        for pause in PAUSES:
            now += (pause + 1) * NANOSECONDS
            core.notices.deliver(now)
        dead = client.get("/deliveries?state=dead").json()["deliveries"]
        assert len(dead) == len(waiting) and dead[0]["attempts"] == len(PAUSES) + 1
        assert "the receiver answered 503" in client.get("/pages/work").text


def test_an_attempt_that_succeeds_later_counts(core: Core, system: System, received: Received) -> None:
    received.status = 500
    alarm(core, system)
    now = now_ns()
    core.notices.deliver(now)
    received.status = 204
    assert core.notices.deliver(now + 6 * NANOSECONDS) > 0


def test_mail_goes_through_smtp(tmp_path: Path, store: Store) -> None:
    got: list[str] = []

    class Smtp(socketserver.StreamRequestHandler):
        def handle(self) -> None:
            self.wfile.write(b"220 test\r\n")
            while line := self.rfile.readline().decode().strip():
                word = line.split()[0].upper()
                if word == "DATA":
                    self.wfile.write(b"354 go on\r\n")
                    lines = []
                    while (text := self.rfile.readline().decode()) != ".\r\n":
                        lines.append(text)
                    got.append("".join(lines))
                self.wfile.write(b"221 bye\r\n" if word == "QUIT" else b"250 ok\r\n")
                if word == "QUIT":
                    return

    with socketserver.TCPServer(("127.0.0.1", 0), Smtp) as server:
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()
        settings = Settings(
            data_dir=tmp_path, mail_to=("depot@example.org",), smtp_host="127.0.0.1", smtp_port=server.server_address[1]
        )
        notices = Notices(settings, store)
        with store.write() as connection:
            found = {"verdict": "missing_physics", "findings": [{"sentence": "dry friction at secondary_2r"}]}
            notices.report(connection, "car-17", "r1", found)
        assert notices.deliver(now_ns()) == 1
        server.shutdown()
        thread.join()
    assert "Subject: car-17: mismatch report: missing physics" in got[0]
    assert "dry friction at secondary_2r" in got[0] and "To: depot@example.org" in got[0]


def test_a_mail_server_that_drips_is_hung_up_on(tmp_path: Path, store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sprung.service.notify.senders.MAIL_SECONDS", 0.5)
    with socket.create_server(("127.0.0.1", 0)) as listening:

        def drip() -> None:
            line, _ = listening.accept()
            with line, suppress(OSError):
                for _ in range(100):
                    line.sendall(b"220-wait\r\n")
                    time.sleep(0.1)

        dripping = threading.Thread(target=drip, daemon=True)
        dripping.start()
        port = listening.getsockname()[1]
        settings = Settings(data_dir=tmp_path, mail_to=("a@example.org",), smtp_host="127.0.0.1", smtp_port=port)
        notices = Notices(settings, store)
        with store.write() as connection:
            notices.report(connection, "car-17", "r1", {"verdict": "none"})
        begun = time.monotonic()
        assert notices.deliver(now_ns()) == 0
        assert time.monotonic() - begun < 5.0
        dripping.join()


def test_a_lost_bus_is_reported_once_and_told_when_it_is_back(tmp_path: Path, store: Store) -> None:
    @dataclass
    class Feed:
        name: str = "socketcan:can0"
        vehicle: str = "car-17"
        works: bool = True
        detail: str = "no such device"

    feed = Feed()
    settings = Settings(data_dir=tmp_path, webhooks=("http://127.0.0.1:1/",), webhook_networks=("127.0.0.0/8",))
    notices = Notices(settings, store, lambda: [feed])  # type: ignore[list-item]
    for works in (True, False, False, True):
        feed.works = works
        notices.watch_feeds()
    with store.read() as connection:
        kinds = sorted(row.kind for row in list_deliveries(connection, 10))
    assert kinds == ["sprung.feed.found", "sprung.feed.lost"]


@pytest.mark.parametrize("days", [0, 40])
def test_a_bus_that_is_lost_is_told_once_over_starts(tmp_path: Path, any_store: Store, days: int) -> None:
    """A service that is started anew goes on with what was told, however long ago that was."""
    settings = Settings(data_dir=tmp_path, webhooks=("http://127.0.0.1:1/",), webhook_networks=("127.0.0.0/8",))
    states = {"socketcan:can0": "receiving", "socketcan:can1": "down"}

    def started() -> Notices:
        names = [FeedStatus(name, "car-17", state, "", 0.0, 0, 0, 0, 0, 0) for name, state in states.items()]
        return Notices(settings, any_store, lambda: names)

    def told() -> list[str]:
        with any_store.read() as connection:
            rows = sorted(list_deliveries(connection, 10), key=lambda row: row.created_ns)
        return [f"{row.kind.removeprefix('sprung.feed.')} {row.event['data']['source'][-1]}" for row in rows]

    started().watch_feeds()
    assert told() == ["lost 1"]
    with any_store.write() as connection:
        [(_, _, lost)] = newest_of_sources(connection)
        settle(connection, lost, now_ns() - days * 86_400 * NANOSECONDS, state="dead")
    Housekeeping(settings, any_store).once(now_ns())
    started().watch_feeds()
    assert told() == ["lost 1"]
    states = {"socketcan:can0": "down", "socketcan:can1": "receiving"}
    for _ in range(2):
        started().watch_feeds()
        assert sorted(told()) == ["found 1", "lost 0", "lost 1"]


def test_a_served_bus_that_is_lost_is_reported(engine: Engine, data_dir: Path) -> None:
    """By what `sprung serve` wires, with a bus that is not there."""
    settings = Settings(data_dir=data_dir, webhooks=("http://127.0.0.1:1/",), webhook_networks=("127.0.0.0/8",))
    core = build_core(settings, engine)
    add_live_feeds(core, Feeds(buses=("socketcan:absent0",), vehicle="car-17"))
    core.notices.watch_feeds()
    with core.store.read() as connection:
        assert [row.kind for row in list_deliveries(connection, 10)] == ["sprung.feed.lost"]
    core.close()


def test_what_cannot_be_written_down_is_reported_later(tmp_path: Path, store: Store) -> None:
    feed = FeedStatus("socketcan:can0", "car-17", "down", "no such device", 0.0, 0, 0, 0, 0, 0)
    settings = Settings(data_dir=tmp_path, webhooks=("http://127.0.0.1:1/",), webhook_networks=("127.0.0.0/8",))
    notices = Notices(settings, store, lambda: [feed])
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(store, "write", failing)
        with pytest.raises(OSError):
            notices.watch_feeds()
    notices.watch_feeds()
    with store.read() as connection:
        assert [row.kind for row in list_deliveries(connection, 10)] == ["sprung.feed.lost"]


def failing() -> None:
    raise OSError("database is locked")


def failing_otherwise() -> None:
    raise KeyError("nothing")


def test_what_was_to_be_sent_by_a_clock_that_was_set_back_is_sent(core: Core, system: System) -> None:
    """A machine that came up in 2040 and learned the time later."""
    alarm(core, system)
    back = now_ns() - 5000 * 86_400 * NANOSECONDS
    assert core.notices.deliver(back) > 0
    assert core.notices.deliver(back) == 0


def test_what_has_arrived_is_forgotten_after_a_month_and_no_leap_of_the_clock_counts(
    core: Core, system: System
) -> None:
    alarm(core, system)
    assert core.notices.deliver(now_ns()) > 0
    keeping = Housekeeping(core.settings, core.store)

    def left() -> int:
        with core.store.read() as connection:
            return len(list_deliveries(connection, 10))

    before = left()
    keeping.once(now_ns() + 29 * 86_400 * NANOSECONDS)
    assert left() == before > 0
    keeping.once(now_ns() + 31 * 86_400 * NANOSECONDS)
    assert left() == 0


def test_a_receiver_that_never_answers_holds_others_up_once(
    tmp_path: Path, store: Store, receiver: str, received: Received, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Not with every event that waits for it, and not for ever where many do."""
    monkeypatch.setattr("sprung.service.notify.senders.SECONDS", 0.5)
    monkeypatch.setattr("sprung.service.notify.notices.TURN_SECONDS", 0.2)
    with socket.create_server(("127.0.0.1", 0), backlog=100) as silent:
        slow = f"http://127.0.0.1:{silent.getsockname()[1]}/"
        settings = Settings(data_dir=tmp_path, webhooks=(slow, receiver), webhook_networks=("127.0.0.0/8",))
        notices = Notices(settings, store)
        with store.write() as connection:
            for number in range(AT_ONCE + 10):
                notices.report(connection, "car-17", f"r{number}", {"verdict": "none"})
        begun, arrived = time.monotonic(), 0
        while arrived < AT_ONCE + 10:
            arrived += notices.deliver(now_ns())
            assert time.monotonic() - begun < 20.0  # of half a minute that all attempts would take
    assert len(received.requests) == AT_ONCE + 10


def test_what_cannot_be_sent_at_all_holds_up_nothing(
    core: Core, system: System, received: Received, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whatever the reason: it counts as an attempt, and the thread goes on."""
    alarm(core, system)
    monkeypatch.setattr("sprung.service.notify.senders.post", lambda *_: failing_otherwise())
    assert core.notices.deliver(now_ns()) == 0
    monkeypatch.undo()
    assert core.notices.deliver(now_ns() + 6 * NANOSECONDS) > 0


@pytest.mark.parametrize("secret", ["whsec_$$$", "whsec_abc"])
def test_a_secret_that_is_none_is_refused_at_the_start(tmp_path: Path, store: Store, secret: str) -> None:
    with pytest.raises(UserError, match="SPRUNG_WEBHOOK_SECRET"):
        Notices(Settings(data_dir=tmp_path, webhook_secret=secret), store)


@pytest.mark.parametrize(
    "wrong", [{"webhooks": "ftp://x"}, {"mail_to": "nobody"}, {"mail_to": "a@b"}, {"webhooks": "file:///etc/passwd"}]
)
def test_wrong_receivers_are_refused_at_the_start(tmp_path: Path, store: Store, wrong: dict[str, str]) -> None:
    with pytest.raises(UserError, match="SPRUNG_"):
        Notices(Settings(data_dir=tmp_path, **wrong), store)  # type: ignore[arg-type]


def test_without_a_secret_nothing_is_signed() -> None:
    assert "webhook-signature" not in signature("i", 1, b"{}", None)


def test_alarms_of_all_elements_are_reported_in_words() -> None:
    assert spoken("*.damping") == "damping of all elements"
    assert spoken("primary_*.stiffness") == "stiffness of all primary elements"
    assert spoken("secondary_2l.damping") == "secondary_2l.damping"


def test_a_change_that_may_be_a_sensor_s_is_reported_with_the_sensor_first() -> None:
    alarm = Alarm(
        "change", "primary_11l.damping", 1, 2, "warning", -0.153, 0.012, -0.153, alternatives=("bogie1_1l.gain",)
    )
    event = alarm_event("", "car-17", AlarmChange("opened", alarm, None), now_ns())
    assert sentence(event) == "car-17: warning opened: bogie1_1l.gain or primary_11l.damping -15.3 ± 1.2 %"
    assert event["data"]["advisory"].startswith("The measurements do not tell it from bogie1_1l.gain: check the sensor")
    assert changed_part(alarm) == "bogie1_1l.gain or primary_11l.damping"
    assert changed_part(replace(alarm, alternatives=())) == "primary_11l.damping"

"""A live feed goes on: through a store that is locked, numerics that fail, readers that break, die or hang."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest
from fastapi.testclient import TestClient
from sqlalchemy import text
from sqlalchemy.exc import OperationalError

from sprung.model.signals import SampleBlock, Tally
from sprung.replay.account import UnreadableRecording
from sprung.replay.bus import opening_options, parse_bus, socket_drops
from sprung.replay.frames import EXTENDED
from sprung.replay.live import LiveBus
from sprung.service.app import create_app
from sprung.service.core import Core, build_core
from sprung.service.main import live_feed
from sprung.service.monitoring.engine import Engine
from sprung.service.settings import Settings
from sprung.service.sources.live import LiveFeed
from tests.service_fakes import START, FakeIdentifier, eventually


class RowSource:
    """Rows of all channels, a hundred a recorded second, as quickly as `pace` allows; does what `happens` says."""

    def __init__(self, channels: int, pace: float = 0.0) -> None:
        self.name = "test:0"
        self.tally = Tally()
        self.row = 0
        self.happens: Callable[[], None] = lambda: None
        self.connected, self.trouble = True, ""
        self.lost = self.reconnects = 0
        self.lag, self.beat = 0.0, time.monotonic()
        self._channels = channels
        self._pace = pace

    def blocks(self) -> Iterator[SampleBlock]:
        rows = 10
        while True:
            self.happens()
            numbers = np.arange(self.row, self.row + rows)
            times = np.repeat(START + numbers * 10_000_000, self._channels)
            self.row += rows
            self.tally.used += rows
            time.sleep(self._pace)
            channel = np.tile(np.arange(self._channels, dtype=np.int32), rows)
            yield SampleBlock(times, channel, np.full(rows * self._channels, 0.01))


@pytest.fixture
def core(engine: Engine, data_dir: Path) -> Iterator[Core]:
    core = build_core(Settings(data_dir=data_dir, min_free_bytes=0), engine)
    yield core
    core.close()


@pytest.fixture
def source(engine: Engine) -> RowSource:
    return RowSource(len(engine.system.channels), pace=0.005)


@pytest.fixture
def feed(core: Core, source: RowSource, monkeypatch: pytest.MonkeyPatch) -> Iterator[LiveFeed]:
    monkeypatch.setattr("sprung.service.sources.live.FIRST_RETRY", 0.05)
    monkeypatch.setattr("sprung.service.sources.live.WATCH_SECONDS", 0.05)
    feed = LiveFeed(core.pipeline, source, "live", core.stopping, core.tally_counter(source.name))
    core.feeds.append(feed)
    yield feed
    core.stopping.set()
    assert feed.join(10)


def stored(core: Core) -> list[int]:
    with core.store.read() as connection:
        return [row[0] for row in connection.execute(text("SELECT start_ns FROM windows ORDER BY start_ns"))]


def test_a_source_is_followed_and_what_came_is_stored_at_the_end(core: Core, feed: LiveFeed) -> None:
    feed.start()
    eventually(lambda: len(stored(core)) > 3)
    assert feed.status().state == "receiving"
    assert b'sprung_frames_total{outcome="used",source="test:0"}' in core.metrics.render()
    assert b'sprung_feed_state{source="test:0",state="receiving"} 1.0' in core.metrics.render()
    assert b'sprung_bus_connected{source="test:0"} 1.0' in core.metrics.render()


def test_a_locked_store_loses_no_window_and_shows_meanwhile(
    core: Core, feed: LiveFeed, monkeypatch: pytest.MonkeyPatch
) -> None:
    locked = threading.Event()
    real = core.pipeline.process

    def refusing(*arguments: Any) -> Any:
        if locked.is_set():
            raise OperationalError("INSERT", {}, Exception("database is locked"))
        return real(*arguments)

    monkeypatch.setattr(core.pipeline, "process", refusing)
    feed.start()
    eventually(lambda: len(stored(core)) > 2)
    locked.set()
    eventually(lambda: feed.status().state == "failing")
    assert not feed.status().works and "database is locked" in feed.status().detail
    eventually(lambda: feed.status().waiting_windows > 5)
    locked.clear()
    eventually(lambda: feed.status().state == "receiving" and feed.status().waiting_windows < 3)
    core.stopping.set()
    assert feed.join(10)
    assert len(set(np.diff(stored(core)))) == 1  # every window, one after the other
    assert feed.status().dropped_windows == 0


def test_readiness_tells_of_a_feed_that_does_not_work(core: Core, feed: LiveFeed, source: RowSource) -> None:
    def broken() -> None:
        raise RuntimeError("the decoder stumbled")

    source.happens = broken
    with TestClient(create_app(core, on_start=feed.start, on_stop=lambda: None)) as client:
        eventually(lambda: feed.status().state == "down")
        answer = client.get("/health/ready")
        assert answer.status_code == 503
        assert "feed test:0 is down: the decoder stumbled; trying again" in answer.json()["detail"]
        assert client.get("/health/live").status_code == 200
        source.happens = lambda: None
        eventually(lambda: client.get("/health/ready").status_code == 200)
        assert client.get("/health/ready").json()["feeds"][0]["restarts"] > 0


def test_a_window_that_the_numerics_cannot_take_costs_itself_only(
    core: Core, feed: LiveFeed, identifier: FakeIdentifier, monkeypatch: pytest.MonkeyPatch
) -> None:
    real, calls = identifier.identify, 0

    def fragile(*arguments: Any, **named: Any) -> Any:
        nonlocal calls
        calls += 1
        if calls == 3:
            raise np.linalg.LinAlgError("singular")
        return real(*arguments, **named)

    monkeypatch.setattr(identifier, "identify", fragile)
    feed.start()
    eventually(lambda: len(stored(core)) > 8)
    assert feed.status().failed_windows <= 1
    assert feed.status().state == "receiving"


def test_no_thread_to_be_had_loses_no_window_and_no_watchdog(
    core: Core, feed: LiveFeed, identifier: FakeIdentifier, monkeypatch: pytest.MonkeyPatch
) -> None:
    real, short = identifier.identify, threading.Event()
    short.set()

    def scarce(*arguments: Any, **named: Any) -> Any:
        if short.is_set():
            raise RuntimeError("can't start new thread")
        return real(*arguments, **named)

    def look() -> None:
        if short.is_set():
            looked.set()
            raise RuntimeError("can't start new thread")

    looked = threading.Event()
    monkeypatch.setattr("sprung.service.sources.live.WATCH_SECONDS", 0.05)
    monkeypatch.setattr(identifier, "identify", scarce)
    monkeypatch.setattr(feed, "_look", look)
    feed.start()
    assert looked.wait(5)
    eventually(lambda: feed.status().state == "failing" and "new thread" in feed.status().detail)
    short.clear()
    eventually(lambda: len(stored(core)) > 3 and feed.status().state == "receiving")
    assert feed.status().failed_windows == 0 and feed._watching.is_alive()


def test_a_feed_whose_every_window_fails_is_not_ready(
    core: Core, feed: LiveFeed, identifier: FakeIdentifier, monkeypatch: pytest.MonkeyPatch
) -> None:
    real, broken = identifier.identify, True

    def fragile(*arguments: Any, **named: Any) -> Any:
        if broken:
            raise np.linalg.LinAlgError("singular")
        return real(*arguments, **named)

    monkeypatch.setattr("sprung.service.sources.live.FAILING_WINDOWS", 3)
    monkeypatch.setattr(identifier, "identify", fragile)
    feed.start()
    eventually(lambda: feed.status().state == "failing")
    assert "singular" in feed.status().detail and not feed.status().works
    broken = False
    eventually(lambda: feed.status().state == "receiving")


def test_a_reader_that_hangs_is_replaced(
    core: Core, feed: LiveFeed, source: RowSource, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sprung.service.sources.live.HUNG_SECONDS", 0.2)
    release, hung = threading.Event(), threading.Event()

    def hang() -> None:
        source.happens = beat
        hung.set()
        release.wait(20)

    def beat() -> None:
        source.beat = time.monotonic()

    source.happens = hang
    beat()
    feed.start()
    assert hung.wait(5)
    eventually(lambda: len(stored(core)) > 3)
    assert feed.status().restarts >= 1
    release.set()


def test_an_absent_bus_is_down_and_its_reader_does_not_hang(core: Core, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sprung.service.sources.live.HUNG_SECONDS", 0.4)
    monkeypatch.setattr("sprung.service.sources.live.WATCH_SECONDS", 0.05)
    monkeypatch.setattr("sprung.replay.live.LAST_RETRY", 0.1)
    monkeypatch.setattr("sprung.replay.live.FIRST_RETRY", 0.05)

    def absent(**_: Any) -> Any:
        raise OSError("no such device")

    assert core.engine.dbc is not None
    bus = LiveBus(
        "socketcan", "can9", core.engine.system.channels, core.engine.dbc, stop=core.stopping, open_bus=absent
    )
    bus.beat -= 100.0  # the model took long to load
    feed = LiveFeed(core.pipeline, bus, "live", core.stopping, core.tally_counter(bus.name))
    core.feeds.append(feed)
    feed.start()
    time.sleep(1.0)
    assert feed.status().state == "down" and "no such device" in feed.status().detail
    assert b'sprung_bus_connected{source="socketcan:can9"} 0.0' in core.metrics.render()
    feed._hung, feed._begun = True, time.monotonic()  # as after a moment in which nothing ran
    eventually(lambda: feed.status().state == "down")
    core.stopping.set()
    assert feed.join(10)


def test_overload_gives_up_whole_windows_and_counts_them(
    core: Core, feed: LiveFeed, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sprung.service.sources.live.WAITING_WINDOWS", 5)
    free = threading.Event()
    real = core.pipeline.process

    def slow(*arguments: Any) -> Any:
        free.wait(20)
        return real(*arguments)

    monkeypatch.setattr(core.pipeline, "process", slow)
    feed.start()
    eventually(lambda: feed.status().dropped_windows > 3)
    assert feed.status().state == "behind" and feed.status().works
    assert feed.status().waiting_windows <= 5
    free.set()
    eventually(lambda: len(stored(core)) > 5)


def test_a_bus_that_does_not_exist_shows(core: Core) -> None:
    feed = live_feed(core, "socketcan:can99", "a")
    core.feeds.append(feed)
    feed.start()
    eventually(lambda: feed.status().restarts > 0)
    assert feed.status().state == "down" and feed.status().detail
    core.stopping.set()
    assert feed.join(15)


@pytest.mark.parametrize(
    ("text", "options"),
    [
        ("socketcan:can0", {}),
        ("pcan:PCAN_USBBUS1,bitrate=500000,fd=true", {"bitrate": 500000, "fd": True}),
        ("slcan:/dev/ttyUSB0,listen_only=false,sleep_after_open=0.5", {"listen_only": False, "sleep_after_open": 0.5}),
        ("vector:0,app_name=Sprung", {"app_name": "Sprung"}),
    ],
)
def test_a_bus_is_named_with_its_options(text: str, options: dict[str, Any]) -> None:
    address = parse_bus(text)
    assert (f"{address.interface}:{address.channel}", address.options) == (text.split(",", maxsplit=1)[0], options)


def test_wrong_names_of_buses_are_one_clear_line() -> None:
    for name in ("can0", ":", "socketcan:can0,fd", "socketcan:can0,=1"):
        with pytest.raises(UnreadableRecording, match="CAN bus"):
            parse_bus(name)


def test_buses_are_filtered_by_the_kernel_and_only_listened_to_where_they_can() -> None:
    wanted = opening_options(parse_bus("socketcan:can0"), [0x123, 0x18FF1234 | EXTENDED])
    assert wanted == {
        "can_filters": [
            {"can_id": 0x123, "can_mask": 0x7FF, "extended": False},
            {"can_id": 0x18FF1234, "can_mask": 0x1FFFFFFF, "extended": True},
        ]
    }
    assert opening_options(parse_bus("slcan:x"), [1]) == {"listen_only": True}
    assert opening_options(parse_bus("slcan:x,listen_only=false"), [1]) == {"listen_only": False}
    assert opening_options(parse_bus("pcan:x,bitrate=250000"), [1]) == {
        "state": can.BusState.PASSIVE,
        "bitrate": 250000,
    }
    assert opening_options(parse_bus("virtual:x"), [1]) == {}


def test_what_a_socket_dropped_is_read_from_the_kernel() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver, socket.socket(type=socket.SOCK_DGRAM) as sender:
        receiver.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        receiver.bind(("127.0.0.1", 0))
        assert socket_drops(receiver) == 0
        for _ in range(200):
            sender.sendto(b"x" * 500, receiver.getsockname())
        time.sleep(0.05)
        if not socket_drops(receiver):
            pytest.skip("this kernel does not tell")
        assert 0 < socket_drops(receiver) <= 200

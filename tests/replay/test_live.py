"""A bus is read as it runs, lost and found again; a recording can be played onto one."""

import socket
import threading
import time
from collections import Counter
from collections.abc import Callable
from itertools import count
from pathlib import Path
from typing import Any, Self

import can
import msgpack
import numpy as np
import pytest
from cantools.database.can import Database, Message, Signal

from sprung.model.signals import Channel, SampleBlock
from sprung.replay import UnreadableRecording
from sprung.replay.account import Account
from sprung.replay.live import LiveBus, frame_block, send
from sprung.replay.windowing import Windower

CHANNEL = Channel("speed", "m/s", 0.1, can="Train.Speed")
DATABASE = Database([Message(0x123, "Train", 8, [Signal("Speed", 0, 16, minimum=0, maximum=65000)])])
NUMBERS = count()


@pytest.fixture
def dbc(tmp_path: Path) -> Path:
    path = tmp_path / "train.dbc"
    path.write_text(DATABASE.as_dbc_string())
    return path


@pytest.fixture
def bus_name() -> str:
    """A virtual bus of its own for every test."""
    return f"sprung-test-{next(NUMBERS)}"


def frame(value: int, frame_id: int = 0x123) -> can.Message:
    return can.Message(arbitration_id=frame_id, is_extended_id=False, data=value.to_bytes(8, "little"))


class CollectingListener:
    """Collects blocks in a thread, with the moment at which each came."""

    def __init__(self, bus: LiveBus) -> None:
        self.bus = bus
        self.blocks: list[tuple[float, SampleBlock]] = []
        self.thread = threading.Thread(target=self._run)
        self.thread.start()

    def _run(self) -> None:
        for block in self.bus.blocks():
            self.blocks.append((time.monotonic(), block))

    def values(self) -> list[float]:
        return [float(v) for _, block in self.blocks for v in block.value]

    def wait(self, condition: Callable[[], bool], seconds: float = 5.0) -> bool:
        end = time.monotonic() + seconds
        while not condition() and time.monotonic() < end:
            time.sleep(0.01)
        return condition()

    def stop(self) -> None:
        self.bus.stop.set()
        self.thread.join(5.0)
        assert not self.thread.is_alive()


def test_frames_come_out_as_samples_within_the_latency_and_are_counted(dbc: Path, bus_name: str) -> None:
    live = LiveBus("virtual", bus_name, [CHANNEL], dbc, latency=0.05)
    listener = CollectingListener(live)
    assert listener.wait(lambda: live.connected)
    with can.Bus(interface="virtual", channel=bus_name) as sender:
        begun = time.monotonic()
        for value in range(20):
            sender.send(frame(value))
        sender.send(frame(1, 0x99))
        sender.send(frame(65535))
        assert listener.wait(lambda: len(listener.values()) == 21)
        assert listener.blocks[0][0] - begun < 4.0  # 0.05 s, and a busy machine
    listener.stop()
    assert listener.values()[:20] == list(range(20))
    assert np.isnan(listener.values()[20])
    assert live.tally.as_dict() == {"used": 20, "repaired": 0, "dropped": 1, "corrupt": 0, "foreign": 1}
    stamps = np.concatenate([block.time for _, block in listener.blocks])
    assert abs(stamps[0] / 1e9 - time.time()) < 60.0


def test_a_silent_bus_stops_at_once(dbc: Path, bus_name: str) -> None:
    live = LiveBus("virtual", bus_name, [CHANNEL], dbc)
    listener = CollectingListener(live)
    assert listener.wait(lambda: live.connected)
    begun = time.monotonic()
    listener.stop()
    assert time.monotonic() - begun < 5.0


def test_a_bus_that_is_lost_is_opened_again(dbc: Path, bus_name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The first opening fails, the second bus breaks after three frames, the third stays."""
    monkeypatch.setattr("sprung.replay.live.FIRST_RETRY", 0.01)
    opened = count(1)

    class Breaking:
        def __init__(self, number: int) -> None:
            self.number, self.sent = number, 0

        def __enter__(self) -> Self:
            return self

        def __exit__(self, *_: object) -> None:
            return None

        def recv(self, timeout: float) -> can.Message | None:
            self.sent += 1
            if self.sent <= 3:
                return frame(10 * self.number + self.sent)
            if self.number == 2:
                raise can.CanOperationError("Network is down")
            time.sleep(timeout)
            return None

    def open_bus(**_: object) -> Breaking:
        number = next(opened)
        if number == 1:
            raise OSError("No such device")
        return Breaking(number)

    live = LiveBus("virtual", bus_name, [CHANNEL], dbc, latency=0.02, open_bus=open_bus)  # type: ignore[arg-type]
    listener = CollectingListener(live)
    assert listener.wait(lambda: len(listener.values()) == 6)
    listener.stop()
    assert listener.values() == [21, 22, 23, 31, 32, 33]
    assert live.reconnects == 2
    assert live.account.problems[0].startswith(f"bus virtual:{bus_name} lost: No such device")
    assert "Network is down" in live.account.problems[1]


def test_an_unknown_interface_is_one_clear_line(dbc: Path) -> None:
    with pytest.raises(UnreadableRecording, match=r"'sockercan' is not known; python-can has .*socketcan"):
        LiveBus("sockercan", "can0", [CHANNEL], dbc)


def write_log(path: Path, seconds: float = 1.0) -> int:
    rows = range(round(seconds * 100))
    lines = [f"({1_790_000_000 + i / 100:.6f}) can0 123#{i.to_bytes(8, 'little').hex()}" for i in rows]
    path.write_text("\n".join(lines) + "\n")
    return len(rows)


def test_a_recording_is_played_in_real_time_and_comes_out_as_windows(dbc: Path, bus_name: str, tmp_path: Path) -> None:
    frames = write_log(tmp_path / "run.log", 1.2)
    listener = CollectingListener(LiveBus("virtual", bus_name, [CHANNEL], dbc))
    assert listener.wait(lambda: listener.bus.connected)
    begun = time.monotonic()
    assert send(tmp_path / "run.log", "virtual", bus_name) == frames
    took = time.monotonic() - begun
    assert listener.wait(lambda: len(listener.values()) == frames)
    listener.stop()
    assert took > 1.1
    windower = Windower([CHANNEL], 100.0, 100, 50)
    windows = [w for _, block in listener.blocks for w in windower.push(block)] + windower.flush()
    assert len(windows) == 1
    assert np.array_equal(listener.values(), np.arange(frames))


def test_playing_can_be_scaled_and_stopped(dbc: Path, bus_name: str, tmp_path: Path) -> None:
    frames = write_log(tmp_path / "run.log", 10.0)
    begun = time.monotonic()
    assert send(tmp_path / "run.log", "virtual", bus_name, speed=20.0) == frames
    assert time.monotonic() - begun < 8.0
    stop = threading.Event()
    stop.set()
    assert send(tmp_path / "run.log", "virtual", bus_name, stop=stop) < frames
    with pytest.raises(UnreadableRecording, match="not a CAN recording"):
        send(tmp_path / "run.mcap", "virtual", bus_name)
    with pytest.raises(UnreadableRecording, match="speed must be positive"):
        send(tmp_path / "run.log", "virtual", bus_name, speed=0.0)


@pytest.fixture
def group() -> dict[str, Any]:
    """A multicast group that works here."""
    group: dict[str, Any] = {"interface": "udp_multicast", "channel": "239.74.163.7", "port": 43219 + next(NUMBERS)}
    try:
        with can.Bus(**group) as probe, can.Bus(**group) as other:
            other.send(frame(1))
            reached = probe.recv(timeout=1.0)
    except (can.CanError, OSError) as error:
        pytest.skip(f"no multicast here: {error}")
    if reached is None:
        pytest.skip("no multicast here")
    return group


def test_datagrams_that_are_no_frames_cost_themselves(dbc: Path, group: dict[str, Any]) -> None:
    """Whoever reaches the group can send them: they neither close the bus nor end its reader."""

    def packed(**wrong: Any) -> bytes:
        fields = {"arbitration_id": 0x123, "is_extended_id": False, "dlc": 8, "data": bytes(8)} | wrong
        content: bytes = msgpack.packb(fields)
        return content

    strange = [b"", b"hello", bytes(range(256)) * 16, packed(data=1 << 62), packed(arbitration_id="x"), packed(x=1)]
    strange += [packed(arbitration_id=291.0), packed(data=b"a" * 70), msgpack.packb([1]), b"\xdd" * 5]
    strange += [packed(arbitration_id=-1), packed(data=[300]), packed(data="x"), msgpack.packb({1: 2}), b"\x91" * 2000]
    live = LiveBus("udp_multicast", group["channel"], [CHANNEL], dbc, port=group["port"])
    listener = CollectingListener(live)
    assert listener.wait(lambda: live.connected)
    with can.Bus(**group) as sender, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
        for value in range(5):
            for datagram in strange:
                stranger.sendto(datagram, (group["channel"], group["port"]))
            sender.send(frame(value))
        assert listener.wait(lambda: len(listener.values()) >= 5)
    listener.stop()
    assert sorted(listener.values()) == [0, 1, 2, 3, 4]
    assert (live.reconnects, live.problems) == (0, [])
    assert live.tally.corrupt >= 5 * (len(strange) - 2)  # python-can may take some for frames of other ids


def test_udp_multicast_carries_frames_between_buses(dbc: Path, group: dict[str, Any]) -> None:
    live = LiveBus("udp_multicast", group["channel"], [CHANNEL], dbc, port=group["port"])
    listener = CollectingListener(live)
    assert listener.wait(lambda: live.connected)
    with can.Bus(**group) as sender:
        for value in range(10):
            sender.send(frame(value))
        assert listener.wait(lambda: len(listener.values()) >= 10)
    listener.stop()
    assert Counter(listener.values()) == Counter(float(value) for value in range(10))


def test_a_frame_from_the_future_does_not_make_the_reader_deaf(dbc: Path, bus_name: str) -> None:
    bus = LiveBus("virtual", bus_name, [CHANNEL], dbc)
    now = time.time()

    def stamped(ahead: float) -> list[can.Message]:
        message = frame(1)
        message.timestamp = now + ahead
        return [message]

    assert bus._current(stamped(0.0))
    bus._current(stamped(14 * 365.25 * 86_400))
    assert bus._current(stamped(0.1))
    assert bus.lag < 1.0
    assert bus.tally.dropped == 0
    bus._current(stamped(-3600.0))
    assert bus._current(stamped(-3599.0))


def test_a_frame_without_a_possible_time_costs_itself() -> None:
    good, bad, worse = frame(1), frame(2), frame(3)
    good.timestamp, bad.timestamp, worse.timestamp = 1_790_000_000.0, float("nan"), 1e30
    account = Account()
    block = frame_block([good, bad, worse], account)
    assert block.time.tolist() == [1_790_000_000_000_000_000]
    assert account.tally.corrupt == 2


def test_a_reader_that_is_behind_gives_up_what_waits_until_it_has_caught_up(
    dbc: Path, bus_name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    bus = LiveBus("virtual", bus_name, [CHANNEL], dbc)
    clock = [1_790_000_000.0]
    monkeypatch.setattr("sprung.replay.live.time.time", lambda: clock[0])

    def read(waited: float) -> bool:
        message = frame(1)
        message.timestamp = clock[0] - waited
        return bool(bus._current([message, message]))

    assert read(0.01)
    assert read(4.0)  # late, and still worth reading
    assert not read(6.0)
    assert not read(1.0)  # nearer, and not yet caught up
    assert read(0.2)
    assert (bus.tally.dropped, bus.account.incomplete) == (4, True)


def test_frames_that_the_kernel_dropped_are_counted_once(
    dbc: Path, bus_name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    bus = LiveBus("virtual", bus_name, [CHANNEL], dbc)
    counter = iter([7, 7, 12, 12])  # of the socket, which may have lost some before it was opened here
    monkeypatch.setattr("sprung.replay.live.lost_by_kernel", lambda *_: next(counter))
    bus._opened(None)  # type: ignore[arg-type]
    for _ in range(3):
        bus._asked = -1e9
        bus._ask(None)  # type: ignore[arg-type]
    assert (bus.lost, bus.tally.dropped, bus.account.incomplete) == (5, 5, True)

"""python-can's SocketCAN bus on a socket of another kind, which this machine has: UDP counts what it drops, too."""

from __future__ import annotations

import errno
import socket
import struct
import sys
from collections.abc import Iterator
from typing import Any

import pytest
from can.interfaces.socketcan import constants

from sprung.replay.live import LiveBus
from tests.replay.test_live import CHANNEL, DATABASE, CollectingListener

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="SocketCAN is Linux's")
FRAME = struct.Struct("=IB3x8s")  # struct can_frame
ERROR = 0x20000000


class Interface:
    """What stands for can0: it may be absent or down, and notes what sockets are told."""

    def __init__(self) -> None:
        self.absent = self.down = False
        self.told: list[tuple[int, bytes | int]] = []
        self.receiver: CanSocket | None = None
        self._sender = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)

    def send(self, value: int, frame_id: int = 0x123) -> None:
        assert self.receiver is not None
        self._sender.sendto(FRAME.pack(frame_id, 8, value.to_bytes(8, "little")), self.receiver.getsockname())

    def set_down(self) -> None:
        self.down = True
        self.send(0)  # wakes the reader, as the kernel does

    def close(self) -> None:
        self._sender.close()


class CanSocket(socket.socket):
    """A socket of the interface."""

    def __init__(self, interface: Interface) -> None:
        super().__init__(socket.AF_INET, socket.SOCK_DGRAM)
        self._interface = interface
        interface.receiver = self

    def setsockopt(self, level: int, option: int, value: Any) -> None:  # type: ignore[override]
        if level == constants.SOL_CAN_RAW:
            self._interface.told.append((option, value))
        else:
            super().setsockopt(level, option, value)

    def recvmsg(self, *sizes: int) -> Any:
        if self._interface.down:
            raise OSError(errno.ENETDOWN, "Network is down")
        return super().recvmsg(*sizes)


def _bind(receiver: CanSocket, channel: str) -> None:
    assert channel == "can0"
    if receiver._interface.absent:
        receiver.close()
        raise OSError(errno.ENODEV, "No such device")
    receiver.bind(("127.0.0.1", 0))
    if receiver._interface.down:
        receiver._interface.send(0)


@pytest.fixture
def can0(monkeypatch: pytest.MonkeyPatch) -> Iterator[Interface]:
    interface, module = Interface(), "can.interfaces.socketcan.socketcan"
    monkeypatch.setattr(f"{module}.create_socket", lambda: CanSocket(interface))
    monkeypatch.setattr(f"{module}.bind_socket", _bind)
    monkeypatch.setattr("sprung.replay.live.FIRST_RETRY", 0.02)
    monkeypatch.setattr("sprung.replay.live.ASK_SECONDS", 0.0)
    yield interface
    interface.close()


@pytest.fixture
def listener(can0: Interface) -> Iterator[CollectingListener]:
    listening = CollectingListener(LiveBus("socketcan", "can0", [CHANNEL], DATABASE, latency=0.02))
    yield listening
    listening.stop()


def test_the_kernel_is_reported_which_frames_are_wanted(can0: Interface, listener: CollectingListener) -> None:
    assert listener.wait(lambda: listener.bus.connected)
    filters = [value for option, value in can0.told if option == constants.CAN_RAW_FILTER]
    assert filters[-1] == struct.pack("=II", 0x123, 0x7FF | constants.CAN_EFF_FLAG)  # that id, and no extended one
    for value in range(5):
        can0.send(value)
    assert listener.wait(lambda: listener.values() == list(range(5)))


def test_an_interface_that_goes_down_or_away_is_taken_up_again(can0: Interface, listener: CollectingListener) -> None:
    live = listener.bus
    assert listener.wait(lambda: live.connected)
    can0.send(1)
    assert listener.wait(lambda: listener.values() == [1])
    can0.set_down()
    assert listener.wait(lambda: not live.connected and "Network is down" in live.trouble)
    can0.absent = True
    assert listener.wait(lambda: "No such device" in live.trouble)
    can0.absent = can0.down = False
    assert listener.wait(lambda: live.connected)
    can0.send(2)
    assert listener.wait(lambda: listener.values() == [1, 2])
    assert live.reconnects >= 2 and live.trouble == ""


@pytest.mark.parametrize("back", [pytest.param(0x100 | ERROR, id="restarted"), pytest.param(0x123, id="a frame")])
def test_a_controller_that_is_off_the_bus_is_reported(can0: Interface, listener: CollectingListener, back: int) -> None:
    live = listener.bus
    assert listener.wait(lambda: live.connected)
    can0.send(0, 0x04 | ERROR)  # trouble of the controller, of which there is much
    can0.send(0, 0x40 | ERROR)
    assert listener.wait(lambda: not live.connected)
    assert "bus-off" in live.trouble and "bus-off" in live.problems[-1]
    can0.send(7, back)
    assert listener.wait(lambda: live.connected)
    assert live.trouble == "" and live.reconnects == 0


def test_frames_that_do_not_fit_are_counted(
    can0: Interface, listener: CollectingListener, monkeypatch: pytest.MonkeyPatch
) -> None:
    live, sent = listener.bus, 0
    assert listener.wait(lambda: live.connected)
    assert can0.receiver is not None
    can0.receiver.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2304)  # a few frames
    for _ in range(200):
        for value in range(50):
            can0.send(value)
        sent += 50
        if live.lost:
            break
    assert listener.wait(lambda: live.lost > 0)

    def complete() -> bool:
        return live.tally.used + live.lost == sent

    if not listener.wait(complete, 1.0):  # the last were dropped after the last look
        can0.send(1)
        sent += 1
    assert listener.wait(complete)
    assert live.account.incomplete

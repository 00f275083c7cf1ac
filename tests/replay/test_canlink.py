"""Whether a CAN controller only listens: what rtnetlink answers, and who is told."""

from __future__ import annotations

import logging
import struct
import sys

import can
import pytest

from sprung.replay import canlink
from sprung.replay.canlink import HEADER, INTERFACE, attribute, listens_only, mode
from sprung.replay.live import LiveBus
from sprung.service.cli import doctor
from tests.replay.test_live import CHANNEL, DATABASE


def answer(kind: str, flags: int | None) -> bytes:
    """RTM_NEWLINK of an interface, as the kernel writes it."""
    timing = attribute(1, struct.pack("=8I", 500_000, 875, 125, 6, 7, 2, 1, 5))
    control = b"" if flags is None else attribute(5, struct.pack("=II", 0, flags))
    about = attribute(1, kind.encode() + b"\0") + attribute(2 | 0x8000, timing + control)
    body = INTERFACE.pack(0, 280, 3, 0, 0) + attribute(3, b"can0\0") + attribute(18, about)
    return HEADER.pack(HEADER.size + len(body), 16, 0, 1, 0) + body


def test_the_kernel_s_answer_is_read() -> None:
    assert mode(answer("can", 0x02)) is True
    assert mode(answer("can", 0x20 | 0x02)) is True  # CAN FD, too
    assert mode(answer("can", 0x20)) is False
    assert mode(answer("can", None)) is None and mode(answer("vcan", None)) is None
    assert mode(HEADER.pack(36, 2, 0, 1, 0) + bytes(20)) is None  # NLMSG_ERROR: no such device


@pytest.mark.skipif(sys.platform != "linux", reason="rtnetlink is Linux's")
def test_what_is_no_can_interface_has_no_mode() -> None:
    assert listens_only("lo") is None
    assert listens_only("absent0") is None
    assert listens_only("x" * 300) is None


def test_a_bus_that_is_not_only_listened_to_is_told_once(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    asked: list[str] = []

    def answered(name: str) -> bool:
        asked.append(name)
        return False

    monkeypatch.setattr("sprung.replay.bus.listens_only", answered)
    live = LiveBus("socketcan", "can0", [CHANNEL], DATABASE)
    with can.Bus(interface="virtual", channel="listen-only") as bus, caplog.at_level(logging.WARNING):
        live._opened(bus)
        live._opened(bus)  # it was lost, and came back
    assert asked == ["can0"]
    [line] = caplog.messages
    assert line.startswith("socketcan:can0: the controller acknowledges frames") and "listen-only on" in line


def test_others_need_no_word(monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    for found in (True, None):
        monkeypatch.setattr("sprung.replay.bus.listens_only", lambda name, found=found: found)
        with can.Bus(interface="virtual", channel="listen-only") as bus:
            LiveBus("socketcan", "can0", [CHANNEL], DATABASE)._opened(bus)
    assert caplog.messages == []


def test_the_doctor_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    class Chattering:
        """A bus with a frame whenever it is asked."""

        def __enter__(self) -> Chattering:
            return self

        def __exit__(self, *_: object) -> None:
            pass

        def recv(self, _seconds: float) -> can.Message:
            return can.Message()

    monkeypatch.setattr(can, "Bus", lambda **_: Chattering())
    monkeypatch.setattr(doctor, "BUS_SECONDS", 0.01)
    monkeypatch.setattr("sprung.replay.bus.listens_only", lambda name: False)
    found = doctor._bus("socketcan:can0")
    assert found.state == "warning" and "acknowledges frames" in found.text
    monkeypatch.setattr("sprung.replay.bus.listens_only", canlink.listens_only)
    assert doctor._bus("socketcan:absent0").state == "ok"

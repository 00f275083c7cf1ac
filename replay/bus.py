"""CAN interfaces: naming, opening in listen-only mode, filtering, and counts of lost frames."""

from __future__ import annotations

import socket
import struct
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import can

from sprung.replay.account import UnreadableRecording
from sprung.replay.canlink import listens_only
from sprung.replay.frames import EXTENDED

# options of python-can that keep an interface from sending anything, acknowledgements included.  SocketCAN is told so
# when the interface is brought up, not when it is opened: `not_only_listened_to`
LISTEN_ONLY: dict[str, dict[str, Any]] = {
    "vector": {"listen_only": True},
    "slcan": {"listen_only": True},
    "pcan": {"state": can.BusState.PASSIVE},
    "kvaser": {"driver_mode": False},
}
FILTERS_IN_KERNEL = ("socketcan", "kvaser", "neovi", "vector", "nixnet")  # others filter in Python, after the cost
RECEIVE_BUFFER = 8 << 20  # bytes; the default of 200 kB is a tenth of a second of a busy bus
SO_RCVBUFFORCE = getattr(socket, "SO_RCVBUFFORCE", 33)
SO_MEMINFO = getattr(socket, "SO_MEMINFO", 55)
MEMINFO_WORDS, MEMINFO_DROPS = 9, 8
STATISTICS = ("rx_dropped", "rx_over_errors", "rx_fifo_errors", "rx_missed_errors")


@dataclass(frozen=True, slots=True)
class BusAddress:
    """`socketcan:can0` or `pcan:PCAN_USBBUS1,bitrate=500000,fd=true`."""

    interface: str
    channel: str
    options: dict[str, Any] = field(default_factory=dict)  # of python-can

    @property
    def name(self) -> str:
        """Without the options."""
        return f"{self.interface}:{self.channel}"


def parse_bus(text: str) -> BusAddress:
    """Raises UnreadableRecording with the syntax of bus names."""
    place, *pairs = text.split(",")
    interface, separator, channel = place.partition(":")
    if not separator or not interface or not channel:
        raise UnreadableRecording(f"CAN bus {text!r}: give INTERFACE:CHANNEL, as in socketcan:can0")
    options: dict[str, Any] = {}
    for pair in pairs:
        key, separator, value = pair.partition("=")
        if not separator or not key.strip().isidentifier():
            raise UnreadableRecording(
                f"CAN bus {text!r}: {pair!r} is no option; give name=value, as in socketcan:can0,fd=true"
            )
        options[key.strip()] = _value(value.strip())
    return BusAddress(interface, channel, options)


def opening_options(address: BusAddress, ids: Iterable[int] | None) -> dict[str, Any]:
    """Options of python-can beside interface and channel: listen-only mode and filters, if supported; what
    the user named goes before.  ids: wanted frames, with EXTENDED; None: all."""
    options = dict(LISTEN_ONLY.get(address.interface, {}))
    if ids is not None and address.interface in FILTERS_IN_KERNEL:
        options["can_filters"] = [
            {
                "can_id": frame_id & ~EXTENDED,
                "can_mask": 0x1FFFFFFF if frame_id & EXTENDED else 0x7FF,
                "extended": bool(frame_id & EXTENDED),
            }
            for frame_id in ids
        ]
    return options | address.options


def not_only_listened_to(address: BusAddress) -> str:
    """What to do about an interface whose controller takes part in the traffic; empty where it only listens, or where
    nothing is known of it."""
    if address.interface != "socketcan" or listens_only(address.channel) is not False:
        return ""
    return (
        "the controller acknowledges frames and sends error frames; to listen only: "
        f"`ip link set {address.channel} down`, then `ip link set {address.channel} up type can listen-only on`"
    )


def widen(bus: can.BusABC) -> None:
    """Let the kernel hold a few seconds of frames where it is asked through a socket."""
    sock = getattr(bus, "socket", None)
    if isinstance(sock, socket.socket):
        try:  # more than the system's limit for everybody, where the process may
            sock.setsockopt(socket.SOL_SOCKET, SO_RCVBUFFORCE, RECEIVE_BUFFER)
        except OSError:
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER)


def lost_by_kernel(bus: can.BusABC, address: BusAddress) -> int:
    """Frames that the interface or the socket has dropped since it was opened; 0 if they are not counted."""
    lost = 0
    sock = getattr(bus, "socket", None)
    if isinstance(sock, socket.socket):
        lost += socket_drops(sock)
    if address.interface == "socketcan":
        folder = Path("/sys/class/net") / Path(address.channel).name / "statistics"
        lost += sum(_count(folder / name) for name in STATISTICS)
    return lost


def socket_drops(sock: socket.socket) -> int:
    """Datagrams that did not fit into a socket's buffer (Linux; 0 elsewhere)."""
    try:
        info = sock.getsockopt(socket.SOL_SOCKET, SO_MEMINFO, 4 * MEMINFO_WORDS)
    except OSError:
        return 0
    words = struct.unpack(f"{len(info) // 4}I", info)
    return words[MEMINFO_DROPS] if len(words) > MEMINFO_DROPS else 0


def _value(text: str) -> Any:
    if text.lower() in ("true", "false"):
        return text.lower() == "true"
    for convert in (lambda t: int(t, 0), float):
        try:
            return convert(text)
        except ValueError:
            continue
    return text


def _count(path: Path) -> int:
    try:
        return int(path.read_text())
    except (OSError, ValueError):
        return 0

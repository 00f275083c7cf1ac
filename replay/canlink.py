"""What Linux says of a CAN interface, by rtnetlink: whether its controller only listens."""

from __future__ import annotations

import socket
import struct
from collections.abc import Iterator

HEADER, INTERFACE = struct.Struct("=IHHII"), struct.Struct("=BxHiII")  # nlmsghdr, ifinfomsg
ATTRIBUTE = struct.Struct("=HH")  # rtattr
RTM_NEWLINK, RTM_GETLINK, REQUEST = 16, 18, 1
IFLA_IFNAME, IFLA_LINKINFO, IFLA_INFO_KIND, IFLA_INFO_DATA = 3, 18, 1, 2
IFLA_CAN_CTRLMODE, LISTEN_ONLY = 5, 0x02  # linux/can/netlink.h
NESTED = 0x3FFF  # of an attribute's type, without flags
SECONDS, LARGEST = 1.0, 1 << 16


def listens_only(interface: str) -> bool | None:
    """Whether the controller of a CAN interface sends nothing, acknowledgements included; None where there is no
    controller (vcan), no such interface, or no Linux."""
    if not hasattr(socket, "AF_NETLINK"):
        return None
    try:
        with socket.socket(socket.AF_NETLINK, socket.SOCK_RAW, 0) as asked:
            asked.settimeout(SECONDS)
            asked.send(request(interface))
            return mode(asked.recv(LARGEST))
    except (OSError, struct.error):
        return None


def request(interface: str) -> bytes:
    """RTM_GETLINK of one interface."""
    body = INTERFACE.pack(0, 0, 0, 0, 0) + attribute(IFLA_IFNAME, interface.encode() + b"\0")
    return HEADER.pack(HEADER.size + len(body), RTM_GETLINK, REQUEST, 1, 0) + body


def mode(answer: bytes) -> bool | None:
    """`listens_only` of the kernel's answer.  Raises struct.error for one that ends early."""
    if HEADER.unpack_from(answer)[1] != RTM_NEWLINK:
        return None
    about = dict(attributes(answer[HEADER.size + INTERFACE.size :])).get(IFLA_LINKINFO, b"")
    info = dict(attributes(about))
    if info.get(IFLA_INFO_KIND, b"").rstrip(b"\0") != b"can":
        return None
    control = dict(attributes(info.get(IFLA_INFO_DATA, b""))).get(IFLA_CAN_CTRLMODE)
    if control is None:
        return None
    _, flags = struct.unpack_from("=II", control)  # struct can_ctrlmode
    return bool(flags & LISTEN_ONLY)


def attribute(kind: int, value: bytes) -> bytes:
    """One rtattr, padded to four bytes."""
    return ATTRIBUTE.pack(ATTRIBUTE.size + len(value), kind) + value + b"\0" * (-len(value) % 4)


def attributes(data: bytes) -> Iterator[tuple[int, bytes]]:
    """Type and value of each rtattr."""
    while len(data) >= ATTRIBUTE.size:
        length, kind = ATTRIBUTE.unpack_from(data)
        if length < ATTRIBUTE.size:
            return
        yield kind & NESTED, data[ATTRIBUTE.size : length]
        data = data[length + -length % 4 :]

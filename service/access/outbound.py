"""Addresses that the service may call by itself: an event must not become a request to what only this host reaches.

A name is resolved once, every address that it has is judged, and the connection goes to one that was judged: a name
that points elsewhere a moment later (DNS rebinding) changes nothing.  Proxies of the environment are not used.
"""

from __future__ import annotations

import http.client
import ipaddress
import os
import socket
import ssl
import threading
from collections.abc import Iterable, Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from urllib.parse import urlsplit

from sprung.service.errors import UserError

Address = ipaddress.IPv4Address | ipaddress.IPv6Address
Network = ipaddress.IPv4Network | ipaddress.IPv6Network
LONGEST = 300
NAT64 = ipaddress.ip_network("64:ff9b::/96")
# of IANA's special-purpose registries, what versions of Python before 3.11.10 take for public: among it the addresses
# at which clouds tell a machine its secrets.  168.63.129.16 is Azure's, an ordinary address that its hosts answer.
INNER = tuple(map(ipaddress.ip_network, ("192.0.0.0/24", "168.63.129.16", "fec0::/10", "5f00::/16", "3fff::/20")))
SETTING = "SPRUNG_WEBHOOK_NETWORKS"


class ForbiddenAddress(ValueError):
    """A receiver at an address that the settings do not allow."""


@dataclass(frozen=True, slots=True)
class Receiver:
    """A URL, taken apart."""

    scheme: str  # http or https
    host: str
    port: int
    target: str  # path and query


def networks(given: Iterable[str]) -> tuple[Network, ...]:
    """Networks as 10.0.0.0/8 or fd00::/8.  Raises UserError."""
    try:
        return tuple(ipaddress.ip_network(one) for one in given)
    except ValueError as error:
        raise UserError(f"setting webhook_networks ({SETTING}): {error}") from None


def safe_url(url: str) -> Receiver:
    """The parts of a URL that events may be sent to, as far as its text shows, without resolving its name.

    Raises UserError for anything but a plain http(s) URL without user and password.
    """
    try:
        parts = urlsplit(url)
        host, port = parts.hostname or "", parts.port
    except ValueError as error:
        raise UserError(f"{url[:80]!r} is no http:// or https:// URL ({error})") from None
    if parts.scheme not in ("http", "https") or not host or len(url) > LONGEST:
        raise UserError(f"{url[:80]!r} is no http:// or https:// URL")
    if not url.isascii() or not url.isprintable() or " " in url:
        raise UserError(f"{url[:80]!r} has characters that a URL cannot have; write them as %XX")
    if parts.username is not None or parts.password is not None:
        raise UserError(f"the URL at {host!r} holds a user or a password; receivers check the signature instead")
    target = (parts.path or "/") + (f"?{parts.query}" if parts.query else "")
    return Receiver(parts.scheme, host, port or {"http": 80, "https": 443}[parts.scheme], target)


def judged(address: Address, allowed: Sequence[Network]) -> str | None:
    """What is wrong with an address; None: it may be called."""
    plain = _inner(address)
    if any(plain in network for network in allowed if network.version == plain.version):
        return None
    if plain.is_loopback:
        kind = "this host itself"
    elif plain.is_link_local:
        kind = "a link-local address, where clouds keep their secrets"
    elif plain.is_multicast or plain.is_unspecified or plain.is_reserved:
        kind = "no address of a single host"
    elif not plain.is_global or any(plain in network for network in INNER if network.version == plain.version):
        kind = "a private address"
    else:
        return None
    return f"{address} is {kind}; {SETTING} can allow it"


def _inner(address: Address) -> Address:
    """The IPv4 address that an IPv6 address stands for, where it does."""
    if isinstance(address, ipaddress.IPv4Address):
        return address
    if address in NAT64:
        return ipaddress.IPv4Address(int(address) & 0xFFFFFFFF)
    return address.ipv4_mapped or address.sixtofour or address


def resolved(receiver: Receiver, allowed: Sequence[Network]) -> list[str]:
    """The addresses of a receiver.  Raises ForbiddenAddress when one of them may not be called, OSError for none."""
    found = socket.getaddrinfo(receiver.host, receiver.port, type=socket.SOCK_STREAM)
    addresses = list(dict.fromkeys(str(entry[4][0]) for entry in found))
    for text in addresses:
        wrong = judged(ipaddress.ip_address(text.partition("%")[0]), allowed)
        if wrong is not None:
            raise ForbiddenAddress(f"{receiver.host}: {wrong}")
    return addresses


def post(url: str, body: bytes, headers: dict[str, str], allowed: Sequence[Network], seconds: float) -> int:
    """Send to an address that was judged; the status of the answer.  Redirections are not followed.

    seconds: to connect, and for all that follows.  Raises ForbiddenAddress, UserError, OSError, or
    http.client.HTTPException for an answer that is none.
    """
    receiver = safe_url(url)
    error: OSError | None = None
    for address in resolved(receiver, allowed):
        try:
            line = socket.create_connection((address, receiver.port), seconds)
        except OSError as failed:
            error = failed
            continue
        with closing(line), _within(line, seconds), closing(_spoken(receiver, line)) as connection:
            connection.request("POST", receiver.target, body, headers)
            return connection.getresponse().status
    raise error or OSError(f"{receiver.host} has no address")


@contextmanager
def _within(line: socket.socket, seconds: float) -> Iterator[None]:
    """Close connections that take longer in total: the time-out of a socket restarts with every byte."""
    ended = hung_up_after(line, seconds)
    try:
        yield
    finally:
        ended.cancel()


def hung_up_after(line: socket.socket, seconds: float) -> threading.Timer:
    """A timer, running, that ends a connection; its descriptor may be taken over by TLS, or closed, meanwhile."""
    same = socket.socket(fileno=os.dup(line.fileno()))

    def hang_up() -> None:
        with suppress(OSError):
            same.shutdown(socket.SHUT_RDWR)

    class Timer(threading.Timer):
        def run(self) -> None:
            with closing(same):
                super().run()

    ended = Timer(seconds, hang_up)
    ended.daemon = True
    try:
        ended.start()
    except RuntimeError:  # no thread for it
        same.close()
        raise
    return ended


def _spoken(receiver: Receiver, line: socket.socket) -> http.client.HTTPConnection:
    """HTTP over a line to one address, in the receiver's name: TLS checks the certificate against that."""
    if receiver.scheme == "http":
        connection = http.client.HTTPConnection(receiver.host, receiver.port)
    else:
        connection = http.client.HTTPSConnection(receiver.host, receiver.port)
        line = ssl.create_default_context().wrap_socket(line, server_hostname=receiver.host)
    connection.sock = line
    return connection

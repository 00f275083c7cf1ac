"""The address at which the service takes connections."""

from __future__ import annotations

import socket

from sprung.service.errors import UserError
from sprung.service.settings import Settings


def scheme(settings: Settings) -> str:
    """Of the addresses that are announced."""
    return "http" if settings.tls_certificate is None else "https"


def open_socket(settings: Settings) -> socket.socket:
    """A socket that listens.  Raises OSError where another program has the address."""
    found = socket.getaddrinfo(settings.host, settings.port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
    family, _, _, _, address = found[0]
    return socket.create_server(address[:2], family=family, backlog=1024)


def listen(settings: Settings) -> socket.socket:
    """The socket, before anything else is started, so that a port in use is a plain error."""
    try:
        return open_socket(settings)
    except OSError as error:
        detail = error.strerror or error
        raise UserError(f"cannot listen on {settings.host}:{settings.port}: {detail}; choose another --port") from error

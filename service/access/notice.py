"""What a service that asks for no token says when it starts."""

from __future__ import annotations

import ipaddress
import sys

from sprung.service.errors import UserError
from sprung.service.settings import Settings


def access_notice(settings: Settings, tokens: bool) -> str:
    """What to say about a service that asks for no token; empty where it does.  Raises UserError where that is not
    wanted."""
    if settings.open:
        return "requests need no token, as SPRUNG_OPEN says: whoever reaches this address may do anything"
    if tokens:
        return ""
    if not is_loopback(settings.host):
        raise UserError(
            f"{settings.host} can be reached by others, and there is no token: make one with `sprung token create`, "
            "set SPRUNG_ADMIN_TOKEN, or say SPRUNG_OPEN=true behind a proxy that asks for sign-in"
        )
    return "requests need no token, as only this machine reaches the address; `sprung token create` changes that"


def announce_access(notice: str) -> None:
    """One line on stderr."""
    print(f"sprung: {notice}", file=sys.stderr, flush=True)


def is_loopback(host: str) -> bool:
    """Whether an address is reached from this machine only."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host.lower() == "localhost"

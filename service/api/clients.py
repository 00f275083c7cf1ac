"""Who counts as one client, wherever something is limited per client."""

from __future__ import annotations

import ipaddress
from functools import lru_cache

NETWORK_BITS = 64  # of IPv6, that one customer or machine is given whole (RFC 6177, RFC 7934)


@lru_cache(maxsize=10_000)
def client_of(address: str) -> str:
    """The client behind an address: itself, of IPv6 its network of 2**64 addresses; other text is its own client."""
    try:
        found = ipaddress.ip_address(address.partition("%")[0])
    except ValueError:
        return address
    if found.version == 4:
        return str(found)
    if found.ipv4_mapped is not None:
        return str(found.ipv4_mapped)
    return str(ipaddress.ip_network((int(found) >> NETWORK_BITS << NETWORK_BITS, NETWORK_BITS)))

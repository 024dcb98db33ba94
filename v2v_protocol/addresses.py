"""What an address says about where its peer is. Pure."""

from __future__ import annotations

import ipaddress


def is_loopback(host: str) -> bool:
    """Whether a host name, or an IP address in digits, is surely this machine."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def leaves_host(address: str) -> bool:
    """Whether what is sent to a ZeroMQ address may travel over a network: all but ``ipc://`` and loopback."""
    scheme, _, rest = address.partition("://")
    return scheme == "tcp" and not is_loopback(rest.rpartition(":")[0].strip("[]"))

"""Decide from an address where its peer is. Pure."""

from __future__ import annotations

import ipaddress


def is_loopback(host: str) -> bool:
    """Return whether a host name, or an IP address in digits, is certainly this machine."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def leaves_host(address: str) -> bool:
    """Return whether data sent to a ZeroMQ address may travel over a network: all but ``ipc://`` and loopback."""
    scheme, _, rest = address.partition("://")
    return scheme == "tcp" and not is_loopback(rest.rpartition(":")[0].strip("[]"))

"""Find the user at the other end of a connection on loopback. I/O, Linux.

A server asks this about each peer, and a peer about its server before it says anything. The other end on this host has
a socket of its own, whose local end is the address that we see as its peer. The kernel knows which user made it. An
exact query (``sock_diag(7)``) takes microseconds and needs no rights. Where it finds nothing or is not allowed,
``/proc/net/tcp`` is read, in time that grows with the number of connections.

A closed socket has no inode and seems to belong to root, so only an established one with an inode counts.
"""

from __future__ import annotations

import os
import socket
import struct
import time
from collections.abc import Callable
from contextlib import suppress
from ipaddress import IPv6Address, ip_address
from pathlib import Path
from typing import Literal, TypeAlias

from v2v_protocol.keys import is_loopback

_TABLES = Path("/proc/net")
_OVERFLOW_USER = Path("/proc/sys/kernel/overflowuid")
_SAY_SECONDS = 60.0
_ESTABLISHED = 1
_SOCK_DIAG, _BY_FAMILY, _REQUEST, _ERROR = 4, 20, 1, 2  # of linux/netlink.h and linux/sock_diag.h
_HEADER_BYTES, _OWNER_AT = 16, 80  # in an answer: header and struct inet_diag_msg, which ends with user and inode
_ANY_INTERFACE_OR_COOKIE = struct.pack("=III", 0, 0xFFFFFFFF, 0xFFFFFFFF)
_MAPPED = bytes(10) + b"\xff\xff"
_End: TypeAlias = tuple[bytes, int]


class OwnUser:
    """Admit connections of this process's user and of root.

    Args:
        rule: who is served and what to do, for the line about a refused user.
        say: writes that line, at most once a minute for each user.
    """

    def __init__(self, rule: str, say: Callable[[str, Literal["warning"]], object]) -> None:
        self._rule, self._say = rule, say
        self._said_at: dict[str, float] = {}

    def admits(self, link: socket.socket) -> bool:
        """Return whether a connection may stay."""
        with suppress(OSError):  # it has just ended
            if not (who := other_user(link)):
                return True
            if (now := time.monotonic()) >= self._said_at.get(who, now):
                self._said_at[who] = now + _SAY_SECONDS
                self._say(f"refused a connection of {who}, not root or user {os.geteuid()}: {self._rule}", "warning")
        return False


def other_user(link: socket.socket) -> str:
    """Name the user at the other end of a connection; empty if it is root or this process's own.

    Raises:
        OSError: the connection has just ended.
    """
    # To a Unix socket ZeroMQ admits only our own user.
    user = 0 if link.family == socket.AF_UNIX else owner(_end(link.getpeername()), _end(link.getsockname()))
    # Users that a user namespace does not map all have the same number, so it identifies none.
    if user == 0 or (user == os.geteuid() and user != int(_OVERFLOW_USER.read_text())):
        return ""
    if link.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, 1)[0] != _ESTABLISHED:
        raise ConnectionAbortedError
    return "an unknown user" if user is None else f"user {user}"


def loopback_user(descriptor: int) -> str:
    """Do the same for a connection of ZeroMQ; empty if its other end has no loopback address."""
    with socket.fromfd(descriptor, -1, -1) as link:
        return other_user(link) if is_loopback(link.getpeername()[0]) else ""


def owner(local: _End, remote: _End) -> int | None:
    """Return the user of the socket with these ends; None if there is none."""
    # A socket for IPv6 may use IPv4 addresses, which it writes in the longer form.
    forms = [(socket.AF_INET6, local, remote)]
    if local[0].startswith(_MAPPED):
        forms.insert(0, (socket.AF_INET, (local[0][12:], local[1]), (remote[0][12:], remote[1])))
    for form in forms:
        try:
            found = _ask(*form)
        except OSError:
            found = _look_up(*form)
        if found is not None:
            return found
    return None


def _end(address: tuple[str, int]) -> _End:
    """Return an address of a socket as 16 bytes and a port."""
    host = ip_address(address[0])
    return (host.packed if isinstance(host, IPv6Address) else _MAPPED + host.packed), address[1]


def _ask(family: int, local: _End, remote: _End) -> int | None:
    """Ask for one socket (``struct inet_diag_req_v2``).

    Raises:
        OSError: there is no such socket, or the kernel does not answer such queries.
    """
    query = struct.pack("=BBBxI", family, socket.IPPROTO_TCP, 0, 1 << _ESTABLISHED)
    query += struct.pack("!HH16s16s", local[1], remote[1], local[0], remote[0]) + _ANY_INTERFACE_OR_COOKIE
    with socket.socket(socket.AF_NETLINK, socket.SOCK_RAW, _SOCK_DIAG) as kernel:
        kernel.send(struct.pack("=IHHII", _HEADER_BYTES + len(query), _BY_FAMILY, _REQUEST, 0, 0) + query)
        answer = kernel.recv(4096, socket.MSG_DONTWAIT)
    if struct.unpack_from("=IH", answer)[1] == _ERROR:
        # There is no such socket (ENOENT), or the kernel lacks the module that looks (ENOENT too).
        raise OSError(-int(struct.unpack_from("=i", answer, _HEADER_BYTES)[0]), "no answer")
    user, inode = struct.unpack_from("=II", answer, _OWNER_AT)
    # If nothing has these ends, the answer is the socket that listens at the local one.
    is_it = answer[17] == _ESTABLISHED and struct.unpack_from("!HH", answer, 20) == (local[1], remote[1])
    return int(user) if is_it and inode else None


def _look_up(family: int, local: _End, remote: _End) -> int | None:
    """Look for one socket in the kernel's table."""
    # Not without a descriptor for it, which says nothing of the user.
    with (
        suppress(FileNotFoundError, PermissionError),
        (_TABLES / ("tcp" if family == socket.AF_INET else "tcp6")).open() as table,
    ):
        for line in table:
            fields = line.split()
            if fields[1:4] == [_hexadecimal(local), _hexadecimal(remote), f"{_ESTABLISHED:02X}"] and fields[9] != "0":
                return int(fields[7])
    return None


def _hexadecimal(end: _End) -> str:
    words = struct.unpack(f"={len(end[0]) // 4}I", end[0])
    return f"{''.join(f'{word:08X}' for word in words)}:{end[1]:04X}"

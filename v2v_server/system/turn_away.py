"""Has the kernel turn away newcomers from some addresses before there is a connection (Linux).

A socket that listens can have a filter of its own, a few instructions (classic BPF) that the kernel runs on each packet
that comes for it. It needs no rights. What the filter drops costs this process nothing; who sent it hears nothing and
tries again after seconds. A connection inherits the filter that was there when it came, for good: so only packets that
ask for a connection (SYN) are dropped.
"""

from __future__ import annotations

import ctypes
import ipaddress
import socket
import struct
import sys
from collections.abc import Sequence
from contextlib import suppress

_SO_ATTACH_FILTER, _SO_DETACH_FILTER = 26, 27
_NETWORK_HEADER = 0x100000000 - 0x100000
"""Where loads are from the beginning of the IP header, not of TCP's."""
_RANDOM = 0x100000000 - 0x1000 + 56
_TCP_FLAGS, _SYN = 13, 0x02
_LOAD_BYTE, _LOAD_WORD, _SHIFT_RIGHT, _AND, _JUMP, _JUMP_IF_EQUAL, _RETURN = 0x30, 0x20, 0x74, 0x54, 0x05, 0x15, 0x06
_IPV4_SOURCE, _IPV6_SOURCE = 12, 8
_ALL = 0xFFFFFFFF
BY_CHANCE = 64
"""Of so many strangers one is let in, a power of 2."""


def network_of(host: str) -> bytes:
    """What counts as one caller: 4 bytes of an IPv4 address; of an IPv6 address the first 8, because whoever has one
    has all that begin so.

    Raises:
        ValueError: it is no IP address.
    """
    address = ipaddress.ip_address(host.partition("%")[0])
    if isinstance(address, ipaddress.IPv6Address) and address.ipv4_mapped is not None:
        address = address.ipv4_mapped
    return address.packed[:8]


def shown(network: bytes) -> str:
    """A caller in words."""
    if len(network) == 4:
        return str(ipaddress.IPv4Address(network))
    return f"{ipaddress.IPv6Address(network + bytes(8))}/64"


def turn_away(listening: int, networks: Sequence[bytes], known: Sequence[bytes] | None = None) -> bool:
    """From now on newcomers from these networks are dropped.

    Args:
        listening: descriptor of a TCP socket that listens; it stays its owner's.
        networks: of :func:`network_of`, a few hundred at most.
        known: if given, whoever is from none of these is dropped, too, but for one in :data:`BY_CHANCE`.

    Returns:
        False where the system has no such filter, or the descriptor is no such socket: nothing was changed.
    """
    if not sys.platform.startswith("linux"):
        return False
    with suppress(OSError):
        listener = socket.socket(fileno=listening)
        try:
            is_tcp = listener.family in (socket.AF_INET, socket.AF_INET6)
            if not is_tcp or not listener.getsockopt(socket.SOL_SOCKET, socket.SO_ACCEPTCONN):
                return False
            if not networks and known is None:
                with suppress(FileNotFoundError):  # it had none
                    listener.setsockopt(socket.SOL_SOCKET, _SO_DETACH_FILTER, 0)
                return True
            code = program(networks, known)
            buffer = ctypes.create_string_buffer(code, len(code))
            filter_ = struct.pack("@HP", len(code) // 8, ctypes.addressof(buffer))
            listener.setsockopt(socket.SOL_SOCKET, _SO_ATTACH_FILTER, filter_)
            return True
        finally:
            listener.detach()
    return False


def program(networks: Sequence[bytes], known: Sequence[bytes] | None = None) -> bytes:
    """The filter's instructions: 0 for a packet that is to be dropped, else all of it."""
    on_four, on_six = [_load(_IPV4_SOURCE)], []
    for verdict, group in ((0, networks), (_ALL, known or ())):
        for network in group:
            if len(network) == 4:
                on_four += [_if_equal(int.from_bytes(network), otherwise=1), _return(verdict)]
            else:
                first, second = struct.unpack(">II", network)
                on_six += [_load(_IPV6_SOURCE), _if_equal(first, otherwise=3)]
                on_six += [_load(_IPV6_SOURCE + 4), _if_equal(second, otherwise=1), _return(verdict)]
    others = [_return(_ALL)]
    if known is not None:
        chance = [_instruction(_LOAD_WORD, _RANDOM), _instruction(_AND, BY_CHANCE - 1)]
        others = [*chance, _if_equal(0, otherwise=1), _return(_ALL), _return(0)]
    on_four, on_six = on_four + others, on_six + others
    asks = [_instruction(_LOAD_BYTE, _TCP_FLAGS), _instruction(_AND, _SYN)]
    asks += [_if_equal(_SYN, otherwise=0, then=1), _return(_ALL)]
    version = [_instruction(_LOAD_BYTE, _NETWORK_HEADER), _instruction(_SHIFT_RIGHT, 4)]
    version += [_if_equal(4, otherwise=0, then=1), _instruction(_JUMP, len(on_four))]
    return b"".join([*asks, *version, *on_four, *on_six])


def _instruction(code: int, value: int, then: int = 0, otherwise: int = 0) -> bytes:
    return struct.pack("=HBBI", code, then, otherwise, value)


def _load(offset: int) -> bytes:
    """A word of the IP header."""
    return _instruction(_LOAD_WORD, _NETWORK_HEADER + offset)


def _if_equal(value: int, otherwise: int, then: int = 0) -> bytes:
    """Skips as many instructions."""
    return _instruction(_JUMP_IF_EQUAL, value, then, otherwise)


def _return(value: int) -> bytes:
    return _instruction(_RETURN, value)

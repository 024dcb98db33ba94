"""The filter on a socket that listens: an interpreter says what its instructions mean, and the kernel does it."""

from __future__ import annotations

import ipaddress
import socket
import struct
import sys
from collections.abc import Iterator

import pytest
from hypothesis import given
from hypothesis import strategies as st

from v2v_server.system.turn_away import BY_CHANCE, network_of, program, shown, turn_away

ADDRESSES = st.one_of(st.ip_addresses(v=4), st.ip_addresses(v=6)).map(str)


SYN, ACK = bytes(13) + b"\x02" + bytes(6), bytes(13) + b"\x10" + bytes(6)


def packet(source: str) -> bytes:
    """The IP header of a packet from there."""
    address = ipaddress.ip_address(source)
    if isinstance(address, ipaddress.IPv6Address) and address.ipv4_mapped is not None:
        address = address.ipv4_mapped  # such packets are IPv4 on the wire
    if isinstance(address, ipaddress.IPv4Address):
        return b"\x45" + bytes(11) + address.packed + bytes(4)
    return b"\x60" + bytes(7) + address.packed + bytes(16)


def interpreted(code: bytes, header: bytes, tcp: bytes = SYN, chance: int = 0) -> int:
    """What a filter returns; written after the manual of classic BPF, not after the program.

    Args:
        header, tcp: the packet.
        chance: what the kernel's random number is.
    """
    instructions = list(struct.iter_unpack("=HBBI", code))
    register, at = 0, 0
    while True:
        code_, then, otherwise, value = instructions[at]
        at += 1
        if value >= 0xFFFFF000:
            loaded, offset = chance.to_bytes(4), 0
        elif value >= 0xFFF00000:
            loaded, offset = header, value - 0xFFF00000
        else:
            loaded, offset = tcp, value
        match code_:
            case 0x30:
                register = loaded[offset]
            case 0x20:
                register = int.from_bytes(loaded[offset : offset + 4])
            case 0x74:
                register >>= value
            case 0x54:
                register &= value
            case 0x05:
                at += value
            case 0x15:
                at += then if register == value else otherwise
            case 0x06:
                return int(value)
            case _:
                raise AssertionError(f"instruction {code_:#x}")


@given(away=st.lists(ADDRESSES, max_size=20), other=ADDRESSES)
def test_who_is_away_is_dropped_and_nobody_else(away: list[str], other: str) -> None:
    networks = {network_of(each) for each in away}
    code = program(networks)
    for each in away:
        assert interpreted(code, packet(each)) == 0
        assert interpreted(code, packet(each), ACK) != 0  # a connection that is open has this filter, too
    assert (interpreted(code, packet(other)) == 0) == (network_of(other) in networks)


@given(
    away=st.lists(ADDRESSES, max_size=10),
    known=st.lists(ADDRESSES, max_size=10),
    other=ADDRESSES,
    chance=st.integers(0, 2**32 - 1),
)
def test_strangers_get_in_by_chance(away: list[str], known: list[str], other: str, chance: int) -> None:
    away_, known_ = ([*map(network_of, each)] for each in (away, known))
    code = program(away_, known_)
    for each in (*away, *known, other):
        network = network_of(each)
        gets_in = network not in away_ and (network in known_ or chance % BY_CHANCE == 0)
        assert (interpreted(code, packet(each), SYN, chance) != 0) == gets_in
        assert interpreted(code, packet(each), ACK, chance) != 0


def test_the_longest_program_is_one_that_the_kernel_takes() -> None:
    longest = [number.to_bytes(8) for number in range(256)]
    assert len(program(longest, longest)) // 8 < 4096
    with socket.create_server(("127.0.0.1", 0)) as server:
        assert turn_away(server.fileno(), longest, longest) == (sys.platform == "linux")


def test_what_counts_as_one_caller() -> None:
    assert network_of("::ffff:10.0.0.1") == network_of("10.0.0.1") == bytes((10, 0, 0, 1))
    assert network_of("2001:db8::1") == network_of("2001:db8::ffff:2") != network_of("2001:db8:0:1::1")
    assert network_of("fe80::1%eth0") == network_of("fe80::2")
    assert shown(network_of("10.0.0.1")) == "10.0.0.1"
    assert shown(network_of("2001:db8::1")) == "2001:db8::/64"


@pytest.fixture
def listener() -> Iterator[socket.socket]:
    with socket.create_server(("127.0.0.1", 0)) as server:
        yield server


def gets_in(listener: socket.socket, source: str) -> bool:
    with socket.socket() as peer:
        peer.settimeout(0.3)  # the answer comes at once, or never
        peer.bind((source, 0))
        try:
            peer.connect(listener.getsockname())
        except TimeoutError:
            return False
        return True


@pytest.mark.skipif(sys.platform != "linux", reason="Linux has such filters, and 127.0.0.2 without being told")
def test_the_kernel_turns_away(listener: socket.socket) -> None:
    open_before = socket.create_connection(listener.getsockname(), 5.0, ("127.0.0.2", 0))
    accepted, _ = listener.accept()
    assert turn_away(listener.fileno(), [network_of("127.0.0.2"), network_of("::1")])
    assert not gets_in(listener, "127.0.0.2")
    assert gets_in(listener, "127.0.0.3")
    with open_before, accepted:  # what is open goes on
        open_before.sendall(b"still here")
        assert accepted.recv(100) == b"still here"
    assert turn_away(listener.fileno(), [network_of("127.0.0.3")])
    assert gets_in(listener, "127.0.0.2")
    assert not gets_in(listener, "127.0.0.3")
    assert turn_away(listener.fileno(), [], [network_of("127.0.0.3")])
    assert gets_in(listener, "127.0.0.3")
    assert not all(gets_in(listener, "127.0.0.2") for _ in range(5))
    assert turn_away(listener.fileno(), [])
    assert turn_away(listener.fileno(), [])
    assert all(gets_in(listener, "127.0.0.2") for _ in range(5))


@pytest.mark.skipif(sys.platform != "linux", reason="Linux has such filters")
def test_the_kernel_turns_away_by_either_kind_of_address() -> None:
    try:
        server = socket.create_server(("::", 0), family=socket.AF_INET6, dualstack_ipv6=True)
    except OSError:
        pytest.skip("no IPv6 here")

    def reaches(host: str) -> bool:
        try:
            with socket.create_connection((host, server.getsockname()[1]), 0.3):
                return True
        except TimeoutError:
            return False

    with server:
        for away, four, six in (([], True, True), (["::1"], True, False), (["127.0.0.1"], False, True)):
            assert turn_away(server.fileno(), [*map(network_of, away)])
            assert (reaches("127.0.0.1"), reaches("::1")) == (four, six)


@pytest.mark.skipif(sys.platform != "linux", reason="Linux has such filters")
def test_sockets_of_other_kinds_are_left_alone(listener: socket.socket) -> None:
    ours, theirs = socket.socketpair()
    with ours, theirs, socket.create_connection(listener.getsockname()) as connection:
        assert not turn_away(ours.fileno(), [network_of("127.0.0.2")])
        assert not turn_away(connection.fileno(), [network_of("127.0.0.2")])
    assert not turn_away(1 << 20, [network_of("127.0.0.2")])

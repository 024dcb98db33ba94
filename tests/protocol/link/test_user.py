"""The user of a connection on loopback: as the kernel names it, and who is refused."""

from __future__ import annotations

import os
import socket
import sys
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from v2v_protocol.link import user
from v2v_protocol.link.user import OwnUser

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="only Linux names the user")


def fail(text: str, level: str) -> None:
    pytest.fail(f"{level}: {text}")


@pytest.fixture(params=["asked", "looked up"])
def check(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> OwnUser:
    """Return the check, with the kernel's answer and where it gives none."""

    def deny(*query: object) -> None:
        raise PermissionError

    if request.param == "looked up":
        monkeypatch.setattr(user, "_ask", deny)
    return OwnUser("", fail)


@contextmanager
def connected(server: str = "127.0.0.1", client: str = "127.0.0.1") -> Iterator[tuple[socket.socket, socket.socket]]:
    """Yield the server's end of a connection, and the client's."""
    family = socket.AF_INET6 if ":" in server else socket.AF_INET
    with (
        socket.create_server((server, 0), family=family, dualstack_ipv6=server == "::") as listening,
        socket.socket(socket.AF_INET6 if ":" in client else socket.AF_INET) as theirs,
    ):
        theirs.connect((client, listening.getsockname()[1]))
        with listening.accept()[0] as ours:
            yield ours, theirs


def owner(link: socket.socket) -> int | None:
    return user.owner(user._end(link.getpeername()), user._end(link.getsockname()))


@pytest.mark.parametrize(
    ("server", "client"),
    [("127.0.0.1", "127.0.0.1"), ("::1", "::1"), ("127.0.0.1", "::ffff:127.0.0.1"), ("::", "127.0.0.1")],
)
def test_the_user_is_named_in_both_families(check: OwnUser, server: str, client: str) -> None:
    with connected(server, client) as (ours, _):
        assert owner(ours) == os.geteuid()
        assert check.admits(ours)


@pytest.mark.skipif(os.name != "posix" or os.geteuid() != 0, reason="gives a socket to another user: as root")
@pytest.mark.usefixtures("check")
def test_only_the_socket_whose_local_end_is_the_peer_counts() -> None:
    """The server's end has the same two addresses, and belongs to the server's user."""
    with connected() as (ours, theirs):
        os.fchown(theirs.fileno(), 65534, 65534)
        assert owner(ours) == 65534
        assert owner(theirs) == 0


def test_a_closed_peer_is_not_root(check: OwnUser) -> None:
    with connected() as (ours, theirs):
        theirs.close()
        assert owner(ours) is None
        assert not check.admits(ours)  # and says nothing: the peer does not wait for an answer


@pytest.mark.usefixtures("check")
def test_a_socket_that_only_listens_at_the_address_is_not_the_peer() -> None:
    with connected() as (ours, _):
        listening = user._end(ours.getsockname())
        assert user.owner(listening, user._end(("127.0.0.1", 9))) is None


def refuse(monkeypatch: pytest.MonkeyPatch, named: int | None, own: int) -> list[str]:
    """Return what is said if a server of one user gets two connections of another."""
    said: list[str] = []
    check = OwnUser("the rule", lambda text, level: said.append(text))
    monkeypatch.setattr(user, "owner", lambda local, remote: named)
    monkeypatch.setattr(os, "geteuid", lambda: own)
    with connected() as (ours, _):
        assert not check.admits(ours)
        assert not check.admits(ours)
    return said


def test_a_refusal_says_once_which_user_and_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    (said,) = refuse(monkeypatch, 1001, 1000)
    assert "user 1001" in said
    assert "user 1000" in said
    assert said.endswith(": the rule")


def test_no_answer_means_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    assert "an unknown user" in refuse(monkeypatch, None, 1000)[0]


def test_the_user_of_all_that_a_namespace_does_not_map_is_never_our_own(monkeypatch: pytest.MonkeyPatch) -> None:
    assert "user 65534" in refuse(monkeypatch, 65534, 65534)[0]


@pytest.mark.parametrize("named", [0, 1000])
def test_root_and_our_own_user_are_admitted(monkeypatch: pytest.MonkeyPatch, named: int) -> None:
    check = OwnUser("", fail)
    monkeypatch.setattr(user, "owner", lambda local, remote: named)
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    with connected() as (ours, _):
        assert check.admits(ours)

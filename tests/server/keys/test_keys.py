"""Keys on real sockets: who has none, a revoked one or the other side's gets nothing beyond the handshake."""

from __future__ import annotations

import json
import os
import socket
import stat
import struct
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path

import pytest
import zmq

from tests.protocol.link.test_guard import next_from
from tests.waiting import until
from v2v_protocol.errors import KeyRefused, UsageError, V2VError
from v2v_protocol.keys import is_key, key_for, read_key
from v2v_protocol.link.dealer import Dealer, Handshakes, mechanism_of, secure
from v2v_protocol.link.router import FromConsumer, FromWorker, Gate, ServerInput, Sockets
from v2v_protocol.messages import Ping, Pong, encode, largest_frame_bytes
from v2v_server.commands.keys import main
from v2v_server.keys import KeyFolder
from v2v_server.worker.process import pack

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="only Linux has a connection guard")


@pytest.fixture
def folder(tmp_path: Path) -> KeyFolder:
    made = KeyFolder(tmp_path / "keys")
    made.init()
    made.new("gpu1", "consumer", tmp_path / "gpu1.key")
    made.new("cpu1", "worker", tmp_path / "cpu1.key")
    return made


@pytest.fixture
def sockets(folder: KeyFolder) -> Iterator[Sockets]:
    opened = Sockets("tcp://127.0.0.1:*", "tcp://127.0.0.1:*", keys=folder, local_bind=f"ipc://@v2v-keys-{os.getpid()}")
    yield opened
    opened.close()


@pytest.fixture
def gate(sockets: Sockets) -> Gate:
    assert sockets._gate is not None
    return sockets._gate


@pytest.fixture
def consumer(sockets: Sockets) -> Iterator[Callable[..., Dealer]]:
    links: list[Dealer] = []

    def connect(file: Path | None, address: str = sockets.address) -> Dealer:
        links.append(Dealer(address, "" if file is None else str(file)))
        links[-1].connect(1 << 16)
        links[-1].send(encode(Ping()))
        return links[-1]

    yield connect
    for link in links:
        link.close()


def refusal(link: Dealer) -> str:
    """What the link says when it learns that it may not come in, which takes seconds at most."""
    ends = time.monotonic() + 60.0
    while time.monotonic() < ends:
        try:
            assert link.receive(0.1) is None
            link.has_reconnected()
        except KeyRefused as error:
            return str(error)
    raise AssertionError("it was not told")


def arrivals(sockets: Sockets, seconds: float) -> list[ServerInput]:
    ends = time.monotonic() + seconds
    found: list[ServerInput] = []
    while time.monotonic() < ends:
        found += [each for each in sockets.receive(0.05) if isinstance(each, FromConsumer | FromWorker)]
    return found


@pytest.mark.parametrize("frame", [bytes(1 << 21), pack(os.urandom(1 << 21))], ids=["raw", "compressed noise"])
def test_the_largest_array_passes_encrypted(sockets: Sockets, tmp_path: Path, frame: bytes) -> None:
    """ZeroMQ's limit counts what CURVE adds to a frame; samples of the paper's size never came without compression."""
    with closing(Dealer(sockets.address, str(tmp_path / "gpu1.key"))) as link:
        link.connect(largest_frame_bytes([1 << 21]))
        link.send(encode(Ping()))
        arrival = next_from(sockets, FromConsumer)
        assert isinstance(arrival, FromConsumer)
        assert sockets.send(arrival.identity, [*encode(Pong()), frame])
        until(lambda: link.receive(0.1))


def test_who_has_no_key_is_told_what_to_do(sockets: Sockets, consumer: Callable[..., Dealer]) -> None:
    said = refusal(consumer(None))
    assert "asks for a key" in said
    assert "v2v-keys new NAME --for consumer" in said
    assert arrivals(sockets, 0.5) == []


def test_a_key_of_the_other_side_opens_nothing(
    sockets: Sockets, consumer: Callable[..., Dealer], tmp_path: Path
) -> None:
    """A consumer's key on the worker port: refused by its domain, although it is a good key on the other."""
    said = refusal(consumer(tmp_path / "gpu1.key", sockets.worker_address))
    assert f"{sockets.worker_address} refuses consumer key 'gpu1'" in said
    assert arrivals(sockets, 0.5) == []
    with pytest.raises(KeyRefused, match=r"'cpu1' .* is a worker's, and this is a consumer.*--for consumer"):
        Dealer(sockets.address, str(tmp_path / "cpu1.key"))


def test_a_key_of_another_server_opens_nothing(
    sockets: Sockets, consumer: Callable[..., Dealer], tmp_path: Path
) -> None:
    other = KeyFolder(tmp_path / "other")
    other.init()
    other.new("gpu1", "consumer", tmp_path / "other.key")
    assert "not the server that consumer key 'gpu1' was made for" in refusal(consumer(tmp_path / "other.key"))
    assert arrivals(sockets, 0.5) == []


def test_a_revoked_key_loses_its_open_connection(
    folder: KeyFolder, sockets: Sockets, gate: Gate, consumer: Callable[..., Dealer], tmp_path: Path
) -> None:
    folder.new("gpu2", "consumer", tmp_path / "gpu2.key")  # while the server runs
    link, other = consumer(tmp_path / "gpu1.key"), consumer(tmp_path / "gpu2.key")
    assert len({next_from(sockets, FromConsumer).identity for _ in range(2)}) == 2  # type: ignore[union-attr]
    folder.revoke("gpu1")
    until(lambda: list(gate._allowed["consumer"].values()) == ["gpu2"])  # the server looks twice a second
    link.send(encode(Ping()))
    other.send(encode(Ping()))
    assert len(arrivals(sockets, 1.5)) == 1  # the other's
    said = refusal(link)
    assert "refuses consumer key 'gpu1': the key was revoked" in said
    assert not other.has_reconnected()


def test_a_worker_of_this_host_needs_no_key(sockets: Sockets) -> None:
    with zmq.Context() as context, context.socket(zmq.DEALER) as peer:
        peer.setsockopt(zmq.LINGER, 0)
        peer.connect(sockets.local_address)
        peer.send_multipart(encode(Ping()))
        assert isinstance(next_from(sockets, FromWorker), FromWorker)


@pytest.mark.parametrize("half", [b"", b"\xff\0\0\0\0\0\0\0\0\x7f\x03\0CURVE" + bytes(15 + 1 + 31)])
def test_half_open_connections_end_and_do_not_starve_other_peers(
    half: bytes, sockets: Sockets, consumer: Callable[..., Dealer], tmp_path: Path
) -> None:
    port = int(sockets.address.rpartition(":")[2])
    peers = [socket.create_connection(("127.0.0.1", port)) for _ in range(200)]
    try:
        for peer in peers:
            peer.sendall(half)
        consumer(tmp_path / "gpu1.key")
        assert isinstance(next_from(sockets, FromConsumer), FromConsumer)
        for peer in peers:
            peer.settimeout(60.0)
            while peer.recv(4096):
                pass
    finally:
        for peer in peers:
            peer.close()


def test_a_file_that_others_may_read_is_refused(folder: KeyFolder, tmp_path: Path) -> None:
    for file in (tmp_path / "gpu1.key", folder.path / "server.key"):
        assert stat.S_IMODE(file.stat().st_mode) == 0o600
        file.chmod(0o640)
    with pytest.raises(KeyRefused, match=r"gpu1.key has mode 0640.*chmod 600"):
        key_for("tcp://x:1", "consumer", tmp_path / "gpu1.key")
    with pytest.raises(KeyRefused, match=r"server.key has mode 0640"):
        Sockets("tcp://127.0.0.1:*", "tcp://127.0.0.1:*", keys=folder)


@pytest.mark.parametrize("which", ["", "consumer", "worker"])
def test_a_folder_that_others_may_write_to_is_refused(folder: KeyFolder, which: str) -> None:
    """They would put a key of theirs there."""
    (folder.path / which).chmod(0o770)
    with pytest.raises(KeyRefused, match=r"others can write to .* \(mode 0770\).* chmod 700"):
        Sockets("tcp://127.0.0.1:*", "tcp://127.0.0.1:*", keys=folder)


@pytest.mark.parametrize("half", [" " * 40, "#" * 40, "a" * 39, None])
def test_what_is_written_as_no_key_is_none(folder: KeyFolder, tmp_path: Path, half: str | None) -> None:
    for file, name in ((tmp_path / "gpu1.key", "secret"), (folder.path / "server.key", "secret")):
        file.write_text(json.dumps(json.loads(file.read_text()) | {name: half}))
    with pytest.raises(KeyRefused, match=r"gpu1.key is not a key file"):
        read_key(tmp_path / "gpu1.key")
    with pytest.raises(KeyRefused, match=r"server.key is not a key file"):
        folder.server_keys()


def test_every_key_of_zeromq_is_one() -> None:
    for _ in range(100):
        assert all(is_key(half.decode()) for half in zmq.curve_keypair())


@pytest.mark.parametrize(("side", "name"), [("consumer", "gpu1"), ("worker", "cpu1")])
def test_who_says_nothing_until_its_key_is_revoked_is_not_heard(
    folder: KeyFolder, sockets: Sockets, gate: Gate, tmp_path: Path, side: str, name: str
) -> None:
    key = read_key(tmp_path / f"{name}.key")
    with zmq.Context() as context, context.socket(zmq.DEALER) as peer:
        peer.setsockopt(zmq.RECONNECT_IVL, -1)
        peer.setsockopt(zmq.LINGER, 0)
        secure(peer, key)
        monitor = peer.get_monitor_socket(zmq.EVENT_HANDSHAKE_SUCCEEDED | zmq.EVENT_DISCONNECTED)
        peer.connect(sockets.address if side == "consumer" else sockets.worker_address)
        assert monitor.poll(60_000)
        monitor.recv_multipart()
        folder.revoke(name)
        until(lambda: not gate.admits(side, key.public))
        peer.send_multipart(encode(Ping()))
        heard: list[ServerInput] = []

        def is_cut_off() -> bool:
            heard.extend(one for one in sockets.receive(0.05) if isinstance(one, FromConsumer | FromWorker))
            return bool(monitor.poll(0))

        until(is_cut_off)
        assert heard == []
        peer.disable_monitor()
        monitor.close()


def test_without_an_authentication_thread_no_peer_connects(sockets: Sockets, gate: Gate, tmp_path: Path) -> None:
    """ZAP_ENFORCE_DOMAIN is set; without it every peer would connect."""
    gate.close()
    with zmq.Context() as context, context.socket(zmq.DEALER) as peer:
        peer.setsockopt(zmq.LINGER, 0)
        secure(peer, read_key(tmp_path / "gpu1.key"))
        monitor = peer.get_monitor_socket(zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL | zmq.EVENT_HANDSHAKE_FAILED_AUTH)
        peer.connect(sockets.address)
        peer.send_multipart(encode(Ping()))
        assert monitor.poll(60_000)
        assert [one for one in arrivals(sockets, 0.3) if isinstance(one, FromConsumer)] == []
        peer.disable_monitor()
        monitor.close()


def test_the_environment_names_a_key(folder: KeyFolder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("V2V_KEYS", str(tmp_path / "gpu1.key"))
    key = key_for("tcp://x:1", "consumer", None)
    assert key is not None
    assert key.name == "gpu1"
    assert key.secret not in f"{key!r} {key}"
    assert key_for("tcp://x:1", "consumer", "") is None
    assert key_for("ipc://x", "consumer", None) is None
    monkeypatch.setenv("V2V_KEYS", str(tmp_path / "none.key"))
    with pytest.raises(KeyRefused, match=r"none.key cannot be read: No such file"):
        key_for("tcp://x:1", "consumer", None)


@pytest.mark.parametrize("content", ["", "[]", "{}", '{"side": "consumer"}', "\xff"])
def test_what_is_no_key_file(content: str, tmp_path: Path) -> None:
    file = tmp_path / "a.key"
    file.write_text(content)
    file.chmod(0o600)
    with pytest.raises(KeyRefused, match=r"a.key is not a key file"):
        read_key(file)


def test_no_secret_is_in_an_error(folder: KeyFolder, sockets: Sockets, tmp_path: Path) -> None:
    secret = read_key(tmp_path / "gpu1.key").secret
    with closing(Dealer(sockets.worker_address, str(tmp_path / "gpu1.key"))) as link:
        link.connect(1 << 16)
        assert secret not in refusal(link)
    file = tmp_path / "gpu1.key"
    file.write_text(file.read_text().replace('"side"', '"sides"'))
    with pytest.raises(V2VError) as raised:
        read_key(file)
    assert secret not in str(raised.value)
    assert raised.value.__cause__ is None


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    for arguments, status in (
        ("init", 0),
        ("init", 2),  # the keys that were given out would end
        ("new gpu1 --for consumer", 0),
        ("new gpu1 --for consumer", 2),
        ("new ../gpu1 --for consumer", 2),
        ("new gpu2", 2),
    ):
        assert main(arguments.split()) == status, arguments
    key = read_key(tmp_path / "gpu1.key")
    capsys.readouterr()
    assert main(["list"]) == 0
    shown = capsys.readouterr().out
    assert shown.split() == ["consumer", "gpu1", key.public]
    assert main(["revoke", "gpu1"]) == 0
    assert main(["revoke", "gpu1"]) == 2
    captured = capsys.readouterr()
    assert key.secret not in shown + captured.out + captured.err


@pytest.mark.parametrize("is_late", [False, True])
def test_a_server_without_keys_is_not_talked_to_with_one(tmp_path: Path, folder: KeyFolder, is_late: bool) -> None:
    with (
        closing(Sockets("tcp://127.0.0.1:*", "tcp://127.0.0.1:*")) as plain,
        closing(Dealer(plain.address, str(tmp_path / "gpu1.key"))) as link,
    ):
        link.connect(1 << 16)
        if is_late:  # a busy host: the handshake has failed when it is this one's turn
            socket = link._socket
            assert socket is not None
            until(lambda: not socket.poll(0, zmq.POLLOUT))
        link.send(encode(Ping()))
        assert "asks for no key" in refusal(link)
        assert arrivals(plain, 0.3) == []


SILENT = struct.pack("=Hi", 0x0800, 32)


@pytest.mark.parametrize("has_key", [True, False])
def test_a_server_whose_words_were_lost_is_asked_again(tmp_path: Path, sockets: Sockets, has_key: bool) -> None:
    """It ends the connection as soon as it knows that the two disagree; on a busy host nothing else was ever heard."""
    with closing(Sockets("tcp://127.0.0.1:*", "tcp://127.0.0.1:*")) as plain:
        assert mechanism_of(sockets.address) == b"CURVE"
        assert mechanism_of(plain.address) == b"NULL"
        address, other = (plain.address, sockets.address) if has_key else (sockets.address, plain.address)
        key = read_key(tmp_path / "gpu1.key") if has_key else None
        events = [SILENT]
        with pytest.raises(KeyRefused, match="asks for no key" if has_key else "asks for a key, and no key was given"):
            Handshakes(address, key, "consumer").take(lambda: len(events), lambda: [events.pop()])
        events = [SILENT]
        Handshakes(other, key, "consumer").take(lambda: len(events), lambda: [events.pop()])
    assert mechanism_of(plain.address) == b""


def test_a_folder_without_keys_is_named(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"no keys in .*: create them with v2v-keys init --dir"):
        Sockets("tcp://127.0.0.1:*", "tcp://127.0.0.1:*", keys=KeyFolder(tmp_path))


def test_a_lent_key_is_a_workers_and_on_no_disk(folder: KeyFolder, tmp_path: Path) -> None:
    key = folder.lend("ray-1", "worker")
    allowed = folder.allowed()
    assert allowed["worker"][key.public] == "ray-1"
    assert key.public not in allowed["consumer"]
    assert key.public not in KeyFolder(folder.path).allowed()["worker"]
    for path in tmp_path.rglob("*"):
        if path.is_file():
            assert key.secret.encode() not in path.read_bytes()

"""The worker's process does what its conversation says. What it makes is nothing."""

from __future__ import annotations

import os
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import zmq

from tests.oracles.dealers import wait
from tests.protocol.persisted_values import example
from v2v_protocol.errors import SidecarError, UsageError, VideoError
from v2v_protocol.messages import (
    Begun,
    Goodbye,
    Lease,
    LeaseFailed,
    Message,
    Ping,
    Pong,
    Result,
    Stop,
    WorkerHello,
    decode,
    encode,
)
from v2v_protocol.sample import Layout, new_arrays
from v2v_server.commands.worker import main as worker_command
from v2v_server.corpus.sources.folder import Folder
from v2v_server.simulation.precision import Variant
from v2v_server.worker import process as worker_module
from v2v_server.worker.conversation import Reconnect, Send
from v2v_server.worker.process import Clips, OutputBuffer, Worker, run_worker

WAIT_MS = 60_000
LEASE: Lease = replace(example(Lease), indices=(3,), arena="", slot=0)
LAYOUT: Layout = {"voxels": ("int8", (2, 2))}
VARIANT = Variant("int16", True, "float32")


class Server:
    """The socket that a worker in a thread talks to, and what that worker's process did, in order."""

    def __init__(self, router: zmq.Socket[bytes]) -> None:
        self._router = router
        self.worker = b""
        self.did: list[str] = []

    def heard(self) -> Message:
        """The next message of the worker."""
        assert self._router.poll(WAIT_MS), "the worker says nothing"
        self.worker, header, *_ = self._router.recv_multipart()
        return decode(header)

    def says(self, *messages: Message) -> None:
        for message in messages:
            self._router.send_multipart([self.worker, *encode(message)])


@pytest.fixture
def server(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Server]:
    """Samples in slots. Lease 2 needs no decoding, lease 3 fails, lease 4 needs a kernel that is not loaded."""

    def make(lease: Lease, *_: object) -> Any:
        at.did.append(f"make {lease.lease}")
        if lease.lease == 3:
            raise VideoError("a.mp4", 7, "cut short")
        return SimpleNamespace(provenance=SimpleNamespace(to_dict=dict))

    with zmq.Context() as context, context.socket(zmq.ROUTER) as router, (tmp_path / "logbook").open("wb") as logbook:
        router.setsockopt(zmq.LINGER, 0)
        at = Server(router)
        port = router.bind_to_random_port("tcp://127.0.0.1")
        worker = Worker("w", Folder(tmp_path), f"tcp://127.0.0.1:{port}", logbook.fileno())
        monkeypatch.setattr(worker_module, "make_sample", make)
        monkeypatch.setattr(worker_module, "sample_layout", lambda lease: LAYOUT)
        monkeypatch.setattr(
            worker_module,
            "open_output_buffer",
            lambda lease, layout, arenas: OutputBuffer(new_arrays(layout), in_slot=True),
        )
        monkeypatch.setattr(worker_module, "kernels_of", lambda lease: frozenset({VARIANT} if lease.lease > 3 else ()))
        monkeypatch.setattr(worker_module, "is_compiled", lambda variant: True)
        monkeypatch.setattr(worker_module, "load_in_turn", lambda variant: at.did.append("load"))
        monkeypatch.setattr(worker_module, "give_way", lambda: at.did.append("give way"))
        monkeypatch.setattr(
            worker_module, "note", lambda _, lease, decodes=False: decodes or at.did.append(f"note {lease}")
        )
        monkeypatch.setattr(Clips, "take", lambda self, lease: (None, False))
        monkeypatch.setattr(Clips, "has", lambda self, lease: lease.lease == 2)
        thread = threading.Thread(target=worker.run)
        thread.start()
        try:
            assert isinstance(at.heard(), WorkerHello)
            yield at
        finally:
            at.says(Stop())
            thread.join(WAIT_MS / 1000)
            assert not thread.is_alive()


def test_it_makes_what_it_is_given_and_notes_what_it_is_at(server: Server) -> None:
    """Siblings are made in one turn on the core."""
    server.says(*(replace(LEASE, lease=number) for number in range(1, 5)))
    said = [server.heard()]
    while not isinstance(said[-1], Result) or said[-1].lease != 4:
        said.append(server.heard())
    assert said[0] == Begun(1)
    assert LeaseFailed(3, 7, "cut short") in said
    assert sorted(one.lease for one in said if isinstance(one, Result)) == [1, 2, 4]
    assert server.did == [
        *("give way", "note 1", "make 1", "note 0"),
        *("note 2", "make 2", "note 0"),
        *("give way", "note 3", "make 3", "note 0"),
        "load",
        *("give way", "note 4", "make 4", "note 0"),
    ]
    server.says(Stop())
    assert server.heard() == Goodbye()


def test_sidecars_are_read_before_their_lease_begins(server: Server, monkeypatch: pytest.MonkeyPatch) -> None:
    """The time and memory that labels take count against no sample: nothing has begun, and the logbook says so."""

    @contextmanager
    def opened(lease: Lease, source: object) -> Iterator[dict[str, None]]:
        server.did.append(f"open {lease.lease}")
        if lease.lease == 5:
            raise SidecarError("a.mp4", ".boxes/", "is gone", here=True)
        yield {}

    monkeypatch.setattr(worker_module, "open_sidecars", opened)
    monkeypatch.setattr(worker_module, "kernels_of", lambda lease: frozenset())
    labelled = replace(LEASE, video="a.mp4", arrays=("boxes",))
    starts = {1: 0, 2: 0, 4: 9, 5: 18}
    server.says(
        *(
            replace(labelled, lease=number, start_frame=start, sidecars={".boxes/": ["3-x", b"the same files"]})
            for number, start in starts.items()
        )
    )
    said = [server.heard()]
    while not isinstance(said[-1], LeaseFailed):
        said.append(server.heard())
    assert said[-1] == LeaseFailed(5, None, "is gone", True, ".boxes/")
    assert [step for step in server.did if "way" not in step] == [
        *("open 1", "note 1", "make 1", "note 0"),
        *("note 2", "make 2", "note 0"),
        *("open 4", "note 4", "make 4", "note 0"),
        *("open 5", "note 5", "note 0"),
    ]


def test_a_new_connection_has_a_new_routing_id(tmp_path: Path) -> None:
    with zmq.Context() as context, context.socket(zmq.ROUTER) as router:
        router.setsockopt(zmq.LINGER, 0)
        at = Server(router)
        worker = Worker("w", Folder(tmp_path), f"tcp://127.0.0.1:{router.bind_to_random_port('tcp://127.0.0.1')}")
        found = []
        try:
            for _ in range(2):
                worker._do(Send(encode(Ping())))
                assert at.heard() == Ping()
                at.says(Pong())
                assert wait([worker._link], WAIT_MS / 1000)
                assert [decode(frame) for frame in worker._messages(0.0)] == [Pong()]
                found.append(at.worker)
                worker._do(Reconnect())
        finally:
            worker._link.close()
    assert len(set(found)) == 2
    assert all(len(identity) == 16 and identity != b"w" for identity in found)


def test_a_worker_whose_server_is_away_keeps_to_the_ip_version(tmp_path: Path, unused_port: int) -> None:
    """With the other one it would not find the server again until its next new connection, minutes later."""
    worker = Worker("w", Folder(tmp_path), f"tcp://localhost:{unused_port}")
    try:
        for _ in range(3):
            worker._do(Reconnect())
            assert worker._link._socket is not None
            assert worker._link._socket.getsockopt(zmq.IPV6) == 0
    finally:
        worker._link.close()


def test_a_malformed_address_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"--connect: address 'nowhere': .*; give tcp://host:port"):
        Worker("w", Folder(tmp_path), "nowhere")


def test_a_corpus_that_cannot_be_looked_at_is_said(capsys: pytest.CaptureFixture[str]) -> None:
    assert worker_command(["--connect", "tcp://127.0.0.1:1", "--videos", "x" * 300]) == 2
    assert "cannot be read: File name too long" in capsys.readouterr().err


def test_workers_in_containers_of_one_name_do_not_share_theirs(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Each is process 1 there, as here. Of two of one name the server hears one, and the other waits for ever."""
    names: list[str] = []

    class Named(Worker):
        def __init__(self, name: str, *more: object) -> None:
            names.append(name)

        def run(self) -> None:
            pass

    monkeypatch.setattr(worker_module, "Worker", Named)
    for asks_the_system in ("keep_freed_memory", "limit_memory", "confine", "warm_up_in_turn", "take_long_turns"):
        monkeypatch.setattr(worker_module, asks_the_system, lambda *_, **__: None)
    monkeypatch.setattr(worker_module, "gc", SimpleNamespace(collect=lambda: 0, freeze=lambda: None))
    monkeypatch.setattr(worker_module, "signal", SimpleNamespace(SIGTERM=15, signal=lambda number, handler: None))
    monkeypatch.setenv("OPENCV_FOR_THREADS_NUM", "1")
    for name in (None, None, "mine"):
        run_worker("tcp://127.0.0.1:5556", Folder(tmp_path), name, None)
    assert len(set(names)) == 3
    assert names[0].startswith(f"{socket.gethostname()}-{os.getpid()}-")
    assert names[2] == "mine"


def test_workers_that_are_given_one_name_do_not_share_it(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """A batch system starts all of them with the same command."""
    names: list[str] = []
    monkeypatch.setattr("v2v_server.commands.worker.run_worker", lambda address, root, name, *more: names.append(name))
    command = ["--connect", "tcp://127.0.0.1:5556", "--videos", str(tmp_path), "--name", "node7"]
    for more in ([], [], ["--logbook-fd", "3"]):
        worker_command([*command, *more])
    assert len(set(names)) == 3
    assert [name[:6] for name in names] == ["node7-", "node7-", "node7"]


def test_a_name_that_no_connection_can_have_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert worker_command(["--connect", "tcp://127.0.0.1:5556", "--videos", "videos", "--name", "n" * 300]) == 2
    assert "--name has 300 bytes: give at most 200" in capsys.readouterr().err

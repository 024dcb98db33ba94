"""What a worker says, to a server that is played here. What it makes is nothing."""

from __future__ import annotations

import os
import queue
import socket
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgpack
import pytest
import zmq

from tests.protocol.wire_messages import example
from v2v_protocol import PROTOCOL_VERSION
from v2v_protocol.errors import CorpusError, VersionMismatch, VideoChanged, VideoError, VideoUnreadable
from v2v_protocol.messages import (
    Begun,
    Denied,
    ErrorCode,
    Goodbye,
    Lease,
    LeaseFailed,
    Message,
    Ping,
    Result,
    Stop,
    WorkerHello,
)
from v2v_protocol.sample import Layout, new_arrays
from v2v_protocol.wire import decode, encode
from v2v_server.commands.worker import main as worker_command
from v2v_server.simulation.variants import Variant
from v2v_server.worker import conversation as worker_module
from v2v_server.worker.conversation import Worker, run_worker
from v2v_server.worker.decode_cache import Clips
from v2v_server.worker.handover import Room

WAIT_MS = 20_000
LEASE: Lease = replace(example(Lease), indices=(3,), arena="", slot=0)
LAYOUT: Layout = {"voxels": ("int8", (2, 2))}


class Server:
    """A worker in a thread, which waits in the middle of each sample, and the socket that it talks to.

    Attributes:
        worker: it.
        in_slots: whether its samples lie in slots.
        decoded: leases that need no decoding, since their siblings were decoded before.
        now: what its clock says.
    """

    def __init__(self, router: zmq.Socket[bytes], worker: Worker) -> None:
        self.worker = worker
        self.in_slots = False
        self.decoded: set[int] = set()
        self.now = 1000.0
        self._router = router
        self._started: queue.Queue[int] = queue.Queue()
        self._turns: queue.Queue[tuple[bool, int, float, VideoError | None]] = queue.Queue()

    def heard(self) -> Message:
        """The next message of the worker."""
        assert self._router.poll(WAIT_MS), "the worker says nothing"
        _, header, *_ = self._router.recv_multipart()
        return decode(header)

    def says(self, message: Message) -> None:
        self._router.send_multipart([b"w", *encode(message)])

    def lease(self, number: int) -> None:
        self.says(replace(LEASE, lease=number))

    def lets_it_finish(
        self, *, after_post: bool = False, held: int = 0, seconds: float = 0.0, error: VideoError | None = None
    ) -> None:
        """The sample that the worker makes is done, or its video fails.

        Args:
            after_post: not before there is post for it.
            held: not before it holds so many other leases.
            seconds: that it takes.
            error: why the video fails.
        """
        self._turns.put((after_post, held, seconds, error))

    def waits_for_its_start(self, number: int) -> None:
        """Returns when the worker is at that lease."""
        while self._started.get(timeout=WAIT_MS / 1000) != number:
            pass

    def make(self, lease: Lease, *_: object) -> Any:
        """In place of ``make_sample``, in the worker's thread."""
        self._started.put(lease.lease)
        after_post, held, seconds, error = self._turns.get(timeout=WAIT_MS / 1000)
        assert not after_post or self.worker._socket.poll(WAIT_MS)
        while len(self.worker._leases) < held:
            self.worker._receive(WAIT_MS / 1000)
        self.now += seconds
        if error is not None:
            raise error
        return SimpleNamespace(provenance=SimpleNamespace(to_dict=dict))


@pytest.fixture
def has_logbook() -> bool:
    return True


@pytest.fixture
def server(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, has_logbook: bool) -> Iterator[Server]:
    with (
        zmq.Context() as context,
        context.socket(zmq.ROUTER) as router,
        (tmp_path / "logbook").open("wb") as logbook,
    ):
        router.setsockopt(zmq.LINGER, 0)
        port = router.bind_to_random_port("tcp://127.0.0.1")
        worker = Worker("w", tmp_path, f"tcp://127.0.0.1:{port}", logbook.fileno() if has_logbook else None)
        server = Server(router, worker)
        monkeypatch.setattr(worker_module, "make_sample", server.make)
        monkeypatch.setattr(worker_module, "sample_layout", lambda lease: LAYOUT)
        monkeypatch.setattr(worker_module, "room_for", lambda lease, layout: Room(new_arrays(layout), server.in_slots))
        monkeypatch.setattr(
            worker_module, "time", SimpleNamespace(monotonic=lambda: server.now, process_time=time.process_time)
        )
        monkeypatch.setattr(Clips, "take", lambda self, lease: (None, False))
        monkeypatch.setattr(Clips, "has", lambda self, lease: lease.lease in server.decoded)
        thread = threading.Thread(target=worker.run)
        thread.start()
        try:
            assert isinstance(server.heard(), WorkerHello)
            yield server
        finally:
            worker.stop()
            for _ in range(3):
                server.lets_it_finish()
            server.says(Stop())
            thread.join(WAIT_MS / 1000)
            assert not thread.is_alive()


def test_the_lease_begun_next_is_named_with_what_is_done(server: Server) -> None:
    server.lease(1)
    assert server.heard() == Begun(1)
    for number in (1, 2):
        server.lease(number + 1)
        server.lets_it_finish(after_post=True)
        assert server.heard() == Result(number, begins=number + 1)
    server.lets_it_finish()
    assert server.heard() == Result(3, begins=0)
    server.lease(4)
    assert server.heard() == Begun(4)
    server.lets_it_finish()
    assert server.heard() == Result(4, begins=0)


def test_after_a_failure_the_next_lease_is_begun_by_itself(server: Server) -> None:
    server.lease(1)
    assert server.heard() == Begun(1)
    server.lease(2)
    server.lets_it_finish(after_post=True, error=VideoError("a.mp4", 7, "cut short"))
    assert server.heard() == LeaseFailed(1, 7, "cut short")
    assert server.heard() == Begun(2)
    server.lets_it_finish()
    assert server.heard() == Result(2, begins=0)


@pytest.mark.parametrize("kind", [VideoChanged, VideoUnreadable])
def test_what_its_host_lacks_is_not_called_the_videos_fault(server: Server, kind: type[VideoError]) -> None:
    server.lease(1)
    assert server.heard() == Begun(1)
    server.lets_it_finish(error=kind("a.mp4", None, "cannot be read"))
    assert server.heard() == LeaseFailed(1, None, "cannot be read", here=True)


def test_a_corpus_that_cannot_be_looked_at_is_said() -> None:
    with pytest.raises(CorpusError, match=r"--videos x+: cannot be looked at: File name too long"):
        run_worker("tcp://127.0.0.1:1", Path("x" * 300), None, None)


def test_a_worker_told_to_stop_begins_nothing_more(server: Server) -> None:
    server.lease(1)
    assert server.heard() == Begun(1)
    server.says(Stop())
    server.lets_it_finish(after_post=True)
    assert server.heard() == Result(1, begins=0)
    assert server.heard() == Goodbye()


def test_a_worker_stopped_by_a_signal_begins_nothing_of_what_it_holds(server: Server) -> None:
    server.lease(1)
    assert server.heard() == Begun(1)
    server.lease(2)
    server.waits_for_its_start(1)
    server.worker.stop()
    server.lets_it_finish(after_post=True)
    assert server.heard() == Result(1, begins=0)
    assert server.heard() == Goodbye()


def test_a_sample_for_a_server_that_was_restarted_is_dropped(server: Server) -> None:
    """Its lease is unknown there, or is somebody else's."""
    server.lease(1)
    assert server.heard() == Begun(1)
    server.says(Denied(ErrorCode.UNKNOWN_SESSION, "who are you?"))
    server.lets_it_finish(after_post=True)
    assert isinstance(server.heard(), WorkerHello)
    server.lease(1)
    assert server.heard() == Begun(1)
    server.lets_it_finish()
    assert server.heard() == Result(1, begins=0)


def test_a_server_that_knows_us_no_more_is_greeted_once_whatever_it_refuses(server: Server) -> None:
    """It refuses all that it was sent while it was away, and a second hello takes back what the first one brought."""
    server.lease(1)
    assert server.heard() == Begun(1)
    for _ in range(9):
        server.says(Denied(ErrorCode.UNKNOWN_SESSION, "who are you?"))
    server.lets_it_finish(after_post=True)
    assert isinstance(server.heard(), WorkerHello)
    server.lease(1)
    assert server.heard() == Begun(1)
    server.says(Denied(ErrorCode.UNKNOWN_SESSION, "who are you now?"))
    server.lets_it_finish(after_post=True)
    assert isinstance(server.heard(), WorkerHello)


def test_a_server_that_is_away_does_not_find_a_ping_for_every_five_seconds(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with zmq.Context() as context, context.socket(zmq.ROUTER) as router:
        router.setsockopt(zmq.LINGER, 0)
        address = f"tcp://127.0.0.1:{router.bind_to_random_port('tcp://127.0.0.1')}"
        worker = Worker("w", tmp_path, address)
        for _ in range(200):
            worker._receive(0.001)
        worker._send(encode(Goodbye()))
        said = []
        while Goodbye() not in said:
            assert router.poll(WAIT_MS)
            said.append(decode(router.recv_multipart()[1]))
        worker._context.destroy(linger=0)
    assert said == [Ping()] * 9 + [Goodbye()]  # after 1, 2, 4, 8, 16, 32, 64, 128 and 192
    assert capsys.readouterr().err == f"w: {address} has not answered for 20 s; waiting\n"


def test_a_server_of_another_version_ends_the_worker(tmp_path: Path) -> None:
    """It says so in its own version, which is no message to ours; to ask it again every five seconds is no use."""
    with zmq.Context() as context, context.socket(zmq.ROUTER) as router:
        router.setsockopt(zmq.LINGER, 0)
        worker = Worker("w", tmp_path, f"tcp://127.0.0.1:{router.bind_to_random_port('tcp://127.0.0.1')}")
        worker._say_hello()
        name, _ = router.recv_multipart()
        refusal = msgpack.packb({"v": PROTOCOL_VERSION + 1, "t": "denied", "code": "version", "text": "", "more": 0})
        router.send_multipart([name, refusal])
        with pytest.raises(VersionMismatch, match=f"version {PROTOCOL_VERSION + 1}"):
            worker.run()


def test_workers_in_containers_of_one_name_do_not_share_theirs(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Each is process 1 there, as here. Of two of one name the server hears one, and the other waits for ever."""
    names: list[str] = []

    class Named(Worker):
        def __init__(self, name: str, root: Path, address: str, logbook: int | None) -> None:
            names.append(name)

        def run(self) -> None:
            pass

    monkeypatch.setattr(worker_module, "Worker", Named)
    for asks_the_system in ("keep_freed_memory", "warm_up_in_turn", "take_long_turns"):
        monkeypatch.setattr(worker_module, asks_the_system, lambda: None)
    monkeypatch.setattr(worker_module, "gc", SimpleNamespace(collect=lambda: 0, freeze=lambda: None))
    monkeypatch.setattr(worker_module, "signal", SimpleNamespace(SIGTERM=15, signal=lambda number, handler: None))
    monkeypatch.setenv("OPENCV_FOR_THREADS_NUM", "1")
    for name in (None, None, "mine"):
        run_worker("tcp://127.0.0.1:5556", tmp_path, name, None)
    assert len(set(names)) == 3
    assert names[0].startswith(f"{socket.gethostname()}-{os.getpid()}-")
    assert names[2] == "mine"


def test_workers_that_are_given_one_name_do_not_share_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """A batch system starts all of them with the same command."""
    names: list[str] = []
    monkeypatch.setattr("v2v_server.commands.worker.run_worker", lambda address, root, name, *more: names.append(name))
    command = ["--connect", "tcp://127.0.0.1:5556", "--videos", "videos", "--name", "node7"]
    for more in ([], [], ["--logbook-fd", "3"]):
        worker_command([*command, *more])
    assert len(set(names)) == 3
    assert [name[:6] for name in names] == ["node7-", "node7-", "node7"]


def test_a_name_that_no_connection_can_have_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert worker_command(["--connect", "tcp://127.0.0.1:5556", "--videos", "videos", "--name", "n" * 300]) == 2
    assert "--name has 300 bytes: give at most 200" in capsys.readouterr().err


class TestKernels:
    """From lease 2 on a kernel is needed that the worker has not."""

    VARIANT = Variant("int16", True, "float32")

    @pytest.fixture(params=[False, True])
    def is_there(self, request: pytest.FixtureRequest) -> bool:
        """Whether another process has compiled it."""
        return bool(request.param)

    @pytest.fixture(autouse=True)
    def loaded(self, monkeypatch: pytest.MonkeyPatch, is_there: bool) -> list[Variant]:
        needed = {number: frozenset({self.VARIANT} if number > 1 else ()) for number in range(5)}
        loaded: list[Variant] = []
        monkeypatch.setattr(worker_module, "kernels_of", lambda lease: needed[lease.lease])
        monkeypatch.setattr(worker_module, "is_compiled", lambda variant: is_there)
        monkeypatch.setattr(worker_module, "load_in_turn", loaded.append)
        return loaded

    def test_are_there_before_a_sample_is_begun(self, loaded: list[Variant], server: Server, is_there: bool) -> None:
        """What is begun is timed, and blamed if it takes too long; and compiling takes long."""
        server.lease(1)
        assert server.heard() == Begun(1)
        server.lease(2)
        server.lets_it_finish(after_post=True)
        assert server.heard() == Result(1, begins=0)
        if not is_there:
            assert server.heard() == Goodbye()
            assert isinstance(server.heard(), WorkerHello)
            server.lease(3)
        assert server.heard() == Begun(2 if is_there else 3)
        assert loaded == [self.VARIANT]
        server.lease(4)
        server.lets_it_finish(after_post=True)
        assert server.heard() == Result(2 if is_there else 3, begins=4)
        assert loaded == [self.VARIANT]


class TestSiblings:
    """The worker decodes for lease 1 and holds 2 and 3, whose samples are made of the same clip."""

    @pytest.fixture
    def in_slots(self) -> bool:
        return True

    @pytest.fixture(autouse=True)
    def leases(self, server: Server, in_slots: bool) -> None:
        server.in_slots = in_slots
        server.decoded = {2, 3}
        for number in (1, 2, 3):
            server.lease(number)
        assert server.heard() == Begun(1)

    def test_are_announced_together(self, server: Server) -> None:
        server.lets_it_finish(held=2)
        server.lets_it_finish()
        server.lets_it_finish()
        assert [server.heard() for _ in range(3)] == [Result(1, begins=2), Result(2, begins=3), Result(3, begins=0)]

    def test_wait_for_each_other(self, server: Server) -> None:
        """Seen where they are not announced at all, for a server that has forgotten them."""
        server.lets_it_finish(held=2)
        server.lets_it_finish()
        server.waits_for_its_start(3)
        server.says(Denied(ErrorCode.UNKNOWN_SESSION, "who are you?"))
        server.lets_it_finish(after_post=True)
        assert isinstance(server.heard(), WorkerHello)
        server.lease(1)
        assert server.heard() == Begun(1)

    def test_do_not_wait_for_another_clip(self, server: Server) -> None:
        server.decoded = {2}
        server.lets_it_finish(held=2)
        server.lets_it_finish()
        assert [server.heard() for _ in range(2)] == [Result(1, begins=2), Result(2, begins=3)]

    def test_do_not_wait_long(self, server: Server) -> None:
        server.lets_it_finish(held=2, seconds=0.06)
        server.lets_it_finish(seconds=0.06)
        assert [server.heard() for _ in range(2)] == [Result(1, begins=2), Result(2, begins=3)]

    def test_do_not_wait_for_another_where_the_first_took_long(self, server: Server) -> None:
        """The server would see two of them take the time that it allows for one."""
        server.lets_it_finish(held=2, seconds=1.0)
        assert server.heard() == Result(1, begins=2)

    @pytest.mark.parametrize("in_slots", [False])
    def test_do_not_wait_with_arrays_that_travel(self, server: Server) -> None:
        server.lets_it_finish(held=2)
        assert server.heard() == Result(1, begins=2)

    @pytest.mark.parametrize("has_logbook", [False])
    def test_do_not_wait_where_the_server_cannot_see_which_one_is_in_work(self, server: Server) -> None:
        server.lets_it_finish(held=2)
        assert server.heard() == Result(1, begins=2)

    def test_are_made_in_one_turn_on_the_core(self, server: Server, monkeypatch: pytest.MonkeyPatch) -> None:
        done: list[str] = []
        monkeypatch.setattr(worker_module, "give_way", lambda: done.append("turn"))
        monkeypatch.setattr(worker_module, "note", lambda _, lease: done.append(str(lease)) if lease else None)
        server.lease(4)
        server.lets_it_finish(held=3)
        server.lets_it_finish()
        server.lets_it_finish()
        server.waits_for_its_start(4)
        assert done[-4:] == ["2", "3", "turn", "4"]

    def test_that_are_done_are_announced_when_the_next_fails(self, server: Server) -> None:
        server.lets_it_finish(held=2)
        server.lets_it_finish(error=VideoError("a.mp4", 7, "cut short"))
        assert server.heard() == LeaseFailed(2, 7, "cut short")
        assert server.heard() == Result(1, begins=3)

    def test_that_are_done_are_announced_by_a_worker_that_leaves(
        self, server: Server, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """Told to after it chose to wait."""

        def has(_: Clips, lease: Lease) -> bool:
            if lease.lease == 3:
                server.worker.stop()
            return True

        monkeypatch.setattr(Clips, "has", has)
        server.lets_it_finish(held=2)
        server.lets_it_finish()
        assert [server.heard() for _ in range(3)] == [Result(1, begins=2), Result(2, begins=0), Goodbye()]

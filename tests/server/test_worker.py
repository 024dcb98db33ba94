"""What a worker says, to a server that is played here. What it makes is nothing."""

from __future__ import annotations

import queue
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import zmq

from tests.protocol.wire_messages import example
from v2v_protocol.errors import VideoError
from v2v_protocol.messages import (
    Begun,
    ErrorCode,
    Goodbye,
    JobFailed,
    Lease,
    Message,
    Refused,
    Result,
    Stop,
    WorkerHello,
)
from v2v_protocol.wire import decode, encode
from v2v_server import worker as worker_module
from v2v_server.clips import Clips
from v2v_server.worker import Worker

WAIT_MS = 20_000
LEASE: Lease = replace(example(Lease), indices=(3,), arena="", slot=0)


class Server:
    """A worker in a thread, which waits in the middle of each sample, and the socket that it talks to."""

    def __init__(self, router: zmq.Socket[bytes], worker: Worker) -> None:
        self._router = router
        self._worker = worker
        self._turns: queue.Queue[tuple[bool, VideoError | None]] = queue.Queue()

    def heard(self) -> Message:
        """The next message of the worker."""
        assert self._router.poll(WAIT_MS), "the worker says nothing"
        _, header, *_ = self._router.recv_multipart()
        return decode(header)

    def says(self, message: Message) -> None:
        self._router.send_multipart([b"w", *encode(message)])

    def lease(self, number: int) -> None:
        self.says(replace(LEASE, lease=number))

    def lets_it_finish(self, *, after_post: bool = False, error: VideoError | None = None) -> None:
        """The sample that the worker makes, once there is post for it if there is to be any; or its video fails."""
        self._turns.put((after_post, error))

    def make(self, *_: object) -> Any:
        """In place of ``make_sample``, in the worker's thread."""
        after_post, error = self._turns.get(timeout=WAIT_MS / 1000)
        assert not after_post or self._worker._socket.poll(WAIT_MS)
        if error is not None:
            raise error
        return SimpleNamespace(provenance=SimpleNamespace(to_dict=dict))


@pytest.fixture
def server(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Server]:
    with zmq.Context() as context, context.socket(zmq.ROUTER) as router:
        router.setsockopt(zmq.LINGER, 0)
        port = router.bind_to_random_port("tcp://127.0.0.1")
        worker = Worker("w", tmp_path, f"tcp://127.0.0.1:{port}")
        server = Server(router, worker)
        monkeypatch.setattr(worker_module, "make_sample", server.make)
        monkeypatch.setattr(worker_module, "sample_layout", lambda lease: {"voxels": ("int8", (2, 2))})
        monkeypatch.setattr(Clips, "take", lambda self, lease: (None, False))
        thread = threading.Thread(target=worker.run)
        thread.start()
        try:
            assert isinstance(server.heard(), WorkerHello)
            yield server
        finally:
            worker.stop()
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
    assert server.heard() == JobFailed(1, 7, "cut short")
    assert server.heard() == Begun(2)
    server.lets_it_finish()
    assert server.heard() == Result(2, begins=0)


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
    server._worker.stop()
    server.lets_it_finish(after_post=True)
    assert server.heard() == Result(1, begins=0)
    assert server.heard() == Goodbye()


def test_a_sample_for_a_server_that_was_restarted_is_dropped(server: Server) -> None:
    """Its lease is unknown there, or is somebody else's."""
    server.lease(1)
    assert server.heard() == Begun(1)
    server.says(Refused(ErrorCode.UNKNOWN_SESSION, "who are you?"))
    server.lets_it_finish(after_post=True)
    assert isinstance(server.heard(), WorkerHello)
    server.lease(1)
    assert server.heard() == Begun(1)
    server.lets_it_finish()
    assert server.heard() == Result(1, begins=0)

"""What a worker says, event by event, without socket, process or clock; and its process, which does what that says."""

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

import msgpack
import pytest
import zmq

from tests.oracles.dealers import wait
from tests.protocol.persisted_values import example
from tests.server.named_corpus import SMALL_SPEC
from v2v_protocol import PROTOCOL_VERSION
from v2v_protocol.errors import (
    RemoteError,
    SidecarError,
    UsageError,
    VersionMismatch,
    VideoChanged,
    VideoError,
    VideoUnreadable,
)
from v2v_protocol.messages import (
    Begun,
    Denied,
    ErrorCode,
    Frames,
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
from v2v_protocol.sample import new_arrays
from v2v_server.commands.worker import main as worker_command
from v2v_server.corpus.sources.folder import Folder
from v2v_server.simulation.precision import Variant
from v2v_server.system.process import memory_limit
from v2v_server.worker import process as worker_module
from v2v_server.worker.conversation import (
    Inspect,
    Leave,
    Listen,
    Load,
    Make,
    Readiness,
    Reconnect,
    Say,
    Send,
    WorkerAction,
    WorkerConversation,
)
from v2v_server.worker.job import ClipJob, SampleJob
from v2v_server.worker.making.read import Clips
from v2v_server.worker.process import OutputBuffer, Worker, run_worker

LEASE: Lease = replace(
    example(Lease), indices=(3,), arena="", slot=0, spec=SMALL_SPEC.canonical(), rows="full", arrays=("frames",),
    refusals={"refusals": []}, height_px=16, width_px=24, frames_per_second=25.0, thresholds=(),
)  # fmt: skip
HELLO = WorkerHello("w", 1, 2)
IN_SLOT: Frames = [b"header"]
IN_MESSAGE: Frames = [b"header", b"array"]
UNKNOWN = Denied(ErrorCode.UNKNOWN_SESSION, "who are you?")
FAILURE = VideoError("a.mp4", 7, "cut short")


def lease(number: int) -> Lease:
    return replace(LEASE, lease=number)


class Talk:
    """A conversation, and what it says.

    Attributes:
        now: what its clock says.
        heard: what it said since the last look.
        told: what it told people.
        step: what it wants to do next.
        connections: how many it had.
        unready: leases whose kernels are not loaded.
        compiled: whether they are compiled.
        decoded: leases that need no decoding.
    """

    def __init__(self, *, is_watched: bool = True) -> None:
        self.now = 1000.0
        self._said: list[Message] = []
        self.told: list[str] = []
        self.connections = 1
        self.unready: set[int] = set()
        self.compiled = True
        self.decoded: set[int] = set()
        self.conversation = WorkerConversation(HELLO, ("tcp://there",), is_watched=is_watched)
        self.step: WorkerAction = Leave()
        self._take(self.conversation.start(self.now))
        assert self.said() == [HELLO]

    def _take(self, actions: list[WorkerAction]) -> None:
        *before, self.step = actions
        assert isinstance(self.step, Listen | Inspect | Load | Make | Leave)
        for action in before:
            if isinstance(action, Send):
                self._said.append(decode(action.frames[0]))
            elif isinstance(action, Reconnect):
                self.connections += 1
            else:
                assert isinstance(action, Say)
                self.told.append(action.text)
        if isinstance(self.step, Inspect):
            number = self.step.lease.lease
            readiness = Readiness(number not in self.unready, self.compiled, number in self.decoded)
            self._take(self.conversation.on_inspected(readiness, self.now))

    def said(self) -> list[Message]:
        """What it said since the last call."""
        said, self._said = self._said, []
        return said

    def hears(self, *messages: Message) -> list[Message]:
        assert isinstance(self.step, Listen)
        self._take(self.conversation.on_messages([(0, encode(message)[0]) for message in messages], self.now))
        return self.said()

    def makes(self, number: int, frames: Frames = IN_SLOT, seconds: float = 0.0) -> list[Message]:
        """It makes that lease's sample."""
        assert self.step == Make(lease(number))
        self.now += seconds
        self._take(self.conversation.on_sample(frames, self.now, Result(0)))
        return self.said()

    def fails(self, number: int, error: VideoError = FAILURE) -> list[Message]:
        assert self.step == Make(lease(number))
        self._take(self.conversation.on_failure(error, self.now))
        return self.said()

    def loads(self) -> list[Message]:
        assert isinstance(self.step, Load)
        self.unready.clear()
        self._take(self.conversation.on_kernels_loaded(self.now))
        return self.said()


def at_work(*numbers: int, is_watched: bool = True) -> Talk:
    """A worker that makes the first of these leases."""
    talk = Talk(is_watched=is_watched)
    assert talk.hears(*map(lease, numbers)) == [Begun(numbers[0])]
    return talk


def test_the_lease_begun_next_is_named_with_what_is_done() -> None:
    talk = at_work(1)
    for number in (1, 2):
        assert talk.makes(number) == []
        assert talk.hears(lease(number + 1)) == [Result(number, begins=number + 1)]
    assert talk.makes(3) == []
    assert talk.hears() == [Result(3, begins=0)]
    assert talk.hears(lease(4)) == [Begun(4)]


@pytest.mark.parametrize("kind", [VideoChanged, VideoUnreadable])
def test_what_its_host_lacks_is_not_called_the_videos_fault(kind: type[VideoError]) -> None:
    failed = at_work(1).fails(1, kind("a.mp4", None, "cannot be read"))
    assert failed == [LeaseFailed(1, None, "cannot be read", here=True)]


@pytest.mark.parametrize("by_signal", [False, True])
def test_a_worker_told_to_stop_begins_nothing_of_what_it_holds(by_signal: bool) -> None:
    talk = at_work(1, 2)
    if by_signal:
        talk.conversation.stop()
    talk.makes(1)
    assert talk.hears(*[] if by_signal else [Stop()]) == [Result(1, begins=0), Goodbye()]
    assert talk.step == Leave()


def test_a_server_that_knows_us_no_more_is_greeted_once_whatever_it_denies() -> None:
    """It denies all that it was sent while it was away, and a second hello takes back what the first one brought."""
    talk = at_work(1, 2)
    talk.makes(1)
    assert talk.hears(*[UNKNOWN] * 9) == [HELLO]
    assert talk.hears(UNKNOWN) == []
    assert talk.hears(Pong()) == []
    assert talk.hears(UNKNOWN) == [HELLO]
    assert talk.hears(lease(1)) == [Begun(1)]
    talk.makes(1)
    assert talk.hears(UNKNOWN) == [HELLO]


def test_a_hello_that_may_be_lost_is_said_again() -> None:
    talk = Talk()
    talk.now += 5.0
    assert talk.hears() == [Ping()]
    assert talk.hears(UNKNOWN) == [HELLO]


@pytest.mark.parametrize("is_watched", [True, False])
def test_a_server_that_is_away_does_not_find_a_ping_for_every_five_seconds(is_watched: bool) -> None:
    talk = Talk(is_watched=is_watched)
    begun, pings = talk.now, []
    while talk.now < begun + 2000.0:
        assert isinstance(talk.step, Listen)
        assert 0.0 < talk.step.seconds <= 5.0
        talk.now += talk.step.seconds
        if Ping() in talk.hears():
            pings.append(talk.now - begun)
    assert pings == [5.0, 15.0, 35.0, 75.0, 155.0, 315.0, 635.0, 955.0, 1275.0, 1595.0, 1915.0]
    assert len(talk.told) == (0 if is_watched else 1)
    for line in talk.told:
        assert line.startswith("tcp://there has not answered for 20 s; waiting. Is v2v-serve running there?")
        assert line.endswith("it serves only root and its own user")


def test_a_silent_server_is_greeted_over_a_new_connection() -> None:
    talk = Talk()
    talk.now += 5.0
    assert (talk.hears(), talk.connections) == ([Ping()], 1)
    talk.now += 10.0
    assert (talk.hears(), talk.connections) == ([HELLO, Ping()], 2)
    assert talk.hears(Pong()) == []
    talk.now += 5.0
    assert (talk.hears(), talk.connections) == ([Ping()], 2)


def test_a_message_is_waited_for_only_if_a_server_was_there_lately() -> None:
    talk = Talk()
    found = [talk.conversation.brokers[0].is_there]
    for message in (Pong(), None, Pong()):
        talk.now += 5.0
        talk.hears(*([] if message is None else [message]))
        found.append(talk.conversation.brokers[0].is_there)
    assert found == [False, True, False, True]
    assert at_work(1, 2).conversation.brokers[0].is_there


def test_the_time_that_a_sample_takes_is_no_silence() -> None:
    talk = at_work(1, is_watched=False)
    talk.makes(1, seconds=1000.0)
    assert talk.hears() == [Result(1, begins=0)]
    assert talk.hears() == []
    assert talk.told == []


def test_a_worker_that_cannot_read_its_server_reports_what_it_made_says_why_and_leaves() -> None:
    later = msgpack.packb(msgpack.unpackb(encode(lease(2))[0]) | {"rotation": 90})
    for unreadable, why in ((b"nonsense", "not a message"), (later, "Lease has no field 'rotation'")):
        talk = at_work(1)
        talk.makes(1)
        talk._take(talk.conversation.on_messages([(0, unreadable), (0, encode(lease(3))[0])], talk.now))
        result, goodbye = talk.said()
        assert (result, type(goodbye)) == (Result(1, begins=0), Goodbye)
        assert isinstance(talk.step, Leave)
        assert talk.step.reason == goodbye.notes.reason
        assert f"cannot read a message of the server: {why}" in talk.step.reason


def test_a_server_of_another_version_ends_the_worker() -> None:
    """It says so in its own version, which is no message to ours; to ask it again every five seconds is no use."""
    denial = msgpack.packb({"v": PROTOCOL_VERSION + 1, "t": "denied", "code": "version", "text": "", "more": 0})
    with pytest.raises(VersionMismatch, match=f"version {PROTOCOL_VERSION + 1}"):
        Talk().conversation.on_messages([(0, denial)], 0.0)


def test_a_server_that_does_not_want_this_worker_ends_it() -> None:
    with pytest.raises(RemoteError, match="another numerics version"):
        Talk().hears(Denied(ErrorCode.VERSION, "another numerics version"))


class TestKernels:
    """From lease 2 on a kernel is needed that the worker has not."""

    def test_are_there_before_a_sample_is_begun(self) -> None:
        """What is begun is timed, and blamed if it takes too long."""
        talk = at_work(1)
        talk.unready = {2, 3}
        talk.makes(1)
        assert talk.hears(lease(2)) == [Result(1, begins=0)]
        assert talk.step == Load(lease(2))
        assert talk.loads() == [Begun(2)]
        assert talk.step == Make(lease(2))

    def test_are_compiled_while_its_leases_are_for_others(self) -> None:
        talk = at_work(1)
        talk.unready, talk.compiled = {2}, False
        talk.makes(1)
        assert talk.hears(lease(2)) == [Result(1, begins=0), Goodbye()]
        assert talk.loads() == []
        assert talk.hears(lease(9)) == [HELLO]  # 9 was on its way when the server heard the goodbye
        assert talk.hears(lease(3)) == [Begun(3)]


class TestSiblings:
    """The worker decodes for lease 1 and holds 2 and 3, whose samples are made of the same clip."""

    @staticmethod
    def at_first(*, is_watched: bool = True) -> Talk:
        talk = at_work(1, 2, 3, is_watched=is_watched)
        talk.decoded = {2, 3}
        return talk

    def test_are_announced_together(self) -> None:
        talk = self.at_first()
        assert talk.makes(1) + talk.makes(2) + talk.makes(3) == []
        assert talk.hears() == [Result(1, begins=2), Result(2, begins=3), Result(3, begins=0)]

    def test_do_not_wait_for_another_clip(self) -> None:
        talk = self.at_first()
        talk.decoded = {2}
        assert talk.makes(1) + talk.makes(2) == []
        assert talk.hears() == [Result(1, begins=2), Result(2, begins=3)]
        assert talk.step == Make(lease(3))

    def test_do_not_wait_long(self) -> None:
        """The server would see two of them take the time that it allows for one."""
        talk = self.at_first()
        assert talk.makes(1, seconds=0.06) + talk.makes(2, seconds=0.06) == []
        assert talk.hears() == [Result(1, begins=2), Result(2, begins=3)]

    @pytest.mark.parametrize(("is_watched", "frames"), [(True, IN_MESSAGE), (False, IN_SLOT)])
    def test_do_not_wait_with_arrays_that_travel_nor_where_the_server_cannot_see_which_is_in_work(
        self, is_watched: bool, frames: Frames
    ) -> None:
        talk = self.at_first(is_watched=is_watched)
        talk.makes(1, frames)
        assert talk.hears() == [Result(1, begins=2)]


# --- the process ------------------------------------------------------------------------------------------------------

WAIT_MS = 60_000
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


@contextmanager
def working(folder: Path) -> Iterator[Server]:
    """Lend a server whose worker has said hello and runs in a thread."""
    with zmq.Context() as context, context.socket(zmq.ROUTER) as router, (folder / "logbook").open("wb") as logbook:
        router.setsockopt(zmq.LINGER, 0)
        at = Server(router)
        port = router.bind_to_random_port("tcp://127.0.0.1")
        worker = Worker("w", Folder(folder), [f"tcp://127.0.0.1:{port}"], logbook.fileno())
        thread = threading.Thread(target=worker.run)
        thread.start()
        try:
            hello = at.heard()
            assert isinstance(hello, WorkerHello)
            assert hello.notes.memory_bytes == memory_limit()
            yield at
        finally:
            at.says(Stop())
            thread.join(WAIT_MS / 1000)
            assert not thread.is_alive()


@pytest.fixture
def server(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Server]:
    """Samples in slots, whose indices are the numbers of their leases. Lease 2 needs no decoding, lease 3 fails, and
    lease 4 needs a kernel that is not loaded.
    """

    def make(job: SampleJob, *_: object) -> Any:
        at.did.append(f"make {job.index}")
        if job.index == 3:
            raise VideoError("a.mp4", 7, "cut short")
        return SimpleNamespace(provenance=SimpleNamespace(to_dict=dict))

    for name, replaced in {
        "make_sample": make,
        "open_output_buffer": lambda lease, layout, arenas: OutputBuffer(new_arrays(layout), in_slot=True),
        "kernels_of": lambda clip: frozenset({VARIANT} if clip.start_frame == 4 else ()),
        "is_compiled": lambda variant: True,
        "load_in_turn": lambda variant: at.did.append("load"),
        "give_way": lambda: at.did.append("give way"),
        "note": lambda _, lease, decodes=False: decodes or at.did.append(f"note {lease}"),
    }.items():
        monkeypatch.setattr(worker_module, name, replaced)
    monkeypatch.setattr(Clips, "take", lambda self, clip, indices: (None, False))
    monkeypatch.setattr(Clips, "has", lambda self, clip, index: index == 2)
    with working(tmp_path) as at:
        yield at


@pytest.mark.parametrize("damaged", ["frame_index", "scene"])
def test_a_lease_with_a_damaged_part_fails_and_its_worker_goes_on(tmp_path: Path, damaged: str) -> None:
    """The server passes on what its index on disk holds. Three deaths over it would cost the video all its readers."""
    spec = replace(SMALL_SPEC, scene="auto" if damaged == "scene" else "off")
    lease = replace(LEASE, video="a.mp4", spec=spec.canonical(), **{damaged: b"garbage"})  # type: ignore[arg-type]
    with working(tmp_path) as server:
        for number in (1, 2):
            server.says(replace(lease, lease=number))
            assert server.heard() == Begun(number)
            failed = server.heard()
            assert isinstance(failed, LeaseFailed)
            assert (failed.lease, failed.here) == (number, False)
            what = {"frame_index": "index", "scene": "scene"}[damaged]
            assert failed.reason.startswith(f"its {what} from the server is damaged: {damaged.replace('_', ' ')} ")


def test_it_makes_what_it_is_given_and_notes_what_it_is_at(server: Server) -> None:
    """Siblings are made in one turn on the core."""
    server.says(*(replace(LEASE, lease=number, indices=(number,), start_frame=number) for number in range(1, 5)))
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
    def opened(clip: ClipJob, source: object) -> Iterator[dict[str, None]]:
        server.did.append(f"open from {clip.start_frame}")
        if clip.start_frame == 18:
            raise SidecarError("a.mp4", ".boxes/", "is gone", here=True)
        yield {}

    monkeypatch.setattr(worker_module, "open_sidecars", opened)
    monkeypatch.setattr(worker_module, "kernels_of", lambda clip: frozenset())
    labelled = replace(LEASE, video="a.mp4", arrays=("boxes",))
    starts = {1: 0, 2: 0, 4: 9, 5: 18}
    server.says(
        *(
            replace(
                labelled,
                lease=number,
                indices=(number,),
                start_frame=start,
                sidecars={".boxes/": ["3-x", b"the same files"]},
            )
            for number, start in starts.items()
        )
    )
    said = [server.heard()]
    while not isinstance(said[-1], LeaseFailed):
        said.append(server.heard())
    assert said[-1] == LeaseFailed(5, None, "is gone", True, ".boxes/")
    assert [step for step in server.did if "way" not in step] == [
        *("open from 0", "note 1", "make 1", "note 0"),
        *("note 2", "make 2", "note 0"),
        *("open from 9", "note 4", "make 4", "note 0"),
        *("open from 18", "note 5", "note 0"),
    ]


def test_a_new_connection_has_a_new_routing_id(tmp_path: Path) -> None:
    with zmq.Context() as context, context.socket(zmq.ROUTER) as router:
        router.setsockopt(zmq.LINGER, 0)
        at = Server(router)
        port = router.bind_to_random_port("tcp://127.0.0.1")
        # Without the question of whose server it is, the handshake needs no call of the worker.
        worker = Worker("w", Folder(tmp_path), [f"tcp://127.0.0.1:{port}"], insecure=True)
        found = []
        try:
            for _ in range(2):
                worker._do(Send(encode(Ping())))
                assert at.heard() == Ping()
                at.says(Pong())
                assert wait(worker._links, WAIT_MS / 1000)
                assert [(broker, decode(frame)) for broker, frame in worker._messages(0.0)] == [(0, Pong())]
                found.append(at.worker)
                worker._do(Reconnect())
        finally:
            worker.close()
    assert len(set(found)) == 2
    assert all(len(identity) == 16 and identity != b"w" for identity in found)


def test_a_worker_whose_server_is_away_keeps_to_the_ip_version(tmp_path: Path, unused_port: int) -> None:
    """With the other one it would not find the server again until its next new connection, minutes later."""
    worker = Worker("w", Folder(tmp_path), [f"tcp://localhost:{unused_port}"])
    try:
        for _ in range(3):
            worker._do(Reconnect())
            assert worker._links[0]._socket is not None
            assert worker._links[0]._socket.getsockopt(zmq.IPV6) == 0
    finally:
        worker.close()


def test_a_malformed_address_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"--connect: address 'nowhere': .*; give tcp://host:port"):
        Worker("w", Folder(tmp_path), ["nowhere"])


def test_a_corpus_that_cannot_be_looked_at_is_said(capsys: pytest.CaptureFixture[str]) -> None:
    assert worker_command(["--connect", "tcp://127.0.0.1:1", "--videos", "x" * 300]) == 2
    assert "cannot be read: File name too long" in capsys.readouterr().err


def test_workers_in_containers_of_one_name_do_not_share_theirs(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Each is process 1 there, as here. The server hears only one of two workers with the same name."""
    names: list[str] = []

    class Named(Worker):
        def __init__(self, name: str, *more: object, **_: object) -> None:
            names.append(name)

        def run(self) -> None:
            pass

    monkeypatch.setattr(worker_module, "Worker", Named)
    for asks in ("_ask", "keep_freed_memory", "limit_memory", "confine", "warm_up_in_turn", "take_long_turns"):
        monkeypatch.setattr(worker_module, asks, lambda *_, **__: None)
    monkeypatch.setattr(worker_module, "gc", SimpleNamespace(collect=lambda: 0, freeze=lambda: None))
    monkeypatch.setattr(worker_module, "signal", SimpleNamespace(SIGTERM=15, signal=lambda number, handler: None))
    monkeypatch.setenv("OPENCV_FOR_THREADS_NUM", "1")
    for name in (None, None, "mine"):
        run_worker(["tcp://127.0.0.1:5556"], Folder(tmp_path), name, None)
    assert len(set(names)) == 3
    assert names[0].startswith(f"{socket.gethostname()}-{os.getpid()}-")
    assert names[2] == "mine"


@pytest.mark.parametrize("answers", [False, True])
def test_a_server_that_does_not_answer_is_named_before_the_kernels_are_compiled(
    answers: bool, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    """A server without keys never answers another user, and compiling takes a minute on a new host."""
    said: list[str] = []

    def compile_kernels() -> None:
        said.append(capsys.readouterr().err)
        raise InterruptedError

    monkeypatch.setattr(worker_module, "warm_up_in_turn", compile_kernels)
    monkeypatch.setattr(worker_module, "limit_memory", lambda _: None)
    monkeypatch.setattr(worker_module, "_ASK_SECONDS", 60.0 if answers else 0.3)
    with zmq.Context() as context, context.socket(zmq.ROUTER) as server:
        server.linger = 0
        port = server.bind_to_random_port("tcp://127.0.0.1")

        def answer() -> None:
            peer, *_ = server.recv_multipart()
            server.send_multipart([peer, *encode(Denied(ErrorCode.UNKNOWN_SESSION, "say WorkerHello"))])

        thread = threading.Thread(target=answer if answers else bool)
        thread.start()
        with pytest.raises(InterruptedError):
            run_worker([f"tcp://127.0.0.1:{port}"], Folder(tmp_path), None, None)
        thread.join()
    assert (said == [""]) == answers
    assert answers or f"tcp://127.0.0.1:{port}: a server listens there, and does not answer yet" in said[0]


def test_workers_that_are_given_one_name_do_not_share_it(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """A batch system starts all of them with the same command."""
    names: list[str] = []
    monkeypatch.setattr(
        "v2v_server.commands.worker.run_worker", lambda brokers, root, name, *_, **__: names.append(name)
    )
    command = ["--connect", "tcp://127.0.0.1:5556", "--videos", str(tmp_path), "--name", "node7"]
    for more in ([], [], ["--logbook-fd", "3"]):
        worker_command([*command, *more])
    assert len(set(names)) == 3
    assert [name[:6] for name in names] == ["node7-", "node7-", "node7"]


def test_a_name_that_no_connection_can_have_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert worker_command(["--connect", "tcp://127.0.0.1:5556", "--videos", "videos", "--name", "n" * 300]) == 2
    assert "--name has 300 bytes: give at most 200" in capsys.readouterr().err

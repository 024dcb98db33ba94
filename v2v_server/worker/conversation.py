"""The server worker: takes a lease, makes its sample, sends it, takes the next.

It holds the leases of two clips at a time, so that the next one is at hand when a sample is done; sending happens in
ZeroMQ's own thread while the next sample is made. Siblings that are made in little time and lie in slots are announced
together: server and consumer then wake once for all of them, and find the rest at hand. Its life is in others' hands:
it may be killed at any moment, and does nothing that would have to be undone.
"""

from __future__ import annotations

import gc
import os
import secrets
import signal
import socket
import sys
import time
from collections import deque
from pathlib import Path

import zmq

from v2v_protocol import NUMERICS_VERSION
from v2v_protocol.errors import (
    ProtocolError,
    RemoteError,
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
    Goodbye,
    Lease,
    LeaseFailed,
    Message,
    Ping,
    Pong,
    Result,
    Stop,
    WorkerHello,
)
from v2v_protocol.wire import LARGEST_HEADER_BYTES, Frames, decode, encode
from v2v_server.simulation.variants import USUAL
from v2v_server.system.process import die_with_parent, give_way, keep_freed_memory, take_long_turns
from v2v_server.worker.decode_cache import Clips
from v2v_server.worker.handover import room_for, sample_message
from v2v_server.worker.logbook import IDLE, note
from v2v_server.worker.produce import kernels_of, make_sample, sample_layout
from v2v_server.worker.warm_up import is_compiled, load_in_turn, warm_up_in_turn

CREDIT = 2
MOST_NAME_BYTES = 200
"""What an operator may call a worker; a routing identity has 255 at most."""
_PING_SECONDS = 5.0
_MOST_SILENCES = 64
"""Of so many seconds each, until a silent server is asked again; before that, after 1, 2, 4, 8 ... of them. ZeroMQ
keeps what is said to a server that is away, which hears all of it when it is back."""
_TOLD_SILENCES = 4
"""Until whoever started a worker is told that its server does not answer."""
_TOGETHER_SECONDS = 0.1
"""What is done waits for a sibling if less time than this has gone by since the first of them was begun. Not since it
was done: where samples take long the server's clocks, which run from result to result, must see each of them."""
_MORE = int(zmq.SNDMORE)
"""A plain number: send_multipart works with an enumeration, which takes longer than sending a small frame."""


class Worker:
    """One worker's conversation with the server.

    Only a VideoError is reported as the video's failure. Anything else ends the process with its trace: the sample is
    given to another worker, and an installation that is broken ends in the server's crash budget instead of a stream
    that quietly lacks samples.

    Args:
        name: unique name, also its routing identity.
        root: the corpus folder on this host.
        address: where the server listens for workers.
        logbook: descriptor of the file for the lease in work, see :mod:`v2v_server.worker.logbook`.
    """

    def __init__(self, name: str, root: Path, address: str, logbook: int | None = None) -> None:
        self._name = name
        self._address = address
        self._logbook = logbook
        self._clips = Clips(root)
        self._leases: deque[Lease] = deque()
        self._begun = 0  # the lease that was last said to be begun
        self._kernels = set(USUAL)  # that are loaded
        self._hellos = 0
        self._unheard = False  # nothing says yet that the server took in our last hello
        self._silences = 0  # since something was heard
        self._unsent: list[tuple[int, Frames]] = []  # leases that are done, and what is to be said of their samples
        self._unsent_since = 0.0
        self._stopping = False
        self._context = zmq.Context()
        self._socket = self._context.socket(zmq.DEALER)
        self._socket.setsockopt(zmq.ROUTING_ID, name.encode())
        self._socket.setsockopt(zmq.LINGER, 5000)
        self._socket.setsockopt(zmq.MAXMSGSIZE, LARGEST_HEADER_BYTES)
        # Leases bound what is queued: at most CREDIT samples in either direction.
        self._socket.setsockopt(zmq.SNDHWM, 0)
        self._socket.setsockopt(zmq.RCVHWM, 0)
        self._socket.setsockopt(zmq.IPV6, int("[" in address))
        try:
            self._socket.connect(address)
        except zmq.ZMQError as error:
            self._context.destroy(linger=0)
            raise UsageError(f"--connect {address}: {error.strerror}; write tcp://HOST:PORT") from error
        self._poller = zmq.Poller()
        self._poller.register(self._socket, zmq.POLLIN)

    def stop(self) -> None:
        """Finishes the lease in work, gives the others back and leaves. May be called from a signal handler."""
        self._stopping = True

    def run(self) -> None:
        """Works until told to stop.

        Raises:
            RemoteError: the server refuses this worker (another numerics version).
            VersionMismatch: the server speaks another version of the protocol.
        """
        try:
            self._say_hello()
            while not self._stopping:
                if not self._leases:
                    self._receive(_PING_SECONDS)
                elif self._begun != self._leases[0].lease:
                    self._begin()
                else:
                    self._work(self._leases.popleft())
                    if not self._unsent:
                        give_way()  # the next clip finds the caches cold anyhow; in the middle of one they are warm
            self._send_results()
            self._send(encode(Goodbye()))
        finally:
            self._context.destroy()

    def _say_hello(self) -> None:
        self._begun = 0  # a server that does not know us counts its leases anew
        self._hellos += 1
        self._unheard = True
        hello = WorkerHello(self._name, socket.gethostname(), os.getpid(), NUMERICS_VERSION, CREDIT)
        self._send(encode(hello))

    def _receive(self, wait_seconds: float) -> None:
        """Takes every message that is there, waiting for the first one at most this long."""
        timeout = int(wait_seconds * 1000)
        if timeout and not self._poller.poll(timeout):
            self._unheard = False  # it may be lost
            self._silences += 1
            if self._silences.bit_count() == 1 or self._silences % _MOST_SILENCES == 0:
                self._send(encode(Ping()))
            if self._silences == _TOLD_SILENCES and self._logbook is None:  # of its own workers a server knows
                seconds = _TOLD_SILENCES * _PING_SECONDS
                print(f"{self._name}: {self._address} has not answered for {seconds:g} s; waiting", file=sys.stderr)
            return
        while self._poller.poll(0):
            self._silences = 0
            first, *_ = self._socket.recv_multipart()
            try:
                self._handle(decode(first))
            except VersionMismatch:
                raise  # a refusal, in words that only its own version understands
            except ProtocolError as error:
                print(f"{self._name}: ignored a message from the server: {error}", file=sys.stderr)

    def _handle(self, message: Message) -> None:
        match message:
            case Lease():
                self._unheard = False
                self._leases.append(message)
            case Pong():
                self._unheard = False
            case Stop():
                self._stopping = True
            case Denied(ErrorCode.UNKNOWN_SESSION) if self._unheard:
                pass  # what it refuses was said before; another hello would take back the leases that this one brings
            case Denied(ErrorCode.UNKNOWN_SESSION):
                # The server was restarted, or had given us up: what we hold has been given to others.
                self._leases.clear()
                self._say_hello()
            case Denied(code, text):
                raise RemoteError(code, text)
            case _:
                pass

    def _begin(self) -> None:
        if not self._is_ready(self._leases[0]):
            self._get_ready()
            return
        self._begun = self._leases[0].lease
        self._send(encode(Begun(self._begun)))

    def _is_ready(self, lease: Lease) -> bool:
        return kernels_of(lease) <= self._kernels

    def _get_ready(self) -> None:
        """Has the kernels of the next lease. While they are compiled its leases are for others: that takes seconds,
        many where cores are few, and a video is not to be blamed for them, nor a worker."""
        missing = kernels_of(self._leases[0]) - self._kernels
        away = not all(map(is_compiled, missing))
        if away:
            self._send(encode(Goodbye()))
        for variant in missing:
            load_in_turn(variant)
        self._kernels |= missing
        if away:
            self._receive(0.0)  # what was on its way when the server heard of it
            self._leases.clear()
            self._say_hello()

    def _work(self, lease: Lease) -> None:
        if not self._unsent:
            self._unsent_since = time.monotonic()
        note(self._logbook, lease.lease)
        frames = self._made(lease)
        note(self._logbook, IDLE)  # not where an exception ends the worker: it was this lease
        if frames is not None:
            self._unsent.append((lease.lease, frames))
            if self._may_wait(frames):
                self._begun = self._leases[0].lease
                return
        hellos = self._hellos
        self._receive(0.0)
        if hellos != self._hellos:
            self._unsent.clear()  # the server has forgotten these leases, and may have given their numbers to others
        self._send_results()

    def _may_wait(self, frames: Frames) -> bool:
        """Whether what was just made is sent along with its sibling, which is made next and needs no decoding."""
        return (
            len(frames) == 1  # arrays that travel with it had better be on their way
            and self._logbook is not None  # elsewhere the server blames what was begun to its knowledge
            and bool(self._leases)
            and self._clips.has(self._leases[0])
            and time.monotonic() - self._unsent_since < _TOGETHER_SECONDS
        )

    def _send_results(self) -> None:
        """Says what is done, and along with it what is begun next."""
        if not self._unsent:
            return
        may_go_on = self._leases and not self._stopping and self._is_ready(self._leases[0])
        self._begun = self._leases[0].lease if may_go_on else 0
        begun = [*(number for number, _ in self._unsent[1:]), self._begun]
        for (number, frames), next_one in zip(self._unsent, begun, strict=True):
            self._send([*encode(Result(number, next_one)), *frames])
        self._unsent.clear()

    def _made(self, lease: Lease) -> Frames | None:
        """The frames of a lease's sample; None where its video fails, which is said at once."""
        room = room_for(lease, sample_layout(lease))
        started = time.process_time()
        try:
            clip, decoded = self._clips.take(lease)
            if decoded:
                # PyAV ties a frame whose side data was read (its orientation) into a reference cycle: few objects to
                # Python's collector, which waits for many, but each holds pictures.
                gc.collect()
            sample = make_sample(lease, clip, room.arrays)
        except VideoError as error:
            here = isinstance(error, VideoChanged | VideoUnreadable)
            self._send(encode(LeaseFailed(lease.lease, error.frame, error.reason, here)))
            return None
        cpu_seconds = time.process_time() - started
        return sample_message(
            lease,
            room,
            provenance=sample.provenance.to_dict(),
            worker=self._name,
            cpu_seconds=cpu_seconds,
            decoded=decoded,
        )

    def _send(self, frames: Frames) -> None:
        *first, last = frames
        for frame in first:
            self._socket.send(frame, _MORE, copy=False)
        self._socket.send(last, copy=False)


def unshared_name(beginning: str | None) -> str:
    """A name that no other worker has: of two of one name the server would hear one, and the other wait for ever.

    Args:
        beginning: what its operator calls it, and perhaps others too; None: host and process id, which in containers
            may be the same for all.

    Raises:
        UsageError: it is too long to be a routing identity with what is added to it.
    """
    if beginning is not None and len(beginning.encode()) > MOST_NAME_BYTES:
        raise UsageError(f"--name has {len(beginning.encode())} bytes: give at most {MOST_NAME_BYTES}")
    return f"{beginning or f'{socket.gethostname()}-{os.getpid()}'}-{secrets.token_hex(4)}"


def run_worker(address: str, root: Path, name: str | None, parent_pid: int | None, logbook: int | None = None) -> None:
    """Runs one worker in this process until the server stops it.

    Args:
        address: where the server listens for workers.
        root: the corpus folder on this host.
        name: unique name; by default host, process id and something random.
        parent_pid: the server, when this is one of its own processes: we die with it.
        logbook: descriptor of the file for the lease in work, see :mod:`v2v_server.worker.logbook`.

    Raises:
        UsageError: the address cannot be connected to.
        RemoteError, VersionMismatch: the server refuses this worker.
    """
    if parent_pid is not None:
        die_with_parent(parent_pid)
    keep_freed_memory()
    # A worker is one core's worth of work. OpenCV reads this when it is loaded, which some recipes never do.
    os.environ["OPENCV_FOR_THREADS_NUM"] = "1"
    # Compile or load the kernels first: a worker that has said hello can work at full speed.
    warm_up_in_turn()
    # What is there by now stays: without it a collection takes a fraction of a millisecond.
    gc.collect()
    gc.freeze()
    worker = Worker(name or unshared_name(None), root, address, logbook)
    signal.signal(signal.SIGTERM, lambda number, frame: worker.stop())
    # Now that ZeroMQ's threads are there, which had better come at once.
    take_long_turns()
    worker.run()

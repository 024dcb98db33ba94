"""Run a small correct server: the real wire format over a ROUTER socket, with faults on request.

The bytes of a sample are a function of (seed, epoch, index), see :func:`expected`. Credit is counted as a real server
counts it: a request beyond it is refused whole.
"""

from __future__ import annotations

import queue
import random
import threading
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any

import numpy as np
import zmq

from v2v_protocol.arena import NO_SLOT, Slot
from v2v_protocol.errors import UsageError
from v2v_protocol.messages import (
    Denied,
    ErrorCode,
    Goodbye,
    Hello,
    Message,
    Ping,
    Pong,
    Unavailable,
    Want,
    Welcome,
    decode,
    encode,
    encode_sample,
)
from v2v_protocol.recipe import Recipe
from v2v_protocol.sample import Provenance, SampleId, SampleParams, array_layout
from v2v_protocol.spec import StreamSpec
from v2v_server.worker.process import slot_arrays

SPEC = StreamSpec(recipe=Recipe(voxels_per_clip=2, bins=2, crop_height_px=4, crop_width_px=6))
_IDLE_MS = 5
_PARAMS = SampleParams(0.2, 0.3, 0.0, 0, 0.0, (), 1.0, 0, 0, False, 0.0, (1, 2, 3, 4))


def expected(name: str, seed: int, epoch: int, index: int, spec: StreamSpec = SPEC) -> np.ndarray[Any, Any]:
    """Return the array of that name of one sample."""
    dtype, shape = array_layout(spec.recipe, spec.voxel_dtype, (name,))[name]
    random_bytes = np.random.default_rng([seed, epoch, index, len(name)])
    return random_bytes.integers(0, 100, shape).astype(dtype)


class _Session:
    def __init__(self, hello: Hello, spec: StreamSpec) -> None:
        self.hello = hello
        self.spec = spec
        self.unanswered: dict[tuple[int, int], None] = {}
        self.slots: dict[tuple[int, int], Slot] = {}


class FakeServer:
    """Serve in a thread inside a ``with`` block.

    Attributes (set them before use or under :meth:`call`; the thread reads them):
        catalogue, sequences, credit: what Welcome says.
        refusal: answers every Hello, when set.
        shuffled: answers come one at a time, at random, when nothing else is to do.
        held: answers nothing but Ping until it is False again.
        mute: answers nothing at all.
        trouble: what a Pong says of the workers.
        drop: samples (epoch, index) that are lost once, after they count as answered.
        twice: samples that are sent twice.
        unavailable: indices that cannot be made.
        overstated: Welcome grants this much more than is accepted.
        alter: changes the frames of a sample before they are sent.
        snapshot: quarantine snapshot that samples are made under.
        workers: where they are: "here" they put samples into the slots that are lent, "elsewhere" they cannot and send
            them, "many" is both, and some samples are made by a second worker, which knows of no slot.
        hellos, wants: what came, in order.
        slots: the slots that came with them.
        arenas: of those, in the order in which they were first named, again where another came in between.
        lost: slots of dropped samples.
        most_unanswered: largest number of unanswered samples of one session.
    """

    def __init__(self, *, sequences: int = 23, credit: int = 8, spec: StreamSpec = SPEC) -> None:
        self.spec = spec
        self.catalogue = "catalogue-1"
        self.sequences = sequences
        self.credit = credit
        self.refusal: Denied | None = None
        self.shuffled = False
        self.held = False
        self.mute = False
        self.trouble = ""
        self.drop: set[tuple[int, int]] = set()
        self.twice: set[tuple[int, int]] = set()
        self.unavailable: set[int] = set()
        self.overstated = 0
        self.alter: Callable[[list[Any]], list[Any]] = lambda frames: frames
        self.snapshot = 0
        self.workers = "here"
        self.hellos: list[Hello] = []
        self.wants: list[tuple[int, int]] = []
        self.slots: list[int] = []
        self.arenas: list[str] = []
        self.lost: list[Slot] = []
        self.most_unanswered = 0
        self.refused_for_credit = 0
        self._random = random.Random(7)
        self._sessions: dict[bytes, _Session] = {}
        self._waiting: list[Future[None]] = []  # for the sessions to end
        self._commands: queue.Queue[tuple[Callable[[], Any], Future[Any]]] = queue.Queue()
        self._context: zmq.Context[Any] = zmq.Context()
        self._wake = self._context.socket(zmq.PAIR)
        self._wake.bind("inproc://wake")
        self._socket = self._bind("tcp://127.0.0.1:*")
        self.address = self._socket.getsockopt_string(zmq.LAST_ENDPOINT)
        self._thread = threading.Thread(target=self._serve, name="fake-server")

    def _bind(self, address: str) -> zmq.Socket[bytes]:
        socket = self._context.socket(zmq.ROUTER)
        socket.setsockopt(zmq.LINGER, 0)
        socket.setsockopt(zmq.ROUTER_HANDOVER, 1)
        while True:
            try:
                socket.bind(address)
                return socket
            except zmq.ZMQError as error:  # the socket before it is closed in the background
                if error.errno != zmq.EADDRINUSE:
                    raise

    def __enter__(self) -> FakeServer:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.call(self._stop)
        self._thread.join()
        self._wake.close(linger=0)
        self._context.term()

    def call(self, command: Callable[[], Any]) -> Any:
        """Run ``command`` in the server's thread, between two messages."""
        future: Future[Any] = Future()
        self._commands.put((command, future))
        self._wake.send(b"")
        return future.result()

    def restart(self, **changes: Any) -> None:
        """Restart like a killed server: the same port, no sessions, some attributes changed."""

        def again() -> None:
            self._socket.close(linger=0)
            self._sessions.clear()
            for name, value in changes.items():
                setattr(self, name, value)
            self._socket = self._bind(self.address)

        self.call(again)

    def forget(self) -> None:
        """Forget all sessions, as a server does with silent ones."""
        self.call(self._sessions.clear)

    def until_all_left(self) -> None:
        """Return once all sessions have said Goodbye; the last Goodbye may still be on its way.

        Raises:
            TimeoutError: one is left.
        """
        all_left: Future[None] = Future()
        self.call(lambda: self._waiting.append(all_left))
        all_left.result(60.0)

    # --- the thread ---------------------------------------------------------------------------------------------------

    def _stop(self) -> None:
        self._running = False

    def _serve(self) -> None:
        self._running = True
        wake = self._context.socket(zmq.PAIR)
        wake.connect("inproc://wake")
        while self._running:
            while self._waiting and not self._sessions:
                self._waiting.pop().set_result(None)
            poller = zmq.Poller()
            poller.register(wake, zmq.POLLIN)
            poller.register(self._socket, zmq.POLLIN)
            ready = dict(poller.poll(_IDLE_MS if self._busy() else None))
            if wake in ready:
                wake.recv()
                command, future = self._commands.get()
                try:
                    future.set_result(command())
                except BaseException as error:  # noqa: BLE001 - it is the caller's
                    future.set_exception(error)
            elif self._socket in ready:
                identity, header, *_ = self._socket.recv_multipart()
                self._handle(identity, decode(header))
            elif not ready:
                self._answer_one()
        wake.close(linger=0)
        self._socket.close(linger=0)

    def _busy(self) -> bool:
        return not self.held and not self.mute and any(session.unanswered for session in self._sessions.values())

    def _send(self, identity: bytes, frames: list[Any]) -> None:
        self._socket.send_multipart([identity, *frames])

    def _handle(self, identity: bytes, message: Message) -> None:
        if isinstance(message, Hello):
            self.hellos.append(message)
        if self.mute:
            return
        session = self._sessions.get(identity)
        if isinstance(message, Hello):
            self._send(identity, encode(self._welcome(identity, message)))
        elif isinstance(message, Goodbye):
            self._sessions.pop(identity, None)
        elif isinstance(message, Ping):
            self._send(identity, encode(Pong(self.trouble)))
        elif session is None:
            self._send(identity, encode(Denied(ErrorCode.UNKNOWN_SESSION, "say Hello again")))
        elif isinstance(message, Want):
            self._want(identity, session, message)

    def _welcome(self, identity: bytes, hello: Hello) -> Message:
        if self.refusal is not None:
            return self.refusal
        try:
            spec = StreamSpec.from_dict(hello.spec, default=self.spec)
        except UsageError as error:
            return Denied(ErrorCode.SPEC, str(error))
        self._sessions[identity] = _Session(hello, spec)
        return Welcome(spec.to_dict(), spec.digest, self.catalogue, 1, self.sequences, self.credit + self.overstated)

    def _want(self, identity: bytes, session: _Session, want: Want) -> None:
        asked = [(want.epoch, index) for index in want.indices]
        self.wants += asked
        self.slots += want.slots or (NO_SLOT,) * len(asked)
        for key, arena, number in zip(asked, want.arenas, want.slots, strict=False):
            if arena:
                session.slots[key] = Slot(arena, number)
                if self.arenas[-1:] != [arena]:
                    self.arenas.append(arena)
        if any(index >= self.sequences for index in want.indices):
            self._send(identity, encode(Denied(ErrorCode.RANGE, f"an epoch has {self.sequences} sequences")))
            return
        unanswered = session.unanswered | dict.fromkeys(asked)
        if len(unanswered) > self.credit:
            self.refused_for_credit += 1
            self._send(identity, encode(Denied(ErrorCode.CREDIT, f"{len(unanswered)} of {self.credit}")))
            return
        session.unanswered = unanswered
        self.most_unanswered = max(self.most_unanswered, len(unanswered))
        if not self.shuffled and not self.held:
            for epoch, index in list(session.unanswered):
                self._answer(identity, session, epoch, index)

    def _answer_one(self) -> None:
        waiting = [
            (identity, session, key) for identity, session in self._sessions.items() for key in session.unanswered
        ]
        if waiting and not self.held:
            identity, session, key = self._random.choice(waiting)
            self._answer(identity, session, *key)

    def answer(self, epoch: int, index: int) -> None:
        """Answer that sample to every session that waits for it, held or not; use it under :meth:`call`."""
        for identity, session in self._sessions.items():
            if (epoch, index) in session.unanswered:
                self._answer(identity, session, epoch, index)

    def _answer(self, identity: bytes, session: _Session, epoch: int, index: int) -> None:
        del session.unanswered[epoch, index]
        slot = session.slots.pop((epoch, index), None)
        if index in self.unavailable:
            self._send(identity, encode(Unavailable(epoch, index, "a.mp4 at frame 3: truncated")))
            return
        if (epoch, index) in self.drop:
            self.drop.remove((epoch, index))
            self.lost += [] if slot is None else [slot]
            return
        frames = self.alter(self.sample(session, epoch, index, slot))
        for _ in range(2 if (epoch, index) in self.twice else 1):
            self._send(identity, frames)

    def sample(self, session: _Session, epoch: int, index: int, slot: Slot | None) -> list[Any]:
        seed = session.hello.seed
        arrays = {name: expected(name, seed, epoch, index, session.spec) for name in session.hello.arrays}
        place = self._random.randrange(3) if self.workers == "many" else ("here", "elsewhere").index(self.workers)
        in_slot = slot is not None and place == 0 and _put(slot, arrays, session)
        if slot is not None and place == 2:
            _put(slot, {name: np.full_like(array, 101) for name, array in arrays.items()}, session)  # the first worker
            slot = None
        identity = SampleId(session.spec.digest, self.catalogue, 1, seed, epoch, index)
        provenance = Provenance(identity, "a.mp4", "7:00", 0, 0, (), _PARAMS, 0, 0, "h264 exact", self.snapshot)
        return encode_sample(
            epoch=epoch,
            index=index,
            arrays=arrays,
            provenance=provenance.to_dict(),
            worker="fake",
            cpu_seconds=0.25,
            slot=NO_SLOT if slot is None else slot.number,
            in_slot=in_slot,
            quarantine=self.snapshot,
        )


def _put(slot: Slot, arrays: dict[str, np.ndarray[Any, Any]], session: _Session) -> bool:
    there = slot_arrays(slot, array_layout(session.spec.recipe, session.spec.voxel_dtype, tuple(arrays)))
    for name, array in arrays.items():
        if there is not None:
            there[name][...] = array
    return there is not None

"""The only file of the server that polls sockets: it carries messages between them and the dispatcher.

Samples pass through as the very frames that arrived; only the small header before them is read. One thread, one loop.

Memory: a consumer asks for more only as it takes what it was sent, so broker bytes <= sum over sessions of credit x
sample bytes (in ZeroMQ's out-queue of a consumer that is slow) + workers x 2 x sample bytes. A peer that asks and never
reads is cut off at MOST_QUEUED messages.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any

import zmq

from v2v_protocol.errors import UsageError
from v2v_protocol.wire import LARGEST_ARRAY_BYTES, LARGEST_HEADER_BYTES
from v2v_server.broker.actions import GiveUp, Instruction, LookFor, Record, ToConsumer, ToWorker
from v2v_server.broker.blame import Loss
from v2v_server.broker.dispatcher import Dispatcher
from v2v_server.broker.quarantine import Verdict

MOST_QUEUED = 512
"""Messages that wait for one peer before it is taken for deaf; above any credit (``admission.MOST_CREDIT``)."""
_TICK_SECONDS = 0.1
_LONGEST_TURN_SECONDS = 1.0
"""Of the loop; what goes beyond is time in which nobody was listened to."""
_KEEPALIVE_SECONDS = 300
# Plain numbers: to combine two flags of an enumeration takes longer than to send a small frame.
_NOBLOCK, _NOBLOCK_MORE = int(zmq.NOBLOCK), int(zmq.NOBLOCK | zmq.SNDMORE)


class Broker:
    """Two ROUTER sockets, one for consumers and one for workers.

    Args:
        bind: address for consumers.
        worker_bind: address for workers.

    Raises:
        UsageError: an address that cannot be bound; the message names the flag.
    """

    def __init__(self, bind: str, worker_bind: str) -> None:
        self._context = zmq.Context()
        try:
            self._consumers = self._router(bind, "--bind", LARGEST_HEADER_BYTES)
            self._workers = self._router(worker_bind, "--worker-bind", LARGEST_ARRAY_BYTES)
        except BaseException:
            self._context.destroy(linger=0)
            raise
        self.address = self._consumers.getsockopt_string(zmq.LAST_ENDPOINT)
        self.worker_address = self._workers.getsockopt_string(zmq.LAST_ENDPOINT)

    def _router(self, address: str, flag: str, largest_bytes: int) -> zmq.Socket[bytes]:
        router = self._context.socket(zmq.ROUTER)
        router.setsockopt(zmq.LINGER, 0)
        # Otherwise IPv4 addresses come back in their IPv6 form, which nobody would recognise.
        router.setsockopt(zmq.IPV6, int("[" in address))
        router.setsockopt(zmq.SNDHWM, MOST_QUEUED)
        router.setsockopt(zmq.RCVHWM, MOST_QUEUED)
        router.setsockopt(zmq.MAXMSGSIZE, largest_bytes)
        # Unroutable messages raise instead of vanishing; a peer that reconnects takes its name back.
        router.setsockopt(zmq.ROUTER_MANDATORY, 1)
        router.setsockopt(zmq.ROUTER_HANDOVER, 1)
        # A host that vanishes (pre-empted, unplugged) says no farewell, and nothing is said to it that would show it:
        # the system asks, or its connection would stay open as long as this process lives.
        router.setsockopt(zmq.TCP_KEEPALIVE, 1)
        router.setsockopt(zmq.TCP_KEEPALIVE_IDLE, _KEEPALIVE_SECONDS)
        try:
            router.bind(address)
        except zmq.ZMQError as error:
            raise UsageError(f"{flag} {address}: {error.strerror or error}") from error
        return router

    def run(
        self,
        dispatcher: Dispatcher,
        *,
        give_up: Callable[[GiveUp], Loss],
        record: Callable[[Record], list[Verdict]],
        look_for: Callable[[LookFor], bool],
        watched: Callable[[bytes], bool],
        every_tick: Callable[[float], list[Instruction]],
        stopping: Callable[[], bool],
    ) -> None:
        """Carries messages until ``stopping``.

        Args:
            dispatcher: decides.
            give_up: ends the process of a worker that hangs, and says what its loss means.
            record: writes a verdict down; returns what the quarantine has more now.
            look_for: whether this host has a video as it was catalogued.
            watched: whether somebody else reports how that worker's process ends, once it has.
            every_tick: called about ten times a second with the time; may return instructions.
            stopping: asked at every turn.
        """
        poller = zmq.Poller()
        poller.register(self._consumers, zmq.POLLIN)
        poller.register(self._workers, zmq.POLLIN)
        clock = _Clock()
        next_tick = clock()

        def carry_out(instructions: list[Instruction]) -> None:
            todo = deque(instructions)
            while todo:
                match todo.popleft():
                    case ToConsumer(identity, frames):
                        if not _send(self._consumers, identity, frames):
                            dispatcher.consumer_lost(identity)
                    case ToWorker(identity, frames):
                        if not _send(self._workers, identity, frames) and not watched(identity):
                            todo.extend(dispatcher.worker_unreachable(identity, clock()))
                    case GiveUp() as hopeless:
                        loss = give_up(hopeless)
                        todo.extend(dispatcher.worker_lost(hopeless.identity, loss, clock()))
                    case Record() as verdict:
                        todo.extendleft(reversed(dispatcher.recorded(verdict, record(verdict), clock())))
                    case LookFor() as missing:
                        todo.extend(dispatcher.looked_for(missing, look_for(missing), clock()))

        while not stopping():
            ready = dict(poller.poll(int(_TICK_SECONDS * 1000)))
            now = clock()
            # One message of each side a turn, so that neither can shut the other out.
            if self._workers in ready and (message := _receive(self._workers)) is not None:
                carry_out(dispatcher.from_worker(*message, now))
            if self._consumers in ready and (message := _receive(self._consumers)) is not None:
                carry_out(dispatcher.from_consumer(*message, now))
            if now >= next_tick:
                next_tick = now + _TICK_SECONDS
                carry_out(dispatcher.tick(now))
                carry_out(every_tick(now))

    def say_farewell(self, instructions: list[Instruction]) -> None:
        """Sends workers what a stopping server still has to say."""
        for instruction in instructions:
            if isinstance(instruction, ToWorker):
                _send(self._workers, instruction.identity, instruction.frames)

    def close(self) -> None:
        """Closes both sockets; what was not sent is dropped."""
        self._context.destroy(linger=0)


class _Clock:
    """Seconds, as far as this process was there to listen.

    While it is stopped (in a terminal, by a batch system, with its whole machine) it hears no answer, and those who owe
    one may be stopped as well: a deadline that runs out meanwhile is nobody's fault.
    """

    def __init__(self) -> None:
        self._seen = time.monotonic()
        self._away = 0.0

    def __call__(self) -> float:
        seen, self._seen = self._seen, time.monotonic()
        self._away += max(0.0, self._seen - seen - _LONGEST_TURN_SECONDS)
        return self._seen - self._away


def _receive(router: zmq.Socket[bytes]) -> tuple[bytes, list[Any]] | None:
    """A message that is there, and who sent it.

    The header is copied out as bytes; what follows stays in ZeroMQ's own frames.
    """
    frames: list[Any] = []
    try:
        identity = frame = router.recv(_NOBLOCK, copy=False)
        while frame.more:  # recv_multipart asks the socket instead, which takes longer
            frame = router.recv(_NOBLOCK, copy=False)
            frames.append(frame if frames else frame.bytes)
    except zmq.Again:
        return None  # a connection that just ended took it along
    return identity.bytes, frames


def _send(router: zmq.Socket[bytes], identity: bytes, frames: Sequence[Any]) -> bool:
    """False when the peer is not connected any more, or does not read what it is sent."""
    try:
        router.send(identity, _NOBLOCK_MORE)
        for frame in frames[:-1]:
            router.send(frame, _NOBLOCK_MORE, copy=False)
        router.send(frames[-1], _NOBLOCK, copy=False)
    except zmq.Again:
        return False
    except zmq.ZMQError as error:
        if error.errno == zmq.EHOSTUNREACH:
            return False
        raise
    return True

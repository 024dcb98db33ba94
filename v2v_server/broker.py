"""The only file of the server that polls sockets: it carries messages between them and the dispatcher.

Samples pass through as the very frames that arrived; only the small header before them is read. One thread, one loop.

Memory: a session's unanswered samples are bounded by its credit, and a worker has at most two samples on the way, so
the queues need no high-water mark of their own: broker bytes <= sum over sessions of credit x sample bytes (in
ZeroMQ's out-queue of a consumer that does not read) + workers x 2 x sample bytes.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any

import zmq

from v2v_protocol.errors import UsageError
from v2v_protocol.wire import LARGEST_ARRAY_BYTES, LARGEST_HEADER_BYTES
from v2v_server.dispatcher import Dispatcher, GiveUp, Instruction, ToConsumer, ToWorker

_BATCH = 64
_TICK_SECONDS = 0.1


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
        self.address = self._consumers.last_endpoint.decode()
        self.worker_address = self._workers.last_endpoint.decode()

    def _router(self, address: str, flag: str, largest_bytes: int) -> zmq.Socket[bytes]:
        router = self._context.socket(zmq.ROUTER)
        router.setsockopt(zmq.LINGER, 0)
        # Otherwise IPv4 addresses come back in their IPv6 form, which nobody would recognise.
        router.setsockopt(zmq.IPV6, int("[" in address))
        router.setsockopt(zmq.SNDHWM, 0)
        router.setsockopt(zmq.RCVHWM, 0)
        router.setsockopt(zmq.MAXMSGSIZE, largest_bytes)
        # Unroutable messages raise instead of vanishing; a peer that reconnects takes its name back.
        router.setsockopt(zmq.ROUTER_MANDATORY, 1)
        router.setsockopt(zmq.ROUTER_HANDOVER, 1)
        try:
            router.bind(address)
        except zmq.ZMQError as error:
            raise UsageError(f"{flag} {address}: {error.strerror or error}") from error
        return router

    def run(
        self,
        dispatcher: Dispatcher,
        *,
        give_up: Callable[[bytes], None],
        every_tick: Callable[[float], list[Instruction]],
        stopping: Callable[[], bool],
    ) -> None:
        """Carries messages until ``stopping``.

        Args:
            dispatcher: decides.
            give_up: ends the process of a worker that hangs.
            every_tick: called about ten times a second with the time; may return instructions.
            stopping: asked at every turn.
        """
        poller = zmq.Poller()
        poller.register(self._consumers, zmq.POLLIN)
        poller.register(self._workers, zmq.POLLIN)
        next_tick = time.monotonic()
        while not stopping():
            ready = dict(poller.poll(_TICK_SECONDS * 1000))
            now = time.monotonic()
            if self._workers in ready:
                for identity, frames in self._drain(self._workers):
                    self._carry_out(dispatcher, dispatcher.from_worker(identity, frames, now), give_up)
            if self._consumers in ready:
                for identity, frames in self._drain(self._consumers):
                    self._carry_out(dispatcher, dispatcher.from_consumer(identity, frames, now), give_up)
            if now >= next_tick:
                next_tick = now + _TICK_SECONDS
                self._carry_out(dispatcher, dispatcher.tick(now), give_up)
                self._carry_out(dispatcher, every_tick(now), give_up)

    def carry_out(self, dispatcher: Dispatcher, instructions: list[Instruction]) -> None:
        """Sends what a stopping server still has to say."""
        self._carry_out(dispatcher, instructions, lambda identity: None)

    def close(self) -> None:
        """Closes both sockets; what was not sent is dropped."""
        self._context.destroy(linger=0)

    def _drain(self, router: zmq.Socket[bytes]) -> list[tuple[bytes, list[Any]]]:
        """Up to one batch of messages that are already there, so that neither side can shut the other out.

        The header is copied out as bytes; what follows stays in ZeroMQ's own frames.
        """
        messages: list[tuple[bytes, list[Any]]] = []
        for _ in range(_BATCH):
            try:
                identity, *frames = router.recv_multipart(zmq.NOBLOCK, copy=False)
            except zmq.Again:
                break
            messages.append((identity.bytes, [*(frame.bytes for frame in frames[:1]), *frames[1:]]))
        return messages

    def _carry_out(
        self, dispatcher: Dispatcher, instructions: list[Instruction], give_up: Callable[[bytes], None]
    ) -> None:
        for instruction in instructions:
            match instruction:
                case ToConsumer(identity, frames):
                    if not _send(self._consumers, identity, frames):
                        dispatcher.consumer_lost(identity)
                case ToWorker(identity, frames):
                    if not _send(self._workers, identity, frames):
                        now = time.monotonic()
                        self._carry_out(dispatcher, dispatcher.worker_lost(identity, None, now), give_up)
                case GiveUp(identity, _):
                    give_up(identity)


def _send(router: zmq.Socket[bytes], identity: bytes, frames: Sequence[Any]) -> bool:
    """False when the peer is not connected any more."""
    try:
        router.send_multipart([identity, *frames], copy=False)
    except zmq.ZMQError as error:
        if error.errno == zmq.EHOSTUNREACH:
            return False
        raise
    return True

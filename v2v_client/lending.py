"""What a consumer lends to the workers of its host: slots of an arena, named in its requests.

Without an arena (the system has none, or it is not wanted) requests name no slots and samples come in messages.
"""

from __future__ import annotations

from collections.abc import Sequence

import zmq

from v2v_client.arena import Arena
from v2v_client.arrival import InMessage, InSlot, Payload
from v2v_client.slots import Answer, Slots
from v2v_protocol.arena import NO_SLOT
from v2v_protocol.messages import SampleHeader, Want
from v2v_protocol.wire import decode_sample


class Lending:
    """The requests of one connection, and where their samples are found.

    Args:
        arena: what to lend of; closed with this. None lends nothing.
    """

    def __init__(self, arena: Arena | None) -> None:
        self._arena = arena
        self._slots = Slots()

    def wants(self, epoch: int, indices: Sequence[int]) -> list[Want]:
        """Requests for samples, each with a slot to put it into.

        One that was asked for before is asked for without: its first worker may be at it still, and has one.
        """
        if self._arena is None:
            return [Want(epoch, tuple(indices))]
        again = tuple(index for index in indices if self._slots.of(index) != NO_SLOT)
        slots = {index: self._slots.take(index) for index in indices if index not in again}
        requests = [Want(epoch, again)] if again else []
        if slots:
            requests.append(Want(epoch, tuple(slots), self._arena.name, tuple(slots.values())))
        return requests

    def payload(self, header: SampleHeader, frames: Sequence[zmq.Frame]) -> Payload | None:
        """Where a sample's arrays are; None where nobody knows: in a slot not named for it, or not any more.

        Raises:
            ProtocolError: the frames are not those that the header describes.
        """
        in_message = bool(frames) or header.slot == NO_SLOT
        arrays = decode_sample(header, [frame.buffer for frame in frames]) if in_message else {}
        slot = self._slots.of(header.index)
        answer = self._slots.answered(header.index, header.slot, in_message=in_message)
        if self._arena is not None:
            if answer is Answer.THERE:
                return InSlot(self._arena, self._slots, slot)
            if answer is Answer.ABANDONED:
                self._arena.free(slot)
        return InMessage(arrays) if in_message else None

    def close(self) -> None:
        """Frees the memory. May be called again."""
        arena, self._arena = self._arena, None
        if arena is not None:
            arena.close()

"""What a consumer lends to the workers of its host: slots, named in its requests.

Where none are offered (the system has no such memory, or it is not wanted) samples come in messages.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import zmq

from v2v_client.memory.slots import Answer, Slots
from v2v_client.session.arrival import Payload
from v2v_protocol.arena import NO_SLOT, Slot
from v2v_protocol.messages import SampleHeader, Want
from v2v_protocol.wire import decode_sample


class Lending:
    """The requests of one connection, and where their samples are found."""

    def __init__(self) -> None:
        self._offered: dict[int, Slot] = {}
        self._slots = Slots()

    def offer(self, slots: Mapping[int, Slot]) -> None:
        """Where samples may come to lie that were never asked for yet, by index."""
        self._offered.update(slots)

    def want(self, epoch: int, indices: Sequence[int]) -> Want:
        """A request for samples, each with the slot that was offered for it.

        One that was asked for before is asked for without: its first worker may be at it still, and has one.
        """
        slots = [self._offered.pop(index, None) for index in indices]
        for index, slot in zip(indices, slots, strict=True):
            if slot is not None:
                self._slots.name(index, slot)
        if not any(slots):
            return Want(epoch, tuple(indices))
        return Want(
            epoch,
            tuple(indices),
            tuple("" if slot is None else slot.arena for slot in slots),
            tuple(NO_SLOT if slot is None else slot.number for slot in slots),
        )

    def payload(self, header: SampleHeader, frames: Sequence[zmq.Frame]) -> Payload | None:
        """Where a sample's arrays are; None where nobody knows: in a slot not named for it, or not any more.

        Raises:
            ProtocolError: the frames are not those that the header describes.
        """
        in_message = bool(frames) or header.slot == NO_SLOT
        arrays = decode_sample(header, [frame.buffer for frame in frames]) if in_message else None
        answer = self._slots.answered(header.index, header.slot, in_message=in_message)
        if answer is Answer.NOWHERE:
            return None
        return Payload(arrays, row_is_ours=answer is not Answer.ABANDONED)

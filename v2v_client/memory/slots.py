"""Track which slot each sample may be written to, and what its arrival means for the slot. Pure.

See :mod:`v2v_protocol.arena`. If no slots are offered (not supported by the system, or disabled), samples arrive in
messages.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from enum import Enum, auto

from v2v_protocol.arena import NO_SLOT, Slot
from v2v_protocol.messages import Want


class Answer(Enum):
    """Say what an arrival means for the slot of its sample."""

    THERE = auto()  # the arrays are in the slot, and no worker writes there any more
    MESSAGE = auto()  # the arrays came in the message, and no worker writes to the slot, if there was one
    ABANDONED = auto()  # the arrays came in the message, but a worker may still write to the slot
    NOWHERE = auto()  # the arrays were written to another sample's slot and cannot be read


class Slots:
    """Track the slots named in the requests of one connection, without their bytes."""

    def __init__(self) -> None:
        self._offered: dict[int, Slot] = {}
        self._named: dict[int, Slot] = {}

    def offer(self, slots: Mapping[int, Slot]) -> None:
        """Offer slots, by index, for samples that were never requested yet."""
        self._offered.update(slots)

    def want(self, epoch: int, indices: Sequence[int]) -> Want:
        """Build a request for samples, each with the slot that was offered for it.

        A repeated request names no slot, because the first worker may still be writing to it.
        """
        slots = [self._offered.pop(index, None) for index in indices]
        self._named.update({index: slot for index, slot in zip(indices, slots, strict=True) if slot is not None})
        if not any(slots):
            return Want(epoch, tuple(indices))
        return Want(
            epoch,
            tuple(indices),
            tuple("" if slot is None else slot.arena for slot in slots),
            tuple(NO_SLOT if slot is None else slot.number for slot in slots),
        )

    def record_arrival(self, index: int, number: int, *, in_message: bool) -> Answer:
        """Record that a sample arrived, and return what that means for its slot.

        Args:
            index: global index of the sample.
            number: slot number in the sample's header.
            in_message: whether the message contained the arrays.
        """
        slot = self._named.get(index)
        returned = slot is not None and number == slot.number
        if not in_message and not returned:
            return Answer.NOWHERE
        self._named.pop(index, None)
        if not in_message:
            return Answer.THERE
        return Answer.MESSAGE if returned or slot is None else Answer.ABANDONED

"""Which slot a sample may come to lie in, and what its arrival means for that (:mod:`v2v_protocol.arena`). Pure.

Where none are offered (the system has no such memory, or it is not wanted) samples come in messages.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from enum import Enum, auto

from v2v_protocol.arena import NO_SLOT, Slot
from v2v_protocol.messages import Want


class Answer(Enum):
    """What an arrival means for the slot of its sample."""

    THERE = auto()  # the arrays lie in it, and nobody writes there any more
    MESSAGE = auto()  # the arrays came in the message, and nobody writes to the slot, if there was one
    ABANDONED = auto()  # the same, but a worker may still write to the slot
    NOWHERE = auto()  # the arrays were put into a slot that is not this sample's: nobody can read them


class Slots:
    """Keeps account of the slots that the requests of one connection name, not of their bytes."""

    def __init__(self) -> None:
        self._offered: dict[int, Slot] = {}
        self._named: dict[int, Slot] = {}

    def offer(self, slots: Mapping[int, Slot]) -> None:
        """Where samples may come to lie that were never asked for yet, by index."""
        self._offered.update(slots)

    def want(self, epoch: int, indices: Sequence[int]) -> Want:
        """A request for samples, each with the slot that was offered for it.

        One that was asked for before is asked for without: its first worker may be at it still, and has one.
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
        """A sample arrived.

        Args:
            index: which.
            number: of the slot that its header names.
            in_message: whether the arrays came with it.
        """
        slot = self._named.get(index)
        returned = slot is not None and number == slot.number
        if not in_message and not returned:
            return Answer.NOWHERE
        self._named.pop(index, None)
        if not in_message:
            return Answer.THERE
        return Answer.MESSAGE if returned or slot is None else Answer.ABANDONED

"""Which slot a sample may come to lie in, and what its arrival means for that (:mod:`v2v_protocol.arena`). Pure."""

from __future__ import annotations

from enum import Enum, auto

from v2v_protocol.arena import Slot


class Answer(Enum):
    """What an arrival means for the slot of its sample."""

    THERE = auto()  # the arrays lie in it, and nobody writes there any more
    MESSAGE = auto()  # the arrays came in the message, and nobody writes to the slot, if there was one
    ABANDONED = auto()  # the same, but a worker may still write to the slot
    NOWHERE = auto()  # the arrays were put into a slot that is not this sample's: nobody can read them


class Slots:
    """Keeps account of the slots that were named for samples, not of their bytes."""

    def __init__(self) -> None:
        self._of: dict[int, Slot] = {}

    def of(self, index: int) -> Slot | None:
        """The slot that this sample may come to lie in."""
        return self._of.get(index)

    def name(self, index: int, slot: Slot) -> None:
        """A slot is named for a sample that has none.

        Not to be called for a sample that is asked for again: its first worker may be at it still, with its first slot.
        """
        self._of[index] = slot

    def answered(self, index: int, named: int, *, in_message: bool) -> Answer:
        """A sample arrived.

        Args:
            index: which.
            named: number of the slot that its header names.
            in_message: whether the arrays came with it.
        """
        slot = self.of(index)
        returned = slot is not None and named == slot.number
        if not in_message and not returned:
            return Answer.NOWHERE
        self._of.pop(index, None)
        if not in_message:
            return Answer.THERE
        return Answer.MESSAGE if returned or slot is None else Answer.ABANDONED

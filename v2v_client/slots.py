"""Which slot a sample may come to lie in, and when a slot may be used again (:mod:`v2v_protocol.arena`). Pure."""

from __future__ import annotations

from enum import Enum, auto

from v2v_protocol.arena import NO_SLOT


class Answer(Enum):
    """What an arrival means for the slot of its sample."""

    THERE = auto()  # the arrays lie in it; it is to be given back once they were read
    MESSAGE = auto()  # the arrays came in the message, and the slot, if there was one, is free again
    ABANDONED = auto()  # the same, but a worker may still write to it: never used again
    NOWHERE = auto()  # the arrays were put into a slot that is not this sample's: nobody can read them


class Slots:
    """Keeps account of the slots of one arena, not of their bytes."""

    def __init__(self) -> None:
        self._free: list[int] = []
        self._next = 1
        self._of: dict[int, int] = {}

    def of(self, index: int) -> int:
        """The slot that this sample may come to lie in; NO_SLOT for none."""
        return self._of.get(index, NO_SLOT)

    def take(self, index: int) -> int:
        """A slot for a sample that has none: the one used last, which is still in the processor's cache.

        Not to be called for a sample that is asked for again: its first worker may be at it still, with its first slot.
        """
        if self._free:
            slot = self._free.pop()
        else:
            slot, self._next = self._next, self._next + 1
        self._of[index] = slot
        return slot

    def answered(self, index: int, named: int, *, in_message: bool) -> Answer:
        """A sample arrived.

        Args:
            index: which.
            named: the slot that its header names.
            in_message: whether the arrays came with it.
        """
        slot = self.of(index)
        returned = slot != NO_SLOT and named == slot
        if not in_message and not returned:
            return Answer.NOWHERE
        self._of.pop(index, None)
        if not in_message:
            return Answer.THERE
        if returned:
            self.give_back(slot)
        return Answer.MESSAGE if returned or slot == NO_SLOT else Answer.ABANDONED

    def give_back(self, slot: int) -> None:
        """Nobody writes to it any more, and what was in it was read."""
        self._free.append(slot)

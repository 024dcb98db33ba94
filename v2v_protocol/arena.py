"""Names for memory that a consumer shares with the workers of its own host. Pure: who opens it is elsewhere.

A consumer keeps an *arena*, an anonymous file in memory (memfd_create(2)), for each batch that it fills, and names a
*slot* of it, the batch's row, with each sample it asks for. A worker that can open the arena makes the sample there and
sends the header alone; one that cannot, on another host or as another user, sends the arrays in the message. Who asks
cannot know which, and need not.

Whether an arena may be used again is the whole difficulty: a worker that was given up may wake and write. So

    the server hands a slot to one worker only: not to a second one, nor to the next after the first was lost;
    a header that names the slot says that its worker writes there no more;
    a consumer uses an arena for another batch only when such a header came for every slot that it had named.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Sequence
from dataclasses import dataclass

from v2v_protocol.errors import ProtocolError

NO_SLOT = 0
MOST_SLOTS = 65_536
_PAGE_BYTES = 4096
_NAME = re.compile(r"(\d{1,10}):(\d{1,10}):(\d{1,10}):([0-9a-f]{32})")


@dataclass(frozen=True, slots=True)
class ArenaName:
    """How a worker of the same host finds an arena, and knows that it found it.

    Attributes:
        pid: process of the consumer.
        descriptor: of the arena, in that process.
        slots: how many samples it holds.
        token: 32 hexadecimal digits that nobody else has; part of the name that the system knows the memory by.
    """

    pid: int
    descriptor: int
    slots: int
    token: str

    def __str__(self) -> str:
        return f"{self.pid}:{self.descriptor}:{self.slots}:{self.token}"

    @classmethod
    def parse(cls, text: str) -> ArenaName:
        """The name back from its text.

        Raises:
            ProtocolError: it is none.
        """
        match = _NAME.fullmatch(text)
        if match is None or not 0 < int(match[3]) <= MOST_SLOTS:
            raise ProtocolError(f"{text!r:.80} does not name an arena")
        return cls(int(match[1]), int(match[2]), int(match[3]), match[4])

    @property
    def path(self) -> str:
        """Where Linux lets processes of the same user and process namespace open it."""
        return f"/proc/{self.pid}/fd/{self.descriptor}"

    @property
    def memory_name(self) -> str:
        """What the memory is called; what ``path`` links to is made of it."""
        return f"v2v-{self.token}"

    @property
    def link(self) -> str:
        """What ``path`` links to while it is this arena's."""
        return f"/memfd:{self.memory_name} (deleted)"


@dataclass(frozen=True, slots=True)
class Slot:
    """A place for one sample.

    Attributes:
        arena: text of the :class:`ArenaName`.
        number: from 1.
    """

    arena: str
    number: int


def array_offsets(sizes: Sequence[int], slots: int) -> list[int]:
    """Where in an arena each array of a whole batch begins, and after them, where the arena ends: whole pages.

    Args:
        sizes: bytes of each array of one sample, in the order of the headers.
        slots: of the arena.
    """
    pages = (-(-size * slots // _PAGE_BYTES) for size in sizes)
    return [_PAGE_BYTES * before for before in itertools.accumulate(pages, initial=0)]

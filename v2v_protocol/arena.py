"""Name the memory that a consumer shares with the workers of its own host. Pure: opening it is done elsewhere.

A consumer keeps an *arena*, an anonymous file in memory (memfd_create(2)), for each batch that it fills. With each
sample that it requests it names a *slot* of the arena, the batch's row. A worker that can open the arena makes the
sample there and sends only the header. A worker on another host or of another user sends the arrays in the message. The
consumer does not need to know which it is.

An arena must not be reused too early: a worker that was given up may resume and write. So

    the server gives a slot to one worker only: not to a second one, nor to the next after the first was lost;
    a header that names the slot states that its worker no longer writes there;
    a consumer reuses an arena for another batch only when such a header has come for every slot that it named.
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
    """Information by which a worker on the same host finds an arena and verifies it.

    Attributes:
        pid: process id of the consumer.
        descriptor: file descriptor of the arena in that process.
        slots: number of samples that it holds.
        token: 32 random hexadecimal digits; part of the name under which the system knows the memory.
    """

    pid: int
    descriptor: int
    slots: int
    token: str

    def __str__(self) -> str:
        return f"{self.pid}:{self.descriptor}:{self.slots}:{self.token}"

    @classmethod
    def parse(cls, text: str) -> ArenaName:
        """Parse the text of an arena name.

        Raises:
            ProtocolError: the text does not name an arena.
        """
        match = _NAME.fullmatch(text)
        if match is None or not 0 < int(match[3]) <= MOST_SLOTS:
            raise ProtocolError(f"{text!r:.80} does not name an arena")
        return cls(int(match[1]), int(match[2]), int(match[3]), match[4])

    @property
    def path(self) -> str:
        """Path under which Linux lets processes of the same user and process namespace open it."""
        return f"/proc/{self.pid}/fd/{self.descriptor}"

    @property
    def memory_name(self) -> str:
        """Name of the memory, from which the target of ``path`` is derived."""
        return f"v2v-{self.token}"

    @property
    def link(self) -> str:
        """Target of the symbolic link ``path`` while the arena exists."""
        return f"/memfd:{self.memory_name} (deleted)"


@dataclass(frozen=True, slots=True)
class Slot:
    """Memory for one sample.

    Attributes:
        arena: text of the :class:`ArenaName`.
        number: from 1.
    """

    arena: str
    number: int


def array_offsets(sizes: Sequence[int], slots: int) -> list[int]:
    """Return the offset in an arena of each array of a whole batch, then the size of the arena: whole pages, in bytes.

    Args:
        sizes: bytes of each array of one sample, in the order of the headers.
        slots: number of slots of the arena.
    """
    pages = (-(-size * slots // _PAGE_BYTES) for size in sizes)
    return [_PAGE_BYTES * before for before in itertools.accumulate(pages, initial=0)]

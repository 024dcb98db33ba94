"""One sample on its way from the wire into a row of a batch."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import numpy.typing as npt

from v2v_client.arena import Arena
from v2v_client.slots import Slots
from v2v_protocol.sample import Provenance

Rows = Mapping[str, npt.NDArray[Any]]


class Payload(Protocol):
    """Where the arrays of a sample are. One of the two is to be called, once."""

    def copy_to(self, rows: Rows) -> None:
        """Copies every array into the row of its name: the one copy between the wire and the trainer."""

    def drop(self) -> None:
        """Does without them."""


@dataclass(frozen=True, slots=True)
class InMessage:
    """They came with the header: read-only views of the received message, by name."""

    arrays: Rows

    def copy_to(self, rows: Rows) -> None:
        """See :class:`Payload`."""
        for name, array in self.arrays.items():
            rows[name][...] = array

    def drop(self) -> None:
        """See :class:`Payload`."""


@dataclass(frozen=True, slots=True)
class InSlot:
    """A worker of this host put them into our memory."""

    arena: Arena
    slots: Slots
    slot: int

    def copy_to(self, rows: Rows) -> None:
        """See :class:`Payload`.

        Raises:
            ProtocolError: the slot holds less than a sample.
        """
        self.arena.read(self.slot, rows)
        self.slots.give_back(self.slot)

    def drop(self) -> None:
        """See :class:`Payload`."""
        self.slots.give_back(self.slot)


@dataclass(frozen=True, slots=True)
class Arrival:
    """One sample.

    Attributes:
        index: global index.
        payload: its arrays.
        provenance: where it came from.
        worker: name of the server worker that made it.
        cpu_seconds: processor time that took there.
        decoded: whether a clip was decoded for it.
    """

    index: int
    payload: Payload
    provenance: Provenance
    worker: str
    cpu_seconds: float
    decoded: bool

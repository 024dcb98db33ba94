"""One sample on its way from the wire into a row of a batch."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy.typing as npt


@dataclass(frozen=True, slots=True)
class Payload:
    """Where the arrays of a sample are.

    Attributes:
        arrays: read-only views of the received message, by name; None where a worker put them into their row.
        row_is_ours: whether no worker writes to that row any more.
    """

    arrays: Mapping[str, npt.NDArray[Any]] | None
    row_is_ours: bool = True


@dataclass(frozen=True, slots=True)
class Arrival:
    """One sample.

    Attributes:
        index: global index.
        payload: its arrays.
        provenance: where it came from, see :meth:`v2v_client.connection.Connection.provenance`.
        worker: name of the server worker that made it.
        cpu_seconds: processor time that took there.
        decoded: whether a clip was decoded for it.
    """

    index: int
    payload: Payload
    provenance: bytes
    worker: str
    cpu_seconds: float
    decoded: bool

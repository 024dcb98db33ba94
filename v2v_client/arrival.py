"""One sample on its way from the wire into a row of a batch."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy.typing as npt

from v2v_protocol.messages import SampleHeader


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
        header: what is said of it; its provenance is opened by :meth:`v2v_client.connection.Connection.provenance`.
        payload: its arrays.
    """

    header: SampleHeader
    payload: Payload

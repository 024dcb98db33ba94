"""One sample on its way from the wire into a row of a batch."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy.typing as npt

from v2v_protocol.errors import ProtocolError
from v2v_protocol.messages import SampleHeader
from v2v_protocol.sample import Provenance, SampleId
from v2v_protocol.wire import decode_map


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
        header: what is said of it; its provenance is opened by
        :meth:`v2v_client.session.connection.Connection.provenance`.
        payload: its arrays.
    """

    header: SampleHeader
    payload: Payload


def opened_provenance(header: SampleHeader, identity: SampleId, sender: str) -> Provenance:
    """Where a sample came from.

    Args:
        header: of the sample.
        identity: what was asked for.
        sender: of the header, for the message of an error.

    Raises:
        ProtocolError: it is the provenance of another sample, or none.
    """
    provenance = Provenance.from_dict(decode_map(header.provenance))
    if provenance.id != identity:
        raise ProtocolError(f"{sender} sent {provenance.id} in answer to {identity}")
    if type(provenance.quarantine) is not int or provenance.quarantine != header.quarantine:
        raise ProtocolError(
            f"{sender} sent sample {header.index} of epoch {header.epoch} as made under quarantine snapshot "
            f"{header.quarantine}, and its provenance names {provenance.quarantine!r:.40}"
        )
    return provenance

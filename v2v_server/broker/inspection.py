"""Inspection: whether a worker's result is what its lease asked for, before it is passed on. Pure.

A consumer trusts its server; the server does not trust a worker, which may be another version, broken or hostile. The
small header is read; the arrays are only measured, and not even that where they lie in a slot of the consumer's.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from v2v_protocol.arena import NO_SLOT
from v2v_protocol.errors import ProtocolError
from v2v_protocol.messages import SampleHeader
from v2v_protocol.sample import Form
from v2v_protocol.wire import decode
from v2v_server.broker.leases import Task


def inspected(payload: Sequence[Any], task: Task, form: Form) -> SampleHeader:
    """The header of a sample that its consumer will be able to read.

    Args:
        payload: the frames behind the worker's Result: a whole SampleHeader message.
        task: what was asked.
        form: of the sample.

    Raises:
        ProtocolError: it must not be passed on.
    """
    if not payload:
        raise ProtocolError("nothing follows it")
    header = decode(bytes(payload[0]))
    if not isinstance(header, SampleHeader) or (header.epoch, header.index) != (task.epoch, task.index):
        raise ProtocolError("its header is that of another sample, or of none")
    if (header.names, header.dtypes) != (form.names, form.dtypes):
        raise ProtocolError(f"it has {list(header.names)!r:.100} of {list(header.dtypes)!r:.100}")
    if header.quarantine != task.snapshot:
        raise ProtocolError(f"it was made under quarantine snapshot {header.quarantine}, not {task.snapshot}")
    slot = NO_SLOT if task.slot is None else task.slot.number
    if header.slot != slot:
        raise ProtocolError(f"it names slot {header.slot}, slot {slot} was lent")
    in_slot = slot != NO_SLOT and len(payload) == 1
    if header.shapes != form.shapes or not (in_slot or tuple(map(len, payload[1:])) == form.sizes):
        raise ProtocolError("its arrays have other shapes or sizes than were asked")
    return header

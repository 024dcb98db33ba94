"""Inspection: whether a worker's result is what its lease asked for, before it is passed on. Pure.

A consumer trusts its server; the server does not trust a worker, which may be another version, broken or hostile. The
small header is read; the arrays are only measured, and not even that where they lie in a slot of the consumer's.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from v2v_protocol.arena import NO_SLOT
from v2v_protocol.errors import ProtocolError
from v2v_protocol.messages import Result, SampleHeader
from v2v_protocol.sample import Form
from v2v_protocol.wire import decode
from v2v_server.leases import Task


def flaw(result: Result, payload: Sequence[Any], task: Task, form: Form) -> str | None:
    """Why a result must not be passed on; None when its consumer will be able to read it.

    Args:
        result: what the worker says it is.
        payload: the frames behind it: a whole SampleHeader message.
        task: what was asked.
        form: of the sample.
    """
    if result.index != task.index:
        return f"it answers index {result.index}, index {task.index} was asked"
    if not payload:
        return "nothing follows it"
    try:
        header = decode(bytes(payload[0]))
    except ProtocolError as error:
        return str(error)
    if not isinstance(header, SampleHeader) or (header.epoch, header.index) != (task.epoch, task.index):
        return "its header is that of another sample, or of none"
    if (header.names, header.dtypes) != (form.names, form.dtypes):
        return f"it has {list(header.names)!r:.100} of {list(header.dtypes)!r:.100}"
    slot = NO_SLOT if task.slot is None else task.slot.number
    if header.slot != slot:
        return f"it names slot {header.slot}, slot {slot} was lent"
    in_slot = slot != NO_SLOT and len(payload) == 1
    if header.shapes != form.shapes or not (in_slot or tuple(map(len, payload[1:])) == form.sizes):
        return "its arrays have other shapes or sizes than were asked"
    return None

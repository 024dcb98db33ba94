"""Inspection: whether a worker's result is what its lease asked for, before it is passed on. Pure.

A consumer trusts its server; the server does not trust a worker, which may be another version, broken or hostile. The
small header is read; the arrays are only measured, and not even that where they lie in a slot of the consumer's.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from v2v_protocol.arena import NO_SLOT
from v2v_protocol.errors import ProtocolError
from v2v_protocol.messages import Result, SampleHeader
from v2v_protocol.sample import layout_bytes
from v2v_protocol.wire import decode
from v2v_server.leases import Task


def flaw(
    result: Result, payload: Sequence[Any], task: Task, layout: Mapping[str, tuple[str, tuple[int, ...]]]
) -> str | None:
    """Why a result must not be passed on; None when its consumer will be able to read it.

    Args:
        result: what the worker says it is.
        payload: the frames behind it: a whole SampleHeader message.
        task: what was asked.
        layout: dtype and shape of each asked array (``array_layout``).
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
    if header.names != tuple(layout) or header.dtypes != tuple(dtype for dtype, _ in layout.values()):
        return f"it has {list(header.names)!r:.100} of {list(header.dtypes)!r:.100}"
    slot = NO_SLOT if task.slot is None else task.slot.number
    if header.slot != slot:
        return f"it names slot {header.slot}, slot {slot} was lent"
    shapes = [extent for _, shape in layout.values() for extent in (len(shape), *shape)]
    sizes = [layout_bytes({name: layout[name]}) for name in layout]
    in_slot = slot != NO_SLOT and len(payload) == 1
    if list(header.shapes) != shapes or not (in_slot or [len(frame) for frame in payload[1:]] == sizes):
        return "its arrays have other shapes or sizes than were asked"
    return None

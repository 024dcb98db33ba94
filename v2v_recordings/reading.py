"""Read a recording of any form: its form is found, its size checked, and its events are on one clock.

Events may be out of order: sensors send rows and packets late. A clock that is set back looks similar at first. The
difference is how it ends. Late events end with a jump back to where the time was; after a reset, the time goes on from
where it is.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from v2v_protocol.errors import UsageError
from v2v_recordings.forms import FORMS, recognise
from v2v_recordings.items import ConvertOptions, EventChunk, FlowField, Item, Note, Picture, Progress, SensorSize

LATE_NS = 10_000_000
"""Events that are earlier than others before them by at most this are late in any case."""
MOST_LATE_EVENTS = 1 << 17
"""A longer run of earlier events is no late packet."""
GAP_NS = 1000
"""Time that stands for the unknown one between the last event before a reset and the first one after it."""


def read_items(
    path: Path, form: str | None, options: ConvertOptions, progress: Progress = lambda _done, _total: None
) -> Iterator[Item]:
    """Yield the items of a recording.

    Args:
        path: file or folder.
        form: key of FORMS; None recognises it.

    Raises:
        UsageError: the recording is missing, damaged or of an unknown form; its sensor is too large; its clock is reset
            and it has pictures.
    """
    clock = _Clock(path)
    for item in FORMS[form or recognise(path)].read(path, options, progress):
        if isinstance(item, EventChunk):
            yield from clock.pass_on(item)
            continue
        if isinstance(item, SensorSize):
            item.require_usable(str(path))
        elif isinstance(item, Picture):
            SensorSize(*item.pixels.shape[::-1]).require_usable(str(path))
        clock.check(isinstance(item, (Picture, FlowField)))
        yield item
    yield from clock.pass_on(None)


class _Clock:
    """Put events after a reset of the sensor's clock behind those before it, and say so."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._newest_ns: int | None = None
        self._offset_ns = 0
        self._passed = 0
        self._early: EventChunk | None = None
        self._has_others, self._reset = False, ""

    def check(self, is_timed: bool) -> None:
        """Check that pictures and fields, which have times too, do not meet a reset."""
        self._has_others |= is_timed
        if self._has_others and self._reset:
            raise UsageError(
                f"{self._path}: {self._reset}, and which of its pictures are on which clock is not known: split the "
                "recording there"
            )

    def pass_on(self, chunk: EventChunk | None) -> Iterator[Item]:
        """Yield what is certain once these events are known; None ends the recording."""
        rest = _joined([self._early, None if chunk is None else _later(chunk, self._offset_ns)])
        self._early = None
        while len(rest):
            newest = np.maximum.accumulate(rest.t_ns)
            if self._newest_ns is not None:
                newest = np.maximum(newest, self._newest_ns)
            is_early = rest.t_ns < newest - LATE_NS
            first = int(is_early.argmax()) if is_early.any() else len(rest)
            self._newest_ns = int(newest[min(first, len(rest) - 1)])
            yield from self._counted(rest.part(0, first))
            rest = rest.part(first)
            if not len(rest):
                return
            is_back = rest.t_ns >= self._newest_ns - LATE_NS
            end = int(is_back.argmax()) if is_back.any() else len(rest)
            if end == len(rest) <= MOST_LATE_EVENTS and chunk is not None:
                self._early = rest
                return
            step_ns = self._newest_ns - int(rest.t_ns[0])
            if end < len(rest) and end <= MOST_LATE_EVENTS and rest.t_ns[end] - rest.t_ns[end - 1] > step_ns // 4:
                yield from self._counted(rest.part(0, end))
                rest = rest.part(end)
                continue
            self._reset = f"at event {self._passed} the times step back by {step_ns * 1e-9:.6g} s: the clock was reset"
            self.check(False)
            yield Note(f"{self._reset}; a gap of unknown length, after which the events follow those before it")
            self._offset_ns += step_ns + GAP_NS
            rest = _later(rest, step_ns + GAP_NS)

    def _counted(self, chunk: EventChunk) -> Iterator[Item]:
        self._passed += len(chunk)
        if len(chunk):
            yield chunk


def _joined(chunks: list[EventChunk | None]) -> EventChunk:
    found = [chunk for chunk in chunks if chunk is not None] or [EventChunk(*np.zeros((4, 0), np.int64))]
    if len(found) == 1:
        return found[0]
    return EventChunk(*(np.concatenate([getattr(chunk, name) for chunk in found]) for name in ("t_ns", "x", "y", "p")))


def _later(chunk: EventChunk, ns: int) -> EventChunk:
    return dataclasses.replace(chunk, t_ns=chunk.t_ns + ns) if ns else chunk

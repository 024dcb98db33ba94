"""Write a recording from the items of any reader, in one pass, with bounded memory: what all such files need.

Events pass through a buffer of FLUSH_EVENTS + REORDER_EVENTS, which sorts events that arrive slightly late. The file
has a temporary name until it is complete.
"""

from __future__ import annotations

import contextlib
from abc import ABC, abstractmethod
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import ClassVar, Self

import numpy as np

from v2v_protocol.errors import UsageError, system_errors
from v2v_protocol.write_aside import write_aside_and_rename
from v2v_recordings.items import EventChunk, FlowField, Item, Light, Note, Picture, SensorSize

FLUSH_EVENTS = 1 << 19
REORDER_EVENTS = 1 << 17


@dataclass(frozen=True)
class Written:
    """Report the content of the written file.

    Attributes:
        events, images: their numbers.
        first_seconds, seconds: time of the first event, and from it to the last one.
        reordered_events: number of events that came earlier in time than their predecessor.
        backward_images: number of pictures whose time is not later than their predecessor's; they are not changed.
        size: size of the sensor.
        size_is_guessed: True if the recording does not state the size, so that it is the smallest one that holds all
            events.
        notes: sentences of the reader for the user.
        light: of the pictures, by its name; "": not known.
    """

    events: int
    images: int
    first_seconds: float
    seconds: float
    reordered_events: int
    backward_images: int
    size: SensorSize
    size_is_guessed: bool
    notes: tuple[str, ...]
    light: str = ""


class ItemWriter(ABC):
    """Write a recording inside a ``with`` block. A normal exit completes the file, an exception removes it.

    Args:
        path: file to write.
        source: name of the recording, for messages.
        size: size of the sensor; None takes the size that the recording states, or that of the pictures, or the
            smallest that holds all events.
        origin_ns: the time that becomes 0; such a recording may be without events. None: that of the first item, and
            a recording needs events.

    Attributes:
        written: what was written, once it is complete.

    Raises:
        UsageError: the folder cannot be written to.
        OSError: in the methods: the file cannot be written further.
    """

    end_px: ClassVar[int]
    """Coordinates of events are below this."""

    def __init__(
        self, path: Path, *, source: str, size: SensorSize | None = None, origin_ns: int | None = None
    ) -> None:
        self._files = contextlib.ExitStack()
        self._source, self._size, self._origin_ns = source, size, origin_ns
        self._may_be_empty = origin_ns is not None
        self._pending: list[EventChunk] = []
        self._pending_events = self._events = self._reordered = 0
        self._span_ns: tuple[int, int] | None = None
        self._largest = SensorSize(0, 0)
        self._notes: list[str] = []
        self._light: Light | None = None
        self._picture_size: SensorSize | None = None
        self._picture_times: list[int] = []
        self.written: Written | None = None
        with system_errors(UsageError, f"{path}: cannot be written"):
            path.parent.mkdir(parents=True, exist_ok=True)
            self._open(self._files.enter_context(write_aside_and_rename(path, durable=True)))

    @abstractmethod
    def _open(self, path: Path) -> None:
        """Open the file; what it needs is left to ``self._files``."""

    @abstractmethod
    def _write_events(self, events: EventChunk) -> None:
        """Write the next events, at least one, in order of time; 0 is the origin."""

    @abstractmethod
    def _write_picture(self, picture: Picture, t_ns: int) -> None:
        """Write a picture; ``t_ns`` since the origin."""

    @abstractmethod
    def _write_flow(self, field: FlowField, t_ns: int) -> None:
        """Write a field of true flow; ``t_ns`` since the origin."""

    @abstractmethod
    def _finish(self, written: Written) -> None:
        """Complete the file."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is not None:
            self._files.__exit__(kind, error, trace)
            return
        with self._files:
            if self._pending:
                self._flush(keep=0)
            written = self._report()
            self._finish(written)
        self.written = written

    def add(self, item: Item) -> None:
        """Add the next item of the recording.

        Raises:
            UsageError: events are further out of order than the buffer can sort, or outside the sensor; pictures or
                fields have different sizes; or the recording's size differs from the user's.
        """
        if isinstance(item, SensorSize):
            if self._size is not None and self._size != item:
                raise UsageError(
                    f"{self._source} states a sensor of {item.width} x {item.height}, not "
                    f"{self._size.width} x {self._size.height}"
                )
            self._size = item
        elif isinstance(item, Note):
            self._notes.append(item.text)
        elif isinstance(item, Light):
            self._light = item
        elif isinstance(item, Picture):
            self._check_size(item.pixels.shape)
            self._write_picture(item, self.since_origin(item.t_ns))
            self._picture_times.append(item.t_ns)
        elif isinstance(item, FlowField):
            self._check_size(item.flow.shape[1:])
            self._write_flow(item, self.since_origin(item.t_ns))
        elif len(item):
            self.since_origin(int(item.t_ns[0]))
            self._pending.append(item)
            self._pending_events += len(item)
            if self._pending_events >= FLUSH_EVENTS + REORDER_EVENTS:
                self._flush(keep=REORDER_EVENTS)

    def since_origin(self, t_ns: int) -> int:
        """Return the time since the origin, which is the time of the first item of any kind unless it was stated."""
        if self._origin_ns is None:
            self._origin_ns = t_ns
        return t_ns - self._origin_ns

    def _check_size(self, shape: tuple[int, ...]) -> None:
        size = SensorSize(*shape[::-1])
        if self._picture_size not in (None, size):
            raise UsageError(f"{self._source}: pictures of different sizes, {self._picture_size} and {size}")
        self._picture_size = size

    def _flush(self, keep: int) -> None:
        """Write all pending events except the last ``keep``."""
        events = EventChunk.join(self._pending)
        if backward := int(np.count_nonzero(np.diff(events.t_ns) < 0)):
            events = events.take(np.argsort(events.t_ns, kind="stable"))
        first_ns, last_ns = self._span_ns or (int(events.t_ns[0]),) * 2
        if events.t_ns[0] < last_ns:
            raise UsageError(
                f"{self._source}: near event {self._events} the time goes back by "
                f"{(last_ns - events.t_ns[0]) * 1e-9:.6f} s over more than {REORDER_EVENTS} events; sort the "
                "recording, or split it there"
            )
        self._reordered += backward
        count = len(events) - keep
        self._append(events.part(0, count))
        self._span_ns = first_ns, int(events.t_ns[count - 1])
        # A copy: a view would keep the whole buffer alive.
        self._pending, self._pending_events = [events.take(np.arange(count, len(events)))], keep

    def _append(self, events: EventChunk) -> None:
        x, y = events.x, events.y
        if min(x.min(), y.min()) < 0 or max(x.max(), y.max()) >= self.end_px:
            raise UsageError(
                f"{self._source}: events at x {x.min()} .. {x.max()}, y {y.min()} .. {y.max()}; coordinates must be "
                f"from 0 to {self.end_px - 1}"
            )
        self._largest = SensorSize(
            max(self._largest.width, int(x.max()) + 1), max(self._largest.height, int(y.max()) + 1)
        )
        self._write_events(EventChunk(events.t_ns - (self._origin_ns or 0), x, y, events.p))
        self._events += len(events)

    def _report(self) -> Written:
        if self._origin_ns is None or not (self._events or self._may_be_empty):
            raise UsageError(f"{self._source} has no events")
        size = self._size or self._picture_size or self._largest.require_usable(self._source)
        if self._picture_size not in (None, size):
            raise UsageError(f"{self._source}: pictures are {self._picture_size}, the sensor is {size}")
        if self._largest.width > size.width or self._largest.height > size.height:
            raise UsageError(
                f"{self._source}: events reach x = {self._largest.width - 1}, y = {self._largest.height - 1}, outside "
                f"of the sensor of {size.width} x {size.height}"
            )
        first, last = ((t_ns - self._origin_ns) * 1e-9 for t_ns in self._span_ns or (self._origin_ns,) * 2)
        return Written(
            events=self._events,
            images=len(self._picture_times),
            first_seconds=first,
            seconds=last - first,
            reordered_events=self._reordered,
            backward_images=int(np.count_nonzero(np.diff(self._picture_times) <= 0)),
            size=size,
            size_is_guessed=self._size is None and self._picture_size is None,
            notes=tuple(self._notes),
            light="" if self._light is None else self._light.name,
        )

"""Write the h5 layout in one pass, with bounded memory.

Events pass through a buffer of FLUSH_EVENTS + REORDER_EVENTS, which sorts events that arrive slightly late. Only the
times of pictures are kept in memory. The event of each picture is found at the end, in one pass over the event times on
disk, so pictures may come before or after their events.

    event_idx = number of events earlier than the picture     (events[event_idx] is the first one at its time or later)

The file has a temporary name until it is complete.
"""

from __future__ import annotations

import contextlib
import io
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

import h5py
import numpy as np
import numpy.typing as npt

from v2v_protocol.errors import UsageError
from v2v_protocol.write_aside import write_aside_and_rename
from v2v_recordings import layout
from v2v_recordings.items import EventChunk, FlowField, Item, Light, Note, Picture, SensorSize

FLUSH_EVENTS = 1 << 19
REORDER_EVENTS = 1 << 17
H5_CHUNK = 1 << 16
_COLUMNS = {"ts": np.float64, "xs": np.uint16, "ys": np.uint16, "ps": np.bool_}


@dataclass(frozen=True)
class Written:
    """Report the content of the written file.

    Attributes:
        events, images: their numbers.
        seconds: time from the first to the last event.
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
    seconds: float
    reordered_events: int
    backward_images: int
    size: SensorSize
    size_is_guessed: bool
    notes: tuple[str, ...]
    light: str = ""


class _Disk(io.FileIO):
    """A file that keeps the first error of a write, for :meth:`check`, and drops what is written later.

    HDF5 keeps what it could not write and tries again when its objects are freed, which ends the process by a signal.
    """

    error: OSError | None = None

    def write(self, data: Any) -> int:
        rest = memoryview(data).cast("B")
        try:
            while rest and self.error is None:
                rest = rest[super().write(rest) or 0 :]
        except OSError as error:
            self.error = error
        return len(data)

    def truncate(self, size: int | None = None) -> int:
        try:
            return super().truncate(size)
        except OSError as error:
            self.error = self.error or error
            return size or 0

    def check(self) -> None:
        if self.error is not None:
            raise self.error


@contextlib.contextmanager
def open_new(path: Path) -> Iterator[tuple[h5py.File, _Disk]]:
    """Open a new HDF5 file until the end of the block, and its :class:`_Disk`, to be checked while it is written.

    Raises:
        OSError: it cannot be created, or, at the end, not all of it could be written.
    """
    with _Disk(path, "w+") as disk:
        try:
            with h5py.File(disk, "w") as file:
                yield file, disk
        finally:
            disk.check()  # what could not be written cannot be read back either


def append(dataset: h5py.Dataset, values: npt.NDArray[Any]) -> None:
    """Append values, [n], to a dataset, [N]."""
    dataset.resize(len(dataset) + len(values), axis=0)
    dataset[len(dataset) - len(values) :] = values


class RecordingWriter:
    """Write a recording inside a ``with`` block. A normal exit completes the file, an exception removes it.

    Args:
        path: file to write.
        source: value of the root attribute ``data_source``.
        size: size of the sensor; None takes the size that the recording states, or that of the pictures, or the
            smallest that holds all events.
        published_shift: how many events earlier than ``event_idx`` the published conversion of this raw form pairs a
            picture with. If it is not 0, its choice is also written (``event_idx_published``).
        pack_events: whether to compress events, to about half of their size. It takes most of the time of writing.
        origin_ns: the time that becomes 0; such a recording may be without events. None: that of the first item, and
            a recording needs events.

    Raises:
        UsageError: the folder cannot be written to.
        OSError: in the methods: the file cannot be written further.
    """

    def __init__(
        self,
        path: Path,
        *,
        source: str,
        size: SensorSize | None = None,
        published_shift: int = 0,
        origin_ns: int | None = None,
        pack_events: bool = True,
    ) -> None:
        self._files = contextlib.ExitStack()
        self._source, self._size, self._published_shift = source, size, published_shift
        self._pending: list[EventChunk] = []
        self._pending_events = 0
        self._origin_ns = origin_ns
        self._may_be_empty = origin_ns is not None
        self._last_ns: int | None = None
        self._largest = SensorSize(0, 0)
        self._notes: list[str] = []
        self._light: Light | None = None
        self._picture_size: SensorSize | None = None
        self._picture_times: list[int] = []
        self._events = self._reordered = self._flow_fields = 0
        self._flow: npt.NDArray[np.float32] | None = None
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            partial = self._files.enter_context(write_aside_and_rename(path, durable=True))
            self._file, self._disk = self._files.enter_context(open_new(partial))
        except OSError as error:
            raise UsageError(f"{path}: cannot be written: {error.strerror or error}") from error
        packed = {"compression": "gzip", "compression_opts": 1, "shuffle": True} if pack_events else {}
        for name, dtype in _COLUMNS.items():
            self._file.create_dataset(f"events/{name}", (0,), dtype, maxshape=(None,), chunks=(H5_CHUNK,), **packed)
        self._file.create_group("images")
        self.written: Written | None = None

    def __enter__(self) -> RecordingWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is not None:
            self._files.__exit__(kind, error, trace)
            return
        with self._files:
            self.written = self._finish()

    def add(self, item: Item) -> None:
        """Add the next item of the recording.

        Raises:
            UsageError: events are further out of order than the buffer can sort, or outside the sensor; pictures have
                different sizes; or the recording's size differs from the user's.
        """
        self._disk.check()
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
            self._add_picture(item)
        elif isinstance(item, FlowField):
            # event_flow pairs a field with the time at which it ends, and passes over the first one.
            before = np.zeros_like(item.flow) if self._flow is None else self._flow
            self.add_plane(f"flow_dt1/flow{self._flow_fields:09d}", item.t_ns, before)
            self.add_plane(f"flow/flow{self._flow_fields:09d}", item.t_ns, item.flow)
            self._flow, self._flow_fields = item.flow, self._flow_fields + 1
        elif len(item):
            self._set_origin(int(item.t_ns[0]))
            self._pending.append(item)
            self._pending_events += len(item)
            if self._pending_events >= FLUSH_EVENTS + REORDER_EVENTS:
                self._flush(keep=REORDER_EVENTS)

    def _add_picture(self, picture: Picture) -> None:
        height, width = picture.pixels.shape
        size = SensorSize(width, height)
        if self._picture_size not in (None, size):
            raise UsageError(f"{self._source}: pictures of different sizes, {self._picture_size} and {size}")
        self._picture_size = size
        dataset = self.add_plane(layout.image_key(len(self._picture_times)), picture.t_ns, picture.pixels)
        if picture.published_event_index is not None:
            dataset.attrs["event_idx_published"] = picture.published_event_index
        self._picture_times.append(picture.t_ns)

    def add_plane(self, name: str, t_ns: int, plane: npt.NDArray[Any]) -> h5py.Dataset:
        """Write a dataset, [H, W] or [2, H, W], with a time of the recording's clock, and return it."""
        self._disk.check()
        dataset = self._file.create_dataset(name, data=plane, compression="gzip", compression_opts=1)
        dataset.attrs["timestamp"] = (t_ns - self._set_origin(t_ns)) * 1e-9
        return dataset

    def _set_origin(self, t_ns: int) -> int:
        """Return the time that becomes 0: that of the first item of any kind."""
        if self._origin_ns is None:
            self._origin_ns = t_ns
        return self._origin_ns

    def _flush(self, keep: int) -> None:
        """Write all pending events except the last ``keep``."""
        events = EventChunk.join(self._pending)
        if backward := int(np.count_nonzero(np.diff(events.t_ns) < 0)):
            events = events.take(np.argsort(events.t_ns, kind="stable"))
        if self._last_ns is not None and events.t_ns[0] < self._last_ns:
            seconds = (self._last_ns - events.t_ns[0]) * 1e-9
            raise UsageError(
                f"{self._source}: near event {self._events} the time goes back by {seconds:.6f} s over more than "
                f"{REORDER_EVENTS} events; sort the recording, or split it there"
            )
        self._reordered += backward
        count = len(events) - keep
        self._append(events.part(0, count))
        # A copy: a view would keep the whole buffer alive.
        self._pending, self._pending_events = [events.take(np.arange(count, len(events)))], keep

    def _append(self, events: EventChunk) -> None:
        x, y = events.x, events.y
        if min(x.min(), y.min()) < 0 or max(x.max(), y.max()) > np.iinfo(np.uint16).max:
            raise UsageError(
                f"{self._source}: events at x {x.min()} .. {x.max()}, y {y.min()} .. {y.max()}; coordinates must be "
                f"from 0 to {np.iinfo(np.uint16).max}"
            )
        self._largest = SensorSize(
            max(self._largest.width, int(x.max()) + 1), max(self._largest.height, int(y.max()) + 1)
        )
        for name, values in zip(_COLUMNS, ((events.t_ns - (self._origin_ns or 0)) * 1e-9, x, y, events.p), strict=True):
            append(self._file[f"events/{name}"], values)
        self._events += len(events)
        self._last_ns = int(events.t_ns[-1])

    def _finish(self) -> Written:
        if self._pending:
            self._flush(keep=0)
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
        self._pair_pictures()
        ts = self._file["events/ts"]
        first, last = (float(ts[0]), float(ts[-1])) if self._events else (0.0, 0.0)
        self._file.attrs.update(
            sensor_resolution=(size.height, size.width),
            num_events=self._events,
            num_imgs=len(self._picture_times),
            t0=first,
            duration=last - first,
            data_source=self._source,
            start_ns=self._origin_ns,
        )
        if self._light is not None and self._picture_times:
            self._file.attrs["light"] = self._light.name
        return Written(
            events=self._events,
            images=len(self._picture_times),
            seconds=last - first,
            reordered_events=self._reordered,
            backward_images=int(np.count_nonzero(np.diff(self._picture_times) <= 0)),
            size=size,
            size_is_guessed=self._size is None and self._picture_size is None,
            notes=tuple(self._notes),
            light="" if self._light is None else self._light.name,
        )

    def _pair_pictures(self) -> None:
        ts = self._file["events/ts"]
        times = np.array([self._file[layout.image_key(i)].attrs["timestamp"] for i in range(len(self._picture_times))])
        earlier = np.zeros(len(times), np.int64)
        for start in range(0, self._events if len(times) else 0, FLUSH_EVENTS):
            earlier += np.searchsorted(ts[start : start + FLUSH_EVENTS], times, side="left")
        for index, count in enumerate(earlier):
            attributes = self._file[layout.image_key(index)].attrs
            attributes["event_idx"] = count
            if self._published_shift:
                attributes["event_idx_published"] = max(0, count - self._published_shift)

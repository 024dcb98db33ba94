"""Write the h5 layout in one pass, with bounded memory.

Only the times of pictures are kept in memory. The event of each picture is found at the end, in one pass over the event
times on disk, so pictures may come before or after their events.

    event_idx = number of events earlier than the picture     (events[event_idx] is the first one at its time or later)
"""

from __future__ import annotations

import contextlib
import io
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import numpy.typing as npt

from v2v_recordings import layout
from v2v_recordings.item_writer import FLUSH_EVENTS, ItemWriter, Written
from v2v_recordings.items import EventChunk, FlowField, Item, Picture, SensorSize

H5_CHUNK = 1 << 16
_COLUMNS = {"ts": np.float64, "xs": np.uint16, "ys": np.uint16, "ps": np.bool_}


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


class RecordingWriter(ItemWriter):
    """Write a recording in the h5 layout.

    Args:
        source: also the value of the root attribute ``data_source``.
        published_shift: how many events earlier than ``event_idx`` the published conversion of this raw form pairs a
            picture with. If it is not 0, its choice is also written (``event_idx_published``).
        pack_events: whether to compress events, to about half of their size. It takes most of the time of writing.
        path, size, origin_ns: see :class:`ItemWriter`, also for what it raises.
    """

    end_px = 1 << 16

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
        self._published_shift, self._packs_events = published_shift, pack_events
        self._flow_fields = 0
        self._flow: npt.NDArray[np.float32] | None = None
        super().__init__(path, source=source, size=size, origin_ns=origin_ns)

    def _open(self, path: Path) -> None:
        self._file, self._disk = self._files.enter_context(open_new(path))
        packed = {"compression": "gzip", "compression_opts": 1, "shuffle": True} if self._packs_events else {}
        for name, dtype in _COLUMNS.items():
            self._file.create_dataset(f"events/{name}", (0,), dtype, maxshape=(None,), chunks=(H5_CHUNK,), **packed)
        self._file.create_group("images")

    def add(self, item: Item) -> None:
        """Add the next item of the recording. Errors: :meth:`ItemWriter.add`."""
        self._disk.check()
        super().add(item)

    def add_plane(self, name: str, t_ns: int, plane: npt.NDArray[Any]) -> h5py.Dataset:
        """Write a dataset, [H, W] or [2, H, W], with a time of the recording's clock, and return it."""
        return self._write_plane(name, self.since_origin(t_ns), plane)

    def _write_plane(self, name: str, t_ns: int, plane: npt.NDArray[Any]) -> h5py.Dataset:
        self._disk.check()
        dataset = self._file.create_dataset(name, data=plane, compression="gzip", compression_opts=1)
        dataset.attrs["timestamp"] = t_ns * 1e-9
        return dataset

    def _write_picture(self, picture: Picture, t_ns: int) -> None:
        dataset = self._write_plane(layout.image_key(len(self._picture_times)), t_ns, picture.pixels)
        if picture.published_event_index is not None:
            dataset.attrs["event_idx_published"] = picture.published_event_index

    def _write_flow(self, field: FlowField, t_ns: int) -> None:
        # event_flow pairs a field with the time at which it ends, and passes over the first one.
        before = np.zeros_like(field.flow) if self._flow is None else self._flow
        self._write_plane(f"flow_dt1/flow{self._flow_fields:09d}", t_ns, before)
        self._write_plane(f"flow/flow{self._flow_fields:09d}", t_ns, field.flow)
        self._flow, self._flow_fields = field.flow, self._flow_fields + 1

    def _write_events(self, events: EventChunk) -> None:
        for name, values in zip(_COLUMNS, (events.t_ns * 1e-9, events.x, events.y, events.p), strict=True):
            append(self._file[f"events/{name}"], values)

    def _finish(self, written: Written) -> None:
        self._pair_pictures()
        self._file.attrs.update(
            sensor_resolution=(written.size.height, written.size.width),
            num_events=written.events,
            num_imgs=written.images,
            t0=written.first_seconds,
            duration=written.seconds,
            data_source=self._source,
            start_ns=self._origin_ns,
        )
        if written.light and written.images:
            self._file.attrs["light"] = written.light

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

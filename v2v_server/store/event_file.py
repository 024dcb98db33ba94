"""Read the file of a prepared recording (:mod:`v2v_recordings.block_file`), as it is served.

The file is read with ``pread`` and never mapped, as store files are (:mod:`v2v_server.store.format`).
"""

from __future__ import annotations

import os
from contextlib import AbstractContextManager
from functools import partial
from typing import Any

import msgpack
import numpy as np
import numpy.typing as npt
import xxhash

from v2v_protocol.errors import ProtocolError, UsageError, VideoError, VideoUnreadable, system_errors, undo_on_error
from v2v_recordings.binning import NEVER, EventsOfCrop
from v2v_recordings.block_file import FILE_MAGIC, MOST_BLOCK_EVENTS, TABLE, TAIL, EventHead
from v2v_server.store.format import Bytes, UnpackingError, unpack
from v2v_server.video.picture import PixelRect

MOST_SAMPLE_EVENTS = 1 << 25
"""Events that are taken at once, for one sample; they need 17 bytes each."""
_LARGEST_HEAD_BYTES = 256 << 20
_REMEDY = "prepare the recording again with v2v-prepare --videos-kind recordings"


class EventFile(AbstractContextManager["EventFile"]):
    """An open file of events.

    Attributes:
        head: its head.
        content: 32 hexadecimal digits that name all that it holds.
        blocks, pictures_table, flows: [n] structured, the tables of the head.

    Raises:
        VideoUnreadable: it cannot be read; also in each method.
        VideoError: it is no such file, or damaged; also in each method.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self._path = os.fspath(path)
        with system_errors(partial(VideoUnreadable, self._path, None), "cannot be read"):
            self._file = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)  # opening a FIFO must not block
        with undo_on_error(partial(os.close, self._file)):
            self._read_head()

    def _read_head(self) -> None:
        self._size = os.fstat(self._file).st_size
        place, length, check, head_bytes, magic = TAIL.unpack(self._pread(TAIL.size, self._size - TAIL.size))
        if magic != FILE_MAGIC or head_bytes > _LARGEST_HEAD_BYTES:
            raise self._damaged("does not end like a prepared recording")
        data = self._piece({"place": place, "bytes": length, "check": check}, head_bytes)
        try:
            self.head = head = EventHead.from_dict(msgpack.unpackb(data))
            self.blocks, self.pictures_table, self.flows = (
                np.frombuffer(table, TABLE) for table in (head.blocks, head.pictures, head.flows)
            )
        except (ProtocolError, UsageError, ValueError, msgpack.UnpackException) as error:
            raise self._damaged(f"its head is damaged: {error}") from error
        self.content = xxhash.xxh3_128(data).hexdigest()
        self._firsts = np.append(self.blocks["first"], head.events)
        counts = np.diff(self._firsts)
        if self._firsts[0] != 0 or (len(counts) and not 0 < counts.min() <= counts.max() <= MOST_BLOCK_EVENTS):
            raise self._damaged("its blocks do not follow each other")

    def between(self, edges_ns: npt.NDArray[np.int64], window: PixelRect, is_flipped: bool = False) -> EventsOfCrop:
        """Return the events of a crop in grids that follow each other, and when the events of each grid are.

        Args:
            edges_ns: [grids + 1] where they begin and end, ascending: a grid has the events with begin <= t < end.
            window: the crop in the picture of the sensor.
            is_flipped: whether columns are counted from the right of the crop.

        Raises:
            VideoError: there are more than MOST_SAMPLE_EVENTS; or see the class.
        """
        from v2v_server.store.event_blocks import unpack_block  # lazily: a catalogue must not load numba

        first, last = np.searchsorted(self.blocks["t_ns"], edges_ns[[0, -1]], "left").tolist()
        # Events at the very time at which a block begins may be in those before it.
        first = max(0, first - 1)
        count, kept = int(self._firsts[max(first, last)] - self._firsts[first]), 0
        if count > MOST_SAMPLE_EVENTS:
            raise VideoError(
                self._path,
                None,
                f"a sample takes {count:,} events; at most {MOST_SAMPLE_EVENTS:,}: give closer marks (--rate, "
                "--marks 20000events), or fewer voxels_per_clip",
            )
        span_ns, times = np.full((len(edges_ns) - 1, 2), NEVER), np.empty(MOST_BLOCK_EVENTS, np.int64)
        t_ns, pixel, brighter = np.empty(count, np.int64), np.empty(count, np.int64), np.empty(count, bool)
        for number in range(first, last):
            record = self.blocks[number]
            kept += unpack_block(
                self._rows(number), record["t_ns"], record["unit_ns"], edges_ns, window, is_flipped, times, span_ns,
                t_ns[kept:], pixel[kept:], brighter[kept:],
            )  # fmt: skip
        return EventsOfCrop(t_ns[:kept], pixel[:kept], brighter[:kept], span_ns)

    def times_of_every(self, events: int, most: int) -> npt.NDArray[np.int64]:
        """Return the times of the first of all events and of each ``events`` further, [n] ns, ``most`` at most."""
        wanted = np.arange(0, min(self.head.events, events * most), events)
        numbers, at = np.unique(np.searchsorted(self._firsts, wanted, "right") - 1, return_index=True)
        times = [
            self._times_of_block(number)[part - self._firsts[number]]
            for number, part in zip(numbers.tolist(), np.split(wanted, at[1:]), strict=False)
        ]
        return np.concatenate([np.empty(0, np.int64), *times])

    def _times_of_block(self, number: int) -> npt.NDArray[np.int64]:
        rows, record = self._rows(number)[:4].astype(np.int64), self.blocks[number]
        steps = rows[0] + (rows[1] << 8) + (rows[2] << 16) + (rows[3] << 24)
        times: npt.NDArray[np.int64] = record["t_ns"] + record["unit_ns"] * np.cumsum(steps)
        return times

    def _rows(self, number: int) -> npt.NDArray[np.uint8]:
        """Return a block, [8, n]."""
        count = int(self._firsts[number + 1] - self._firsts[number])
        return np.frombuffer(self._piece(self.blocks[number], 8 * count), np.uint8).reshape(8, count)

    def picture(self, number: int) -> npt.NDArray[np.uint8]:
        """Return a picture, [H, W]."""
        shape = self.head.height_px, self.head.width_px
        return np.frombuffer(self._piece(self.pictures_table[number], shape[0] * shape[1]), np.uint8).reshape(shape)

    def flow(self, number: int) -> npt.NDArray[np.float32]:
        """Return a field of flow to the next one, [2, H, W] px; NaN where it is not known."""
        shape = 2, self.head.height_px, self.head.width_px
        return np.frombuffer(self._piece(self.flows[number], 8 * shape[1] * shape[2]), "<f4").reshape(shape)

    def _piece(self, record: Any, size: int) -> Bytes:
        """Return a piece, unpacked to this size."""
        packed, where = self._pread(int(record["bytes"]), int(record["place"])), f"its piece at byte {record['place']}"
        if xxhash.xxh3_64_intdigest(packed) != int(record["check"]):
            raise self._damaged(f"{where} is damaged")
        try:
            return unpack("zstd", packed, size)
        except UnpackingError as error:
            raise self._damaged(f"{where} {error}") from error

    def _pread(self, size: int, offset: int) -> bytes:
        if min(size, offset) < 0 or offset + size > self._size:
            raise self._damaged("it is shorter than it says")
        with system_errors(partial(VideoUnreadable, self._path, None), "cannot be read"):
            data = os.pread(self._file, size, offset)
        if len(data) != size:
            raise self._damaged("it is shorter than it says")
        return data

    def _damaged(self, why: str) -> VideoError:
        return VideoError(self._path, None, f"is no intact prepared recording ({why}): {_REMEDY}")

    def __exit__(self, *_: object) -> None:
        os.close(self._file)

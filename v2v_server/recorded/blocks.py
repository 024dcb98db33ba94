"""The file of a prepared recording (``.v2ve``): events in blocks, pictures and fields of true flow.

    magic                                       8 bytes
    packed events, pictures and fields          in any order
    head                                        msgpack, see :class:`EventHead`, packed
    place, size and check of the head, magic    8 + 8 + 8 + 8 bytes

A block is up to :data:`MOST_BLOCK_EVENTS` consecutive events. Each is the time since the one before, nanoseconds, and
its place and polarity, 4 bytes of either, sorted by the significance of the bytes and compressed (zstd). So no time is
rounded; a longer gap than 4.29 s begins another block. The head has a table for each of the three: when a piece begins,
where it lies, and its check. Pieces are checked before they are unpacked, into a known number of bytes.

The file is read with ``pread`` and never mapped, as store files are (:mod:`v2v_server.store.format`).
"""

from __future__ import annotations

import os
import struct
from collections.abc import Iterable
from contextlib import AbstractContextManager
from dataclasses import dataclass
from types import TracebackType
from typing import Annotated, Any, BinaryIO, NamedTuple

import msgpack
import numpy as np
import numpy.typing as npt
import xxhash
import zstandard

from v2v_protocol.errors import ProtocolError, UsageError, VideoError, VideoUnreadable
from v2v_protocol.persisted import Limits, Persisted, to_plain

MOST_BLOCK_EVENTS = 1 << 15
LARGEST_SENSOR_SIDE_PX = 1 << 12
ENDING = ".v2ve"
_MAGIC = b"V2VEVTS1"
_TAIL = struct.Struct("<QQQ8s")
_LARGEST_HEAD_BYTES = 512 << 20
_LONGEST_STEP_NS = 2**32 - 1
_TABLE = np.dtype([("t_ns", "<i8"), ("first", "<i8"), ("place", "<i8"), ("bytes", "<i8"), ("check", "<u8")])
"""Of pieces: when one begins, the number of its first event, its first byte in the file, its size, and its hash."""
_REMEDY = "prepare the recording again with v2v-prepare --videos-kind recordings"


class PackedEvents(NamedTuple):
    """Consecutive events, sorted by time.

    Attributes:
        t_ns: [n] int64, nanoseconds.
        packed: [n] uint32, 2^13 y + 2 x + polarity (1: brighter).
    """

    t_ns: npt.NDArray[np.int64]
    packed: npt.NDArray[np.uint32]

    @classmethod
    def of(cls, t_ns: npt.ArrayLike, x: npt.ArrayLike, y: npt.ArrayLike, p: npt.ArrayLike) -> PackedEvents:
        """Return events by their columns, [n] each; ``p`` is true for brighter."""
        x, y, p = (np.asarray(each).astype(np.uint32) for each in (x, y, p))
        return cls(np.asarray(t_ns, np.int64), y << np.uint32(13) | x << np.uint32(1) | p)

    @classmethod
    def join(cls, parts: Iterable[PackedEvents]) -> PackedEvents:
        """Return the events of parts in one."""
        columns = zip(*parts, strict=True)
        return cls(*map(np.concatenate, columns))

    def part(self, first: int, last: int) -> PackedEvents:
        """Return the events ``first:last``, as a view."""
        return PackedEvents(self.t_ns[first:last], self.packed[first:last])


NO_EVENTS = PackedEvents(np.empty(0, np.int64), np.empty(0, np.uint32))


@dataclass(frozen=True, slots=True)
class EventHead(Persisted):
    """Head of the file.

    Attributes:
        height_px, width_px: size of the sensor.
        events: their number.
        source: fingerprint of the raw recording.
        light: how the pictures follow light, see :class:`v2v_recordings.items.Light`; "": not known.
        notes: sentences of the reader for the user.
        blocks, pictures, flows: tables of the pieces.
    """

    height_px: Annotated[int, Limits(1, LARGEST_SENSOR_SIDE_PX)]
    width_px: Annotated[int, Limits(1, LARGEST_SENSOR_SIDE_PX)]
    events: Annotated[int, Limits(0, 2**48)]
    source: str
    light: str
    notes: tuple[str, ...]
    blocks: bytes
    pictures: bytes
    flows: bytes


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
        try:
            self._file = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)  # opening a FIFO must not block
        except OSError as error:
            raise VideoUnreadable(self._path, None, f"cannot be read: {error.strerror or error}") from error
        try:
            self._read_head()
        except BaseException:
            os.close(self._file)
            raise

    def _read_head(self) -> None:
        size = os.fstat(self._file).st_size
        place, length, check, magic = _TAIL.unpack(self._pread(_TAIL.size, max(0, size - _TAIL.size)))
        if magic != _MAGIC or place + length > size or length > _LARGEST_HEAD_BYTES:
            raise self._damaged("does not end like a prepared recording")
        packed = self._pread(length, place)
        if xxhash.xxh3_64_intdigest(packed) != check:
            raise self._damaged("its head is damaged")
        try:
            data = zstandard.ZstdDecompressor().decompress(packed, max_output_size=_LARGEST_HEAD_BYTES)
            self.head = head = EventHead.from_dict(msgpack.unpackb(data))
            self.blocks, self.pictures_table, self.flows = (
                np.frombuffer(table, _TABLE) for table in (head.blocks, head.pictures, head.flows)
            )
        except (zstandard.ZstdError, ProtocolError, UsageError, ValueError, msgpack.UnpackException) as error:
            raise self._damaged(f"its head is damaged: {error}") from error
        self.content = xxhash.xxh3_128(data).hexdigest()
        bounds = np.append(self.blocks["first"], head.events)
        counts, self._ends = np.diff(bounds), bounds[1:]
        if bounds[0] != 0 or (len(counts) and not 0 < counts.min() <= counts.max() <= MOST_BLOCK_EVENTS):
            raise self._damaged("its blocks do not follow each other")

    def between(self, begin_ns: int, end_ns: int) -> PackedEvents:
        """Return the events with ``begin_ns <= t < end_ns``."""
        starts = self.blocks["t_ns"]
        # Events at the very time at which a block begins may be in those before it.
        first = max(0, int(np.searchsorted(starts, begin_ns, "left")) - 1)
        found = self._events(first, int(np.searchsorted(starts, end_ns, "left")))
        return found.part(*np.searchsorted(found.t_ns, (begin_ns, end_ns), "left").tolist())

    def times_of_every(self, events: int) -> npt.NDArray[np.int64]:
        """Return the time of the first of all events and of each ``events`` further, [n] nanoseconds."""
        found, wanted = list[npt.NDArray[np.int64]](), np.arange(0, self.head.events, events)
        for number, (first, end) in enumerate(zip(self.blocks["first"], self._ends, strict=True)):
            low, high = np.searchsorted(wanted, (first, end))
            if low < high:
                found.append(self._events(number, number + 1).t_ns[wanted[low:high] - first])
        return np.concatenate(found) if found else np.empty(0, np.int64)

    def picture(self, number: int) -> npt.NDArray[np.uint8]:
        """Return a picture, [H, W]."""
        shape = self.head.height_px, self.head.width_px
        return np.frombuffer(self._piece(self.pictures_table[number], shape[0] * shape[1]), np.uint8).reshape(shape)

    def flow(self, number: int) -> npt.NDArray[np.float32]:
        """Return a field of flow to the next one, [2, H, W] px; NaN where it is not known."""
        shape = 2, self.head.height_px, self.head.width_px
        return np.frombuffer(self._piece(self.flows[number], 8 * shape[1] * shape[2]), "<f4").reshape(shape)

    def _events(self, first: int, last: int) -> PackedEvents:
        """Return the events of blocks ``first`` to ``last`` - 1."""
        return PackedEvents.join([NO_EVENTS, *(self._block(number) for number in range(first, last))])

    def _block(self, number: int) -> PackedEvents:
        record = self.blocks[number]
        count = int(self._ends[number] - record["first"])
        rows = np.frombuffer(self._piece(record, 8 * count), np.uint8).reshape(8, count)
        steps, packed = (np.ascontiguousarray(half.T).view("<u4")[:, 0] for half in (rows[:4], rows[4:]))
        return PackedEvents(record["t_ns"] + np.cumsum(steps, dtype=np.int64), packed.astype(np.uint32, copy=False))

    def _piece(self, record: Any, size: int) -> bytes:
        packed = self._pread(int(record["bytes"]), int(record["place"]))
        if xxhash.xxh3_64_intdigest(packed) != int(record["check"]):
            raise self._damaged(f"its piece at byte {record['place']} is damaged or truncated")
        try:
            data = zstandard.ZstdDecompressor().decompress(packed, max_output_size=size)
        except zstandard.ZstdError as error:
            raise self._damaged(f"its piece at byte {record['place']} does not decompress: {error}") from error
        if len(data) != size:
            raise self._damaged(f"its piece at byte {record['place']} has {len(data)} bytes instead of {size}")
        return data

    def _pread(self, size: int, offset: int) -> bytes:
        try:
            data = os.pread(self._file, size, offset)
        except (OSError, OverflowError) as error:
            raise VideoUnreadable(self._path, None, f"cannot be read: {error}") from error
        if len(data) != size:
            raise self._damaged("it is shorter than it says")
        return data

    def _damaged(self, why: str) -> VideoError:
        return VideoError(self._path, None, f"is no intact prepared recording ({why}): {_REMEDY}")

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        os.close(self._file)


class EventFileWriter:
    """Write a file of events. It is complete after :meth:`finish`.

    Args:
        file: empty, and open for writing.

    Attributes:
        events: events so far, with those that wait for their block.
        reach: one more than the largest x, and than the largest y.
    """

    def __init__(self, file: BinaryIO) -> None:
        self._file, self._at = file, file.write(_MAGIC)
        self._pack = zstandard.ZstdCompressor(level=1).compress
        self._waiting, self._written = NO_EVENTS, 0
        self._tables: dict[str, list[tuple[int, ...]]] = {"blocks": [], "pictures": [], "flows": []}
        self._shapes: dict[str, tuple[int, ...]] = {}
        self.reach = 0, 0

    @property
    def events(self) -> int:
        """Return the number of events so far."""
        return self._written + len(self._waiting.t_ns)

    def add(self, events: PackedEvents) -> None:
        """Add the next events, none of which is earlier than one before.

        Raises:
            UsageError: one is.
        """
        joined = PackedEvents.join((self._waiting, events))
        steps = np.diff(joined.t_ns)
        if len(steps) and steps.min() < 0:
            raise UsageError("events are not in the order of time")
        y, x = events.packed >> np.uint32(13), events.packed >> np.uint32(1) & np.uint32(LARGEST_SENSOR_SIDE_PX - 1)
        self.reach = max(self.reach[0], int(x.max(initial=0)) + 1), max(self.reach[1], int(y.max(initial=0)) + 1)
        first = 0
        for gap in [*np.flatnonzero(steps > _LONGEST_STEP_NS).tolist(), None]:
            end = len(joined.t_ns) if gap is None else gap + 1
            while end - first >= MOST_BLOCK_EVENTS or (gap is not None and first < end):
                last = min(first + MOST_BLOCK_EVENTS, end)
                self._write_block(joined.part(first, last))
                first = last
        self._waiting = joined.part(first, len(joined.t_ns))

    def add_picture(self, t_ns: int, pixels: npt.NDArray[np.uint8]) -> None:
        """Add a picture, [H, W].

        Raises:
            UsageError: it has another size than one before.
        """
        self._check_shape("pictures", pixels)
        self._write("pictures", t_ns, 0, np.ascontiguousarray(pixels).tobytes())

    def add_flow(self, t_ns: int, flow: npt.NDArray[np.float32]) -> None:
        """Add a field of flow to the next one, [2, H, W] px; NaN where it is not known.

        Raises:
            UsageError: it has another size than one before.
        """
        self._check_shape("flows", flow[0])
        self._write("flows", t_ns, 0, np.ascontiguousarray(flow, "<f4").tobytes())

    @property
    def shape(self) -> tuple[int, ...] | None:
        """Return height and width of pictures or fields so far; None without any."""
        return next(iter(self._shapes.values()), None)

    def _check_shape(self, what: str, picture: npt.NDArray[Any]) -> None:
        self._shapes[what] = picture.shape
        if len(shapes := set(self._shapes.values())) > 1:
            raise UsageError(f"pictures and fields of flow have different sizes: {sorted(shapes)}")

    def finish(self, height_px: int, width_px: int, source: str, light: str = "", notes: tuple[str, ...] = ()) -> None:
        """Write what waits, and the head (:class:`EventHead`). Pieces at one time keep the last one.

        Raises:
            UsageError: events, pictures or fields do not fit the size.
        """
        if len(self._waiting.t_ns):
            self._write_block(self._waiting)
        if self.shape not in (None, (height_px, width_px)) or self.reach[0] > width_px or self.reach[1] > height_px:
            raise UsageError(
                f"a sensor of {width_px}x{height_px} px: events reach {self.reach[0]}x{self.reach[1]} px, and pictures "
                f"or fields are {self.shape} (height, width): correct the size"
            )
        tables = {name: np.array(sorted(rows), _TABLE) for name, rows in self._tables.items()}
        for name in ("pictures", "flows"):
            times = tables[name]["t_ns"]
            tables[name] = tables[name][np.append(times[1:] != times[:-1], True)[: len(times)]]
        head = EventHead(
            height_px, width_px, self._written, source, light, notes,
            **{name: table.tobytes() for name, table in tables.items()},
        )  # fmt: skip
        packed = self._pack(msgpack.packb(head.to_dict(), default=to_plain))
        self._file.write(packed)
        self._file.write(_TAIL.pack(self._at, len(packed), xxhash.xxh3_64_intdigest(packed), _MAGIC))
        self._file.flush()

    def _write_block(self, events: PackedEvents) -> None:
        steps = np.diff(events.t_ns, prepend=events.t_ns[:1]).astype("<u4")
        rows = np.concatenate([column.astype("<u4")[:, None].view(np.uint8).T for column in (steps, events.packed)])
        self._write("blocks", int(events.t_ns[0]), self._written, np.ascontiguousarray(rows).tobytes())
        self._written += len(events.t_ns)

    def _write(self, table: str, t_ns: int, first: int, data: bytes) -> None:
        packed = self._pack(data)
        self._tables[table].append((t_ns, first, self._at, len(packed), xxhash.xxh3_64_intdigest(packed)))
        self._at += self._file.write(packed)

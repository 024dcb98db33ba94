"""The file of a prepared recording (``.v2ve``): events in blocks, pictures and fields of true flow.

    magic                                       8 bytes
    packed events, pictures and fields          in any order
    head                                        msgpack, see :class:`EventHead`, packed
    of the head: place, bytes, check, and bytes unpacked; magic     8 bytes each

A block is up to :data:`MOST_BLOCK_EVENTS` consecutive events. Each is the time since the one before, uint32, x, and 2 y
+ polarity, uint16. They are sorted by the significance of the bytes, and compressed (zstd). Times are in the largest
unit, nanoseconds, that all steps of the block are multiples of. So no time is rounded; a longer gap than 4.29 s begins
another block. The head has a table for each of the three: when a piece begins, where it lies, and its check. Pieces are
checked before they are unpacked, into a known number of bytes.

:mod:`v2v_server.store.event_file` reads it.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import msgpack
import numpy as np
import numpy.typing as npt
import xxhash
import zstandard

from v2v_protocol.persisted import Limits, Persisted, to_plain
from v2v_recordings.item_writer import ItemWriter, Written
from v2v_recordings.items import NO_EVENTS, EventChunk, FlowField, Picture

MOST_BLOCK_EVENTS = 1 << 15
LARGEST_SENSOR_SIDE_PX = 1 << 12
ENDING = ".v2ve"
FILE_MAGIC = b"V2VEVTS1"
TAIL = struct.Struct("<QQQQ8s")
_LONGEST_STEP_NS = 2**32 - 1
TABLE = np.dtype(
    [("t_ns", "<i8"), ("first", "<i8"), ("unit_ns", "<i8"), ("place", "<i8"), ("bytes", "<i8"), ("check", "<u8")]
)
"""Of pieces: when one begins, the number of its first event and the unit of its times; its first byte in the file, its
size, and its hash."""


@dataclass(frozen=True, slots=True)
class EventHead(Persisted):
    """Head of the file.

    Attributes:
        height_px, width_px: size of the sensor.
        events: their number.
        source: fingerprint of the raw recording.
        light: how the pictures follow light, see :class:`v2v_recordings.items.Light`; "": not known.
        notes: sentences of the reader for the user.
        blocks, pictures, flows: tables of the pieces, in order of time.
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


class EventFileWriter(ItemWriter):
    """Write a file of events. Of pictures or fields at one time, the last one stays.

    Args:
        fingerprint: of the raw recording.
        path, source, origin_ns: see :class:`ItemWriter`, also for what it raises.
    """

    end_px = LARGEST_SENSOR_SIDE_PX

    def __init__(self, path: Path, *, source: str, fingerprint: str, origin_ns: int | None = None) -> None:
        self._fingerprint, self._waiting, self._packed_events = fingerprint, NO_EVENTS, 0
        self._tables: dict[str, list[tuple[int, ...]]] = {"blocks": [], "pictures": [], "flows": []}
        super().__init__(path, source=source, origin_ns=origin_ns)

    def _open(self, path: Path) -> None:
        self._file = self._files.enter_context(path.open("wb"))
        self._at = self._file.write(FILE_MAGIC)

    def _write_picture(self, picture: Picture, t_ns: int) -> None:
        self._write("pictures", t_ns, picture.pixels[None])

    def _write_flow(self, field: FlowField, t_ns: int) -> None:
        self._write("flows", t_ns, field.flow.astype("<f4"))

    def _write_events(self, events: EventChunk) -> None:
        joined = EventChunk.join((self._waiting, events))
        gaps: list[int] = (np.flatnonzero(np.diff(joined.t_ns) > _LONGEST_STEP_NS) + 1).tolist()
        first = 0
        for end in [*gaps, len(joined) - (len(joined) - max(gaps, default=0)) % MOST_BLOCK_EVENTS]:
            for start in range(first, end, MOST_BLOCK_EVENTS):
                self._write_block(joined.part(start, min(start + MOST_BLOCK_EVENTS, end)))
            first = end
        self._waiting = joined.part(first)

    def _write_block(self, events: EventChunk) -> None:
        steps = np.diff(events.t_ns, prepend=events.t_ns[:1])
        unit_ns = max(1, int(np.gcd.reduce(steps)))
        words = events.x, 2 * events.y.astype(np.int64) + events.p
        columns = [(steps // unit_ns).astype("<u4"), *(word.astype("<u2") for word in words)]
        rows = np.concatenate([column[:, None].view(np.uint8).T for column in columns])
        self._write("blocks", int(events.t_ns[0]), rows, self._packed_events, unit_ns)
        self._packed_events += len(events)

    def _write(self, table: str, t_ns: int, rows: npt.NDArray[Any], first: int = 0, unit_ns: int = 0) -> None:
        packed = self._pack(rows)
        self._tables[table].append((t_ns, first, unit_ns, self._at, len(packed), xxhash.xxh3_64_intdigest(packed)))
        self._at += self._file.write(packed)

    def _pack(self, rows: npt.NDArray[Any]) -> bytes:
        """Compress an array, each row with a code of its own: it unpacks in two thirds of the time."""
        packer, packed = zstandard.ZstdCompressor(level=1).compressobj(size=rows.nbytes), b""
        for row in rows:
            packed += packer.compress(row.tobytes()) + packer.flush(zstandard.COMPRESSOBJ_FLUSH_BLOCK)
        return packed + packer.flush()

    def _finish(self, written: Written) -> None:
        if len(self._waiting):
            self._write_block(self._waiting)
        tables = {name: np.array(sorted(rows), TABLE) for name, rows in self._tables.items()}
        for name in ("pictures", "flows"):
            times = tables[name]["t_ns"]
            tables[name] = tables[name][np.append(times[1:] != times[:-1], True)[: len(times)]]
        head = EventHead(
            written.size.height, written.size.width, written.events, self._fingerprint, written.light, written.notes,
            **{name: table.tobytes() for name, table in tables.items()},
        )  # fmt: skip
        data = msgpack.packb(head.to_dict(), default=to_plain)
        packed = zstandard.ZstdCompressor(level=1).compress(data)
        self._file.write(packed)
        self._file.write(TAIL.pack(self._at, len(packed), xxhash.xxh3_64_intdigest(packed), len(data), FILE_MAGIC))
        self._file.flush()

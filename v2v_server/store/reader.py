"""Read from a store file. A crop of some frames costs only the blocks that it touches."""

from __future__ import annotations

import os
from collections.abc import Collection, Iterator, Mapping
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from types import TracebackType
from typing import Any, NoReturn

import numpy as np
import numpy.typing as npt

from v2v_protocol.errors import UsageError, VideoChanged, VideoError, VideoUnreadable
from v2v_server.store.format import (
    BLOCK_COLUMNS,
    BLOCK_ROWS,
    LARGEST_BLOCK_BYTES,
    BlockRecord,
    block_check,
    read_head,
    unpack_record,
)
from v2v_server.store.packing import UnpackingError, unpack
from v2v_server.store.planes.plane import PLANES, PlanePlace, read_footer
from v2v_server.video.orientation import Window

_REMEDY = "re-create it with v2v-prepare"
_ZEROS = np.empty(0, np.uint8)


class BlockReader:
    """The pictures of a store file, or of a plane within one.

    Args:
        path, file: name and descriptor of the file; the descriptor stays open.
        offset: where the store file begins in it, bytes.
        is_sparse: whether an empty block means zeros; :meth:`read` then leaves its part of ``out`` as it is.

    Attributes:
        head: head of the store file.

    Raises:
        VideoUnreadable: it cannot be read.
        VideoError: it is not a store file, or its head is damaged.
    """

    def __init__(self, path: str, file: int, offset: int = 0, *, is_sparse: bool = False) -> None:
        self._path, self._file, self._offset, self._is_sparse = path, file, offset, is_sparse
        try:
            self.head, self._table = read_head(path, file, offset)
        except OSError as error:
            raise VideoUnreadable(path, None, f"cannot be read: {error.strerror or error}") from error

    def read(self, start: int, stride: int, window: Window, out: npt.NDArray[np.uint8]) -> bool:
        """Read frames start, start + stride ... of a window.

        Args:
            start: ordinal of the first frame in the source.
            stride: distance between the frames.
            window: (top, left, height, width) in the source's upright picture, pixels.
            out: [n, height, width] uint8, receives them.

        Returns:
            whether blocks were read; otherwise all of them are empty.

        Raises:
            UsageError: the file does not hold a requested frame or row.
            VideoUnreadable: the system reports an error.
            VideoError: a needed block is damaged or missing; ``frame`` is its first frame.
        """
        head, (top, left, height, width), count = self.head, window, len(out)
        at = start - head.first
        down = top - head.top
        inside = (
            0 <= at <= at + (count - 1) * stride < head.count
            and 0 <= down < down + height <= head.rows
            and 0 <= left < left + width <= head.width_px
        )
        if not inside or count < 1 or stride < 1 or out.shape[1:] != (height, width):
            raise UsageError(f"{count} frames from {start}, window {window}, are not in this file, which has {head}")
        done, has_blocks = 0, False
        while done < count:
            group, first = divmod(at + done * stride, head.group)
            more = min(count - done, (head.group_frames(group) - 1 - first) // stride + 1)
            has_blocks |= self._read_group(group, first, stride, (down, left, height, width), out[done : done + more])
            done += more
        return has_blocks

    def _read_group(self, group: int, first: int, stride: int, window: Window, out: npt.NDArray[np.uint8]) -> bool:
        # Import lazily: listing files must not load numba.
        from v2v_server.store.differences import from_differences

        head, (top, left, height, width) = self.head, window
        record = self._record(group)
        if self._is_sparse and record.starts[0] == record.starts[-1]:
            return False
        frames = head.group_frames(group)
        columns, has_blocks = range(left // BLOCK_COLUMNS, (left + width - 1) // BLOCK_COLUMNS + 1), False
        for row in range(top // BLOCK_ROWS, (top + height - 1) // BLOCK_ROWS + 1):
            y = row * BLOCK_ROWS
            tall = min(BLOCK_ROWS, head.rows - y)
            upper, lower = max(top, y), min(top + height, y + tall)
            blocks = self._blocks(group, record, row * head.across, columns, frames * tall)
            for column, block in zip(columns, blocks, strict=True):
                x = column * BLOCK_COLUMNS
                wide = min(BLOCK_COLUMNS, head.width_px - x)
                here, there = max(left, x), min(left + width, x + wide)
                part = out[:, upper - top : lower - top, here - left : there - left]
                if len(block):
                    from_differences(block, tall, wide, upper - y, here - x, first, stride, part)
                    has_blocks = True
                else:
                    part[...] = 0
        return has_blocks

    def _record(self, group: int) -> BlockRecord:
        size = self.head.record_bytes
        record = unpack_record(group, self._pread(size, self._table + group * size, group))
        if record is None:
            self._refuse(group, "its record in the table is damaged")
        # Check before allocating: the author of a hostile file also wrote its checksums.
        for number, (start, end) in enumerate(pairwise(record.starts)):
            if end - start > LARGEST_BLOCK_BYTES:
                self._refuse(group, f"block {number} has {end - start} bytes, the limit is {LARGEST_BLOCK_BYTES}")
        return record

    def _blocks(
        self, group: int, record: BlockRecord, before: int, columns: range, column_bytes: int
    ) -> Iterator[npt.NDArray[np.uint8]]:
        """Yield neighbouring blocks of a row, checked and unpacked; an empty one for zeros that are left out.

        Args:
            before: number of blocks in front of the row.
            column_bytes: bytes of a column of pixels in a block.
        """
        start, end = record.starts[before + columns.start], record.starts[before + columns.stop]
        data = memoryview(self._pread(end - start, start, group))
        for column in columns:
            number = before + column
            packed = data[record.starts[number] - start : record.starts[number + 1] - start]
            if block_check(packed, group, number) != record.checks[number]:
                self._refuse(group, f"block {number} is damaged or truncated")
            if self._is_sparse and not packed:
                yield _ZEROS
                continue
            wide = min(BLOCK_COLUMNS, self.head.width_px - column * BLOCK_COLUMNS)
            try:
                yield np.frombuffer(unpack(self.head.packing, packed, wide * column_bytes), np.uint8)
            except UnpackingError as error:
                self._refuse(group, f"block {number} {error}")

    def _pread(self, size: int, offset: int, group: int) -> bytes:
        try:
            return os.pread(self._file, size, self._offset + offset)
        except OSError as error:
            first = self.head.first + group * self.head.group
            raise VideoUnreadable(self._path, first, f"cannot be read: {error.strerror or error}") from error

    def _refuse(self, group: int, why: str) -> NoReturn:
        raise VideoError(
            self._path,
            self.head.first + group * self.head.group,
            f"the store file is corrupt ({why}): {_REMEDY}",
        )


class StoreFile(BlockReader):
    """An open store file.

    Args:
        path: the file.
        fingerprint: fingerprint of the expected source; "" accepts any.

    Attributes:
        head: the file's head.

    Raises:
        VideoUnreadable: it cannot be read.
        VideoChanged: it was made from another source.
        VideoError: it is not a store file, or its head is damaged.
    """

    def __init__(self, path: str | os.PathLike[str], fingerprint: str = "") -> None:
        path = os.fspath(path)
        try:
            file = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)  # opening a FIFO must not block
        except OSError as error:
            raise VideoUnreadable(path, None, f"cannot be read: {error.strerror or error}") from error
        try:
            super().__init__(path, file)
            if fingerprint not in ("", self.head.fingerprint):
                made_of = self.head.fingerprint
                raise VideoChanged(path, None, f"was made from another file: {made_of} instead of {fingerprint}")
        except BaseException:
            os.close(file)
            raise

    def __enter__(self) -> StoreFile:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        os.close(self._file)

    @cached_property
    def planes(self) -> frozenset[str]:
        """Return the names of the planes of this version that the file has.

        Raises:
            VideoUnreadable, VideoError: see :meth:`plane`.
        """
        return frozenset(name for name, place in self._places.items() if place.version == PLANES[name].version)

    def plane(
        self, name: str, start: int, count: int, cells: Window, wanted: npt.NDArray[np.int64] | None = None
    ) -> npt.NDArray[Any]:
        """Read a part of a plane.

        Args:
            name: one of :attr:`planes`.
            start, count: ordinal of the first frame in the source, and number of frames.
            cells: (top, left, rows, columns) in the plane of the stored rows, cells.
            wanted: which of these frames to return; None: all.

        Returns:
            [n, values, rows, columns].

        Raises:
            UsageError: the file does not hold a requested frame or cell.
            VideoUnreadable: the system reports an error.
            VideoError: the plane is damaged.
        """
        kind = PLANES[name]
        stored = BlockReader(self._path, self._file, self._places[name].offset, is_sparse=True)
        if stored.head != kind.head(self.head):
            raise VideoError(self._path, None, f"the store file is corrupt (its plane {name}): {_REMEDY}")
        window = kind.window(cells)
        pictures = np.zeros((count, *window[2:]), np.uint8)
        if not stored.read(start, 1, window, pictures):
            return np.zeros((count if wanted is None else len(wanted), kind.values, *cells[2:]), kind.dtype)
        return kind.from_pictures(pictures if wanted is None else pictures[wanted], cells)

    @cached_property
    def _places(self) -> Mapping[str, PlanePlace]:
        try:
            places = read_footer(self._path, self._file)
        except OSError as error:
            raise VideoUnreadable(self._path, None, f"cannot be read: {error.strerror or error}") from error
        return {name: place for name, place in places.items() if name in PLANES}


def has_planes(path: Path, planes: Collection[str]) -> bool:
    """Return whether a store file has planes; True if it cannot be read, since whatever reads it says why."""
    if not planes:
        return True
    try:
        with StoreFile(path) as stored:
            return stored.planes.issuperset(planes)
    except VideoError:
        return True

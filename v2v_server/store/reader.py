"""Read from a store file. A crop of some frames costs only the blocks that it touches."""

from __future__ import annotations

import os
from collections.abc import Iterator
from itertools import pairwise
from types import TracebackType
from typing import NoReturn

import numpy as np
import numpy.typing as npt

from v2v_protocol.errors import UsageError, VideoChanged, VideoError, VideoUnreadable
from v2v_server.store.format import (
    BLOCK_COLUMNS,
    BLOCK_ROWS,
    LARGEST_BLOCK_BYTES,
    BlockRecord,
    Head,
    block_check,
    read_head,
    unpack_record,
)
from v2v_server.store.packing import UnpackingError, unpack
from v2v_server.video.orientation import Window


class StoreFile:
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
        self._path = os.fspath(path)
        try:
            self._file = os.open(
                self._path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK
            )  # opening a FIFO must not block
        except OSError as error:
            raise VideoUnreadable(self._path, None, f"cannot be read: {error.strerror or error}") from error
        try:
            self.head, self._table = self._opened()
            if fingerprint not in ("", self.head.fingerprint):
                made_of = self.head.fingerprint
                raise VideoChanged(self._path, None, f"was made from another file: {made_of} instead of {fingerprint}")
        except BaseException:
            os.close(self._file)
            raise

    def _opened(self) -> tuple[Head, int]:
        try:
            return read_head(self._path, self._file)
        except OSError as error:
            raise VideoUnreadable(self._path, None, f"cannot be read: {error.strerror or error}") from error

    def __enter__(self) -> StoreFile:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        os.close(self._file)

    def read(self, start: int, stride: int, window: Window, out: npt.NDArray[np.uint8]) -> None:
        """Read frames start, start + stride ... of a window.

        Args:
            start: ordinal of the first frame in the source.
            stride: distance between the frames.
            window: (top, left, height, width) in the source's upright picture, pixels.
            out: [n, height, width] uint8, receives them.

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
        done = 0
        while done < count:
            group, first = divmod(at + done * stride, head.group)
            more = min(count - done, (head.group_frames(group) - 1 - first) // stride + 1)
            self._read_group(group, first, stride, (down, left, height, width), out[done : done + more])
            done += more

    def _read_group(self, group: int, first: int, stride: int, window: Window, out: npt.NDArray[np.uint8]) -> None:
        # Import lazily: listing files must not load numba.
        from v2v_server.store.pixels import from_differences

        head, (top, left, height, width) = self.head, window
        record = self._record(group)
        frames = head.group_frames(group)
        columns = range(left // BLOCK_COLUMNS, (left + width - 1) // BLOCK_COLUMNS + 1)
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
                from_differences(block, tall, wide, upper - y, here - x, first, stride, part)

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
        """Yield neighbouring blocks of a row, checked and unpacked.

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
            wide = min(BLOCK_COLUMNS, self.head.width_px - column * BLOCK_COLUMNS)
            try:
                yield np.frombuffer(unpack(self.head.packing, packed, wide * column_bytes), np.uint8)
            except UnpackingError as error:
                self._refuse(group, f"block {number} {error}")

    def _pread(self, size: int, offset: int, group: int) -> bytes:
        try:
            return os.pread(self._file, size, offset)
        except OSError as error:
            first = self.head.first + group * self.head.group
            raise VideoUnreadable(self._path, first, f"cannot be read: {error.strerror or error}") from error

    def _refuse(self, group: int, why: str) -> NoReturn:
        raise VideoError(
            self._path,
            self.head.first + group * self.head.group,
            f"the store file is corrupt ({why}): re-create it with v2v-prepare",
        )

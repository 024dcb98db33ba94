"""Write a store file, frame by frame."""

from __future__ import annotations

import os
from types import TracebackType
from typing import BinaryIO

import numpy as np
import numpy.typing as npt

from v2v_protocol.errors import UsageError
from v2v_server.store.format import BLOCK_COLUMNS, BLOCK_ROWS, Head, block_check, pack_record
from v2v_server.store.packing import Packing


class StoreWriter:
    """Write the frames that a head announces. The file is a store file once it is closed without an error.

    Memory: one group of frames, twice (see :func:`v2v_server.store.format.group_frames_for`), and the compressed blocks
    of one group.

    Args:
        path: the file; overwritten.
        head: describes what is written.
        packing: compression; its method is the head's.

    Raises:
        OSError: the file cannot be written; every call may raise it.
    """

    def __init__(self, path: str | os.PathLike[str], head: Head, packing: Packing) -> None:
        assert head.packing == packing.method
        self._head = head
        self._pack = packing.packer()
        self._front = head.to_bytes()
        self._group = np.empty((min(head.group, head.count), head.rows, head.width_px), np.uint8)
        self._differences = np.empty(self._group[:, :BLOCK_ROWS].size, np.uint8)
        self._frames = 0
        self._table: list[bytes] = []
        self._end = len(self._front) + head.groups * head.record_bytes
        self._file: BinaryIO = open(path, "wb")  # noqa: SIM115 - closed by close()

    @property
    def bytes(self) -> int:
        """Size of the file so far, bytes."""
        return self._end

    def fileno(self) -> int:
        """Return the file descriptor."""
        return self._file.fileno()

    def add(self, picture: npt.NDArray[np.uint8]) -> None:
        """Add the next frame: [rows, width] uint8.

        Raises:
            UsageError: it has another size, or there are more frames than announced.
        """
        head = self._head
        if picture.shape != (head.rows, head.width_px) or self._frames == head.count:
            raise UsageError(f"frame {self._frames} of {head.count} is {picture.shape}, not {head.rows, head.width_px}")
        at = self._frames % head.group
        self._group[at] = picture
        self._frames += 1
        if at + 1 == head.group or self._frames == head.count:
            self._write_group(self._group[: at + 1])

    def _write_group(self, frames: npt.NDArray[np.uint8]) -> None:
        # Import lazily: listing files must not load numba.
        from v2v_server.store.pixels import to_differences

        group, head = len(self._table), self._head
        blocks: list[bytes] = []
        for top in range(0, head.rows, BLOCK_ROWS):
            band = frames[:, top : top + BLOCK_ROWS]
            packed = self._differences[: band.size]
            to_differences(band, BLOCK_COLUMNS, packed)
            view = packed.data
            column = band.size // head.width_px  # bytes of one column of pixels
            for left in range(0, head.width_px, BLOCK_COLUMNS):
                blocks.append(self._pack(view[left * column : (left + BLOCK_COLUMNS) * column]))
        checks = [block_check(block, group, number) for number, block in enumerate(blocks)]
        self._table.append(pack_record(head, group, self._end, [len(block) for block in blocks], checks))
        self._file.seek(self._end)
        self._file.write(b"".join(blocks))
        self._end += sum(map(len, blocks))

    def close(self, *, lasting: bool = False) -> None:
        """Write the table and then the head, without which the file is not a store file.

        Args:
            lasting: wait until the data is on disk.

        Raises:
            UsageError: fewer frames were added than announced.
        """
        with self._file as file:
            if self._frames != self._head.count:
                raise UsageError(f"{self._frames} of {self._head.count} frames were written")
            file.seek(len(self._front))
            file.write(b"".join(self._table))
            file.flush()
            file.seek(0)
            file.write(self._front)
            file.flush()
            if lasting:
                os.fsync(file.fileno())

    def __enter__(self) -> StoreWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._file.close()

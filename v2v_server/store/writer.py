"""Write a store file, frame by frame."""

from __future__ import annotations

import fcntl
import os
import shutil
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import AbstractContextManager, ExitStack
from itertools import chain, islice
from pathlib import Path
from types import MappingProxyType, TracebackType
from typing import Any, BinaryIO

import numpy as np
import numpy.typing as npt

from v2v_protocol.errors import UsageError, VideoError
from v2v_server.store.format import BLOCK_COLUMNS, BLOCK_ROWS, Head, check, group_frames_for, pack_record
from v2v_server.store.packing import Packing
from v2v_server.store.planes import PLANES
from v2v_server.store.planes.plane import PlanePlace, pack_footer
from v2v_server.system.process import make_private
from v2v_server.video.collect import DecodedPicture
from v2v_server.video.frame_index import FrameIndex
from v2v_server.video.orientation import PixelRect

Arrays = Mapping[str, npt.NDArray[Any]]


class _BlockWriter:
    """Write the pictures of one store file, the front of it last.

    Args:
        file: empty, and open for writing.
        head, packing: see :class:`StoreWriter`.
        is_sparse: leave out blocks of zeros.
    """

    def __init__(self, file: BinaryIO, head: Head, packing: Packing, *, is_sparse: bool = False) -> None:
        assert head.packing == packing.method
        self._file, self._head, self._is_sparse = file, head, is_sparse
        self._pack = packing.packer()
        self._front = head.to_bytes()
        self._group = np.empty((min(head.group, head.count), head.rows, head.width_px), np.uint8)
        self._differences = np.empty(self._group[:, :BLOCK_ROWS].size, np.uint8)
        self._frames = 0
        self._table: list[bytes] = []
        self.end = len(self._front) + head.groups * head.record_bytes

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
        from v2v_server.store.differences import to_differences

        group, head = len(self._table), self._head
        blocks: list[bytes] = []
        for top in range(0, head.rows, BLOCK_ROWS):
            band = frames[:, top : top + BLOCK_ROWS]
            packed = self._differences[: band.size]
            to_differences(band, BLOCK_COLUMNS, packed)
            view = packed.data
            column = band.size // head.width_px  # bytes of one column of pixels
            for left in range(0, head.width_px, BLOCK_COLUMNS):
                block = view[left * column : (left + BLOCK_COLUMNS) * column]
                is_empty = self._is_sparse and not np.frombuffer(block, np.uint8).any()
                blocks.append(b"" if is_empty else self._pack(block))
        checks = [check(block, group << 32 | number) for number, block in enumerate(blocks)]
        self._table.append(pack_record(head, group, self.end, [len(block) for block in blocks], checks))
        self._file.seek(self.end)
        self._file.write(b"".join(blocks))
        self.end += sum(map(len, blocks))

    def write_table(self) -> None:
        """Write the table.

        Raises:
            UsageError: fewer frames were added than announced.
        """
        if self._frames != self._head.count:
            raise UsageError(f"{self._frames} of {self._head.count} frames were written")
        self._file.seek(len(self._front))
        self._file.write(b"".join(self._table))
        self._file.flush()

    def write_front(self) -> None:
        """Write the head, without which the file is not a store file."""
        self._file.seek(0)
        self._file.write(self._front)
        self._file.flush()


class StoreWriter(AbstractContextManager["StoreWriter"]):
    """Write the frames that a head announces. The file is a store file once it is closed without an error.

    Memory: one group of frames, twice (see :func:`v2v_server.store.format.group_frames_for`), and the compressed blocks
    of one group; the same of each plane, whose files lie beside the file, without a name.

    Args:
        path: the file; overwritten.
        head: describes what is written.
        packing: compression; its method is the head's.
        planes: names of the planes to write, of :data:`v2v_server.store.planes.PLANES`.

    Raises:
        OSError: the file cannot be written; every call may raise it.
    """

    def __init__(self, path: str | os.PathLike[str], head: Head, packing: Packing, planes: Iterable[str] = ()) -> None:
        self._files = ExitStack()
        self._file: BinaryIO = self._files.enter_context(open(path, "wb"))  # noqa: SIM115 - closed by close()
        # Held while this writes: a file without it is abandoned (v2v_server.store.cache).
        fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        self._luma = _BlockWriter(self._file, head, packing)
        self._planes: dict[str, tuple[BinaryIO, _BlockWriter]] = {}
        for name in planes:
            file: BinaryIO = self._files.enter_context(tempfile.TemporaryFile(dir=Path(path).parent))  # noqa: SIM115
            self._planes[name] = file, _BlockWriter(file, PLANES[name].head(head), packing, is_sparse=True)

    @property
    def bytes(self) -> int:
        """Size of the file so far without its planes, bytes."""
        return self._luma.end

    def add(self, picture: npt.NDArray[np.uint8], planes: Arrays = MappingProxyType({})) -> None:
        """Add the next frame: [rows, width] uint8, and the array of each plane.

        Raises:
            UsageError: it has another size, there are more frames than announced, or other planes.
        """
        self._luma.add(picture)
        if planes.keys() != self._planes.keys():
            raise UsageError(f"planes {sorted(planes)}: give {sorted(self._planes)}")
        for name, array in planes.items():
            self._planes[name][1].add(PLANES[name].to_picture(array))

    def close(self, *, lasting: bool = False) -> None:
        """Write the table, the planes, and then the head, without which the file is not a store file.

        Args:
            lasting: wait until the data is on disk.

        Raises:
            UsageError: fewer frames were added than announced.
        """
        with self._files:
            self._luma.write_table()
            if self._planes:
                self._append_planes()
            self._luma.write_front()
            if lasting:
                os.fsync(self._file.fileno())

    def _append_planes(self) -> None:
        places = {}
        self._file.seek(self._luma.end)
        for name, (file, writer) in self._planes.items():
            writer.write_table()
            writer.write_front()
            file.seek(0)
            places[name] = PlanePlace(PLANES[name].version, self._file.tell(), writer.end)
            shutil.copyfileobj(file, self._file)
        self._file.write(pack_footer(places))

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._files.close()


def write_store(
    path: Path, pictures: Iterator[DecodedPicture], index: FrameIndex, usable: PixelRect, first: int,
    count: int, *, video: str, fingerprint: str, packing: Packing, planes: Iterable[str],
    frames_per_second: float = 0.0, stored_index: bytes = b"", lasting: bool = False, is_private: bool = False,
    see: Callable[[Arrays], object] = lambda arrays: None,
) -> None:  # fmt: skip
    """Write a store file of the next pictures of a video, with the planes that every file of their signal has.

    Args:
        path: the file; overwritten.
        pictures: they begin at frame ``first``.
        index: of the video, or the part of it that is known.
        usable: the part of the pictures to store, all columns.
        first, count: the frames to store.
        video, fingerprint: of the source.
        packing: compression.
        planes: names of further planes to write.
        frames_per_second: of the video; 0 if unknown.
        stored_index: the encoded index; empty in a piece of a video.
        lasting: wait until the data is on disk.
        is_private: let no other user open it.
        see: called with the arrays of each frame by the names of their planes; "" names the luma.

    Raises:
        VideoError: the pictures cannot be decoded, or one states another transfer than the first.
        UsageError, OSError: see :class:`StoreWriter`.
    """
    beginning = next(pictures)
    top, _, rows, width = usable
    head = Head(
        video=video, fingerprint=fingerprint, height_px=index.height_px, width_px=width, top=top, rows=rows,
        first=first, count=count, frames=first + count, frames_per_second=frames_per_second, codec=beginning.codec,
        bit_exact=beginning.bit_exact, group=group_frames_for(rows, width), packing=packing.method,
        index=stored_index, bits=beginning.signal.bits, transfer=beginning.signal.transfer, matrix=beginning.matrix,
    )  # fmt: skip
    own = (name for name, plane in PLANES.items() if plane.is_part_of(head.signal))
    makers = {name: PLANES[name].maker() for name in (*planes, *own)}
    if is_private:
        make_private(path)
    with StoreWriter(path, head, packing, makers) as writer:
        for picture in chain((beginning,), islice(pictures, count - 1)):
            if picture.signal.transfer != head.transfer:
                why = f"its transfer changes from {head.transfer or 'SDR'}: re-encode it with one transfer"
                raise VideoError(video, None, why)
            arrays = {name: make(picture) for name, make in makers.items()}
            writer.add(picture.grey, arrays)
            see({"": picture.grey} | arrays)
        writer.close(lasting=lasting)

"""Read and write store files. A crop of some frames costs only the blocks that it touches."""

from __future__ import annotations

import fcntl
import math
import os
import shutil
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack
from dataclasses import replace
from functools import cached_property, partial
from itertools import chain, islice
from pathlib import Path
from types import MappingProxyType
from typing import Any, BinaryIO, NoReturn

import numpy as np
import numpy.typing as npt

from v2v_protocol.errors import (
    ProtocolError,
    UsageError,
    VideoChanged,
    VideoError,
    VideoUnreadable,
    system_errors,
    undo_on_error,
)
from v2v_server.store.format import (
    BLOCK_COLUMNS,
    BLOCK_ROWS,
    MAGIC,
    BlockRecord,
    Head,
    Packing,
    UnpackingError,
    check,
    group_frames_for,
    pack_record,
    read_head,
    unpack,
    unpack_record,
)
from v2v_server.store.planes import PLANES
from v2v_server.store.planes.plane import PlanePlace, pack_footer, read_footer
from v2v_server.system.process import make_private
from v2v_server.video.decode import ClipRequest, DecodedClip, DecodedPicture
from v2v_server.video.file_range import FileRange, open_bytes
from v2v_server.video.frame_index import FrameIndex
from v2v_server.video.picture import MIXED, SDR, PixelRect, Signal
from v2v_server.video.probe import VideoFacts

STORE_FORMAT = "v2v store file"
"""Name of the store file format, which only a prepared folder can serve."""
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
        with system_errors(partial(VideoUnreadable, path, None), "cannot be read"):
            self.head, self._table = read_head(path, file, offset)

    def read(self, start: int, stride: int, window: PixelRect, out: npt.NDArray[np.uint8]) -> bool:
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

    def _read_group(self, group: int, first: int, stride: int, window: PixelRect, out: npt.NDArray[np.uint8]) -> bool:
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
        try:
            return unpack_record(group, self._pread(size, self._table + group * size, group))
        except UnpackingError as error:
            self._refuse(group, str(error))

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
            if check(packed, group << 32 | number) != record.checks[number]:
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


class StoreFile(BlockReader, AbstractContextManager["StoreFile"]):
    """An open store file: :class:`v2v_server.store.pixels.Pixels` of the video that it was made from.

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

    is_stored = True

    def __init__(self, path: str | os.PathLike[str], fingerprint: str = "") -> None:
        path = os.fspath(path)
        with system_errors(partial(VideoUnreadable, path, None), "cannot be read"):
            file = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)  # opening a FIFO must not block
        with undo_on_error(partial(os.close, file)):
            super().__init__(path, file)
            if fingerprint:
                self.check(fingerprint)

    def facts(self) -> VideoFacts:
        """Return the facts of the source.

        Raises:
            VideoError: the file is damaged.
        """
        head = self.head
        try:
            index = FrameIndex.from_bytes(head.index)
        except ProtocolError as error:
            raise VideoError(self._path, None, f"its index is damaged: {error}") from error
        if (len(index), index.height_px, index.width_px) != (head.frames, head.height_px, head.width_px):
            raise VideoError(self._path, None, f"its index has {index}, and its head {head.frames} frames")
        return VideoFacts(
            frames=head.frames,
            height_px=head.height_px,
            width_px=head.width_px,
            codec=STORE_FORMAT,
            pixel_format="gray",
            frames_per_second=head.frames_per_second or math.nan,
            rotation_degrees=0,
            full_range=True,
            index=index,
            made_of=head.fingerprint,
        )

    def check(self, fingerprint: str) -> None:
        """Check what the file was made from.

        Raises:
            VideoChanged: it was made from another source.
        """
        made_of = self.head.fingerprint
        if made_of != fingerprint:
            raise VideoChanged(self._path, None, f"was made from another file: {made_of} instead of {fingerprint}")

    def require(self, first: int, end: int, usable: PixelRect) -> None:
        """Check that the file holds frames ``first`` .. ``end`` - 1 of a usable picture.

        Raises:
            VideoError: it does not.
        """
        head = self.head
        is_there = head.first <= first < end <= head.first + head.count
        if not is_there or usable != (head.top, 0, head.rows, head.width_px):
            raise VideoError(self._path, None, f"holds other frames or rows than its name says: {head}"[:200])

    @property
    def is_whole(self) -> bool:
        """Return whether the file ends behind its last block, or behind a list of planes.

        Raises:
            VideoUnreadable, VideoError: see :meth:`plane`.
        """
        end, size = self._record(self.head.groups - 1).starts[-1], os.fstat(self._file).st_size
        return end == size or (end < size and bool(self._places))

    def clips(self, request: ClipRequest) -> tuple[DecodedClip, ...]:
        """Read the cuts of a request, see :func:`read_clips`."""
        return read_clips([self], request, "store")

    def pictures(self, request: ClipRequest) -> Iterator[DecodedPicture]:
        """Yield the frames of the only cut of a request in 8 bits, in the memory of a few."""
        (cut,) = request.cuts
        for done in range(0, cut.count, self.head.group):
            grey = np.empty((min(self.head.group, cut.count - done), *request.window(cut)[2:]), np.uint8)
            self.read(request.start + done * request.stride, request.stride, request.window(cut), grey)
            for picture in grey:
                yield DecodedPicture(picture, picture, SDR, self.head.codec, self.head.bit_exact)

    def __exit__(self, *_: object) -> None:
        os.close(self._file)

    @cached_property
    def planes(self) -> frozenset[str]:
        """Return the names of the planes of this version that the file has.

        Raises:
            VideoUnreadable, VideoError: see :meth:`plane`.
        """
        places = self._places
        return frozenset(name for name in PLANES if name in places and places[name].version == PLANES[name].version)

    def plane(
        self, name: str, start: int, count: int, cells: PixelRect, wanted: npt.NDArray[np.int64] | None = None
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

    def arrays(self, name: str) -> Iterator[npt.NDArray[Any]]:
        """Yield the arrays of a plane, [values, rows, columns] for each frame. Errors: :meth:`plane`."""
        head = self.head
        _, rows, columns = PLANES[name].shape(head.rows, head.width_px)
        for number in range(head.groups):
            first, count = head.first + number * head.group, head.group_frames(number)
            for array in self.plane(name, first, count, (0, 0, rows, columns)):
                yield np.ascontiguousarray(array)

    @cached_property
    def _places(self) -> Mapping[str, PlanePlace]:
        with system_errors(partial(VideoUnreadable, self._path, None), "cannot be read"):
            return read_footer(self._path, self._file)


def read_clips(files: Sequence[StoreFile], request: ClipRequest, origin: str) -> tuple[DecodedClip, ...]:
    """Read the cuts of a request from files that follow each other and together hold it.

    Raises:
        UsageError: they do not hold a requested frame or cell.
        VideoUnreadable: the system reports an error.
        VideoError: a needed part is damaged, or a file lacks a needed plane. Its ``video`` is the file.
    """
    heads = [stored.head for stored in files]
    bits = min(request.most_bits or SDR.bits, heads[0].bits)
    transfers = {head.transfer for head in heads}
    transfer = MIXED if len(transfers) > 1 else heads[0].transfer
    signal = SDR if request.most_bits is None else Signal(bits, transfer)
    parts = [(stored, _held(stored.head, request)) for stored in files]
    added = []
    for name, plane in PLANES.items():
        if plane.is_wanted(request, signal):
            for stored in files:
                if plane.remedy and name not in stored.planes:
                    raise VideoError(stored._path, None, f"the store file lacks the plane {name}: {plane.remedy}")
            values = plane.read(parts, request)
            request = replace(request, cuts=tuple(map(plane.narrowed, request.cuts, values)))
            added.append((plane, values))
    clips = []
    for number, cut in enumerate(request.cuts):
        grey = np.empty((cut.count, *request.window(cut)[2:]), np.uint8)
        for stored, held in parts:
            if frames := range(held.start, min(held.stop, cut.count)):
                start = request.start + frames.start * request.stride
                stored.read(start, request.stride, request.window(cut), grey[frames.start : frames.stop])
        clip = DecodedClip(grey, request.seconds(cut), heads[-1].codec, heads[-1].bit_exact, origin, signal=signal)
        for plane, values in added:
            clip = plane.added(clip, values[number])
        clips.append(clip)
    return tuple(clips)


def _held(head: Head, request: ClipRequest) -> range:
    """Return the frames of a clip that lie in a file."""
    low = max(0, -(-(head.first - request.start) // request.stride))
    end = -(-(head.first + head.count - request.start) // request.stride)
    return range(low, max(low, min(end, request.count)))


def open_pixels(path: Path) -> StoreFile | None:
    """Open a store file; return None for any other file."""
    return StoreFile(path) if is_store_file(path) else None


def is_store_file(path: str | os.PathLike[str]) -> bool:
    """Return whether a file begins like a store file; False if it cannot be read."""
    try:
        with open_bytes(path) as file:
            return FileRange.parse(path) is None and file.read(len(MAGIC)) == MAGIC
    except (OSError, VideoUnreadable):
        return False


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

    def __exit__(self, *_: object) -> None:
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

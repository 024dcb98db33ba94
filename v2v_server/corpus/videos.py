"""The videos of a snapshot in columns; an entry is made when it is read.

A million videos as objects take 850 MB and half a minute; as columns a tenth of that. The pieces of a million videos
take 200 MB as tuples.
"""

from __future__ import annotations

import hashlib
import math
import sys
from array import array
from bisect import bisect_left
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain, islice, pairwise
from typing import Any, overload

import numpy as np
import numpy.typing as npt

from v2v_protocol.errors import UsageError, VideoError
from v2v_protocol.persisted import FloatOrNaN, Int64, Persisted
from v2v_protocol.sample import ARRAYS, sidecar_endings
from v2v_server.corpus.scenes.scene import PIECE, Pieces, clip_pieces, firsts_of, sides_of
from v2v_server.corpus.sources.source import VideoSource
from v2v_server.kinds.registry import kind_of
from v2v_server.store.planes import PLANES
from v2v_server.store.store_file import StoreFile
from v2v_server.video.frame_index import LARGEST_FRAMES, LARGEST_INDEXED_SIDE_PX
from v2v_server.video.rows import Rows

CHUNK = 4096
"""Rows that are converted at a time."""
_LARGEST_RATE = 1e9
_NUMBER_TYPES = "qqqqiidb"
"""Types of size, mtime, ctime, frames, width, height, rate and interlaced, in the letters of :mod:`array` and NumPy."""
_UNREADABLE = (-1, 0, 0, "", 0, 0, 0, None, "", 0, "the index lost its record; start again to probe it", "", None)
"""The columns after the id where the index has no sound row. No file has a size of -1, so it is probed."""
_Int32 = npt.NDArray[np.int32]
Thresholds = tuple[float | None, float | None]
NO_THRESHOLDS: Thresholds = (None, None)
_ASKED = 16
"""Prepared files that are checked for their planes."""


class StringColumn(Sequence[str]):
    """Strings in one block of memory.

    Args:
        utf8: their UTF-8 one after the other, which sorts as the strings do; or bytes that are never read as strings.
        lengths: integers [N], the bytes of each.
    """

    def __init__(self, utf8: bytes | bytearray | memoryview, lengths: npt.NDArray[np.integer]) -> None:
        self.utf8 = np.frombuffer(utf8, np.uint8)
        self._ends = np.concatenate(([0], np.cumsum(lengths, dtype=np.int64)))

    @property
    def lengths(self) -> npt.NDArray[np.int64]:
        """[N], the bytes of each."""
        return np.diff(self._ends)

    def where(self, mask: npt.NDArray[np.bool_]) -> StringColumn:
        """Return the strings at which the mask, [n], is set."""
        if mask.all():
            return self
        return StringColumn(self.utf8[np.repeat(mask, self.lengths)].data, self.lengths[mask])

    def find(self, string: str) -> int | None:
        """Return the position of a string in a sorted column; None if it is missing."""
        position = bisect_left(self, string)
        return position if position < len(self) and self[position] == string else None

    def __len__(self) -> int:
        return len(self._ends) - 1

    def __iter__(self) -> Iterator[str]:
        for start in range(0, len(self), CHUNK):
            yield from self[start : start + CHUNK]

    @overload
    def __getitem__(self, at: int) -> str: ...

    @overload
    def __getitem__(self, at: slice) -> list[str]: ...

    def __getitem__(self, at: int | slice) -> str | list[str]:
        if isinstance(at, slice):
            start, end, step = at.indices(len(self))
            if step != 1:
                return [self[each] for each in range(start, end, step)]
            ends = self._ends[start : max(start, end) + 1].tolist()
            utf8, offset = self.utf8[ends[0] : ends[-1]].tobytes(), ends[0]
            if utf8.isascii():
                text = utf8.decode()
                return [text[low - offset : high - offset] for low, high in pairwise(ends)]
            return [utf8[low - offset : high - offset].decode() for low, high in pairwise(ends)]
        if not 0 <= at < len(self):
            raise IndexError(f"string {at} of {len(self)}")
        return self.utf8[self._ends[at] : self._ends[at + 1]].tobytes().decode()


NO_STRINGS = StringColumn(b"", np.zeros(0, np.int64))


@dataclass(frozen=True, slots=True)
class IndexRow(Persisted):
    """What is known of one file.

    Attributes:
        id: relative POSIX path.
        size_bytes, mtime_ns, ctime_ns: of the file when it was probed; a size of -1, which no file has, lets it be
            probed again at the next start.
        fingerprint: see :mod:`v2v_server.video.fingerprint`.
        frames, width_px, height_px, frames_per_second, codec, interlaced, remark: see
            :class:`v2v_server.video.probe.VideoFacts`; frames_per_second is None where unknown.
        problem: why the file cannot be used; None if it can.
        frame_index: ``FrameIndex.to_bytes()``; None with a problem, and where only the other columns were read.
    """

    id: str
    size_bytes: Int64
    mtime_ns: Int64 = 0
    ctime_ns: Int64 = 0
    fingerprint: str = ""
    frames: Int64 = 0
    width_px: Int64 = 0
    height_px: Int64 = 0
    frames_per_second: float | None = None
    codec: str = ""
    interlaced: bool = False
    problem: str | None = None
    remark: str = ""
    frame_index: bytes | None = None

    @property
    def columns(self) -> tuple[Any, ...]:
        """Return the attributes without the frame index."""
        return tuple(getattr(self, name) for name in self.__slots__[:-1])


@dataclass(frozen=True, slots=True, eq=False)
class VideoTable:
    """Rows of an index without frame indices, sorted by id.

    Attributes:
        ids, fingerprints: strings [N].
        frames, width_px, height_px: integers [N].
        frames_per_second: float64 [N], NaN where unknown.
        interlaced: bool [N].
        codec, remark, problem: objects [N], strings; no problem is None.
        summaries: bytes [N], of the figures that were asked for; empty where there are none.
    """

    ids: StringColumn
    fingerprints: StringColumn
    frames: npt.NDArray[np.int64]
    width_px: npt.NDArray[np.int32]
    height_px: npt.NDArray[np.int32]
    frames_per_second: npt.NDArray[np.float64]
    interlaced: npt.NDArray[np.bool_]
    codec: npt.NDArray[np.object_]
    remark: npt.NDArray[np.object_]
    problem: npt.NDArray[np.object_]
    summaries: StringColumn

    @classmethod
    def read(cls, rows: Iterable[tuple[Any, ...]], count: int) -> tuple[VideoTable, npt.NDArray[np.int64]]:
        """Make a table of rows of :meth:`v2v_server.corpus.index.Store.rows`.

        A damaged row becomes one that has to be probed, because SQLite accepts any type in any column.

        Args:
            rows: sorted by id.
            count: N, the number of rows.

        Returns:
            the table, and [N, 3] the size in bytes, mtime and ctime in ns of each file when it was probed.
        """
        strings, start, left = (bytearray(), bytearray(), bytearray()), 0, iter(rows)
        # Allocated once: arrays that grow leave holes in the heap, a third of their size.
        columns = [np.empty(count, dtype) for dtype in ("i", "i", "i", *_NUMBER_TYPES, "O", "O", "O")]
        while chunk := list(islice(left, CHUNK)):
            for utf8, *part in _converted(chunk):
                for string, more in zip(strings, utf8, strict=True):
                    string += more
                end = start + len(part[0])
                for column, values in zip(columns, part, strict=True):
                    column[start:end] = values
                start = end
        ids, fingerprints, summaries = map(StringColumn, strings, columns[:3])
        size, mtime, ctime, frames, width, height, rate, interlaced, codec, remark, problem = columns[3:]
        numbers = frames, width, height, rate, interlaced.view(np.bool_)
        return cls(ids, fingerprints, *numbers, codec, remark, problem, summaries), np.stack((size, mtime, ctime), 1)

    def where(self, mask: npt.NDArray[np.bool_]) -> VideoTable:
        """Return the rows at which the mask, [n], is set."""
        if mask.all():
            return self
        columns: list[Any] = [getattr(self, name) for name in self.__slots__]
        columns = [column.where(mask) if isinstance(column, StringColumn) else column[mask] for column in columns]
        return VideoTable(*columns)

    def __len__(self) -> int:
        return len(self.frames)

    def row(self, at: int) -> IndexRow:
        """Return one row, without the state of its file and its frame index."""
        rate = float(self.frames_per_second[at])
        return IndexRow(
            id=self.ids[at],
            size_bytes=-1,
            fingerprint=self.fingerprints[at],
            frames=int(self.frames[at]),
            width_px=int(self.width_px[at]),
            height_px=int(self.height_px[at]),
            frames_per_second=None if math.isnan(rate) else rate,
            codec=self.codec[at],
            interlaced=bool(self.interlaced[at]),
            remark=self.remark[at],
            problem=self.problem[at],
        )


def _converted(rows: list[tuple[Any, ...]]) -> Iterator[tuple[Any, ...]]:
    """Yield rows as columns, in as few parts as damage allows."""
    try:
        yield _columns(rows)
    except (TypeError, ValueError, OverflowError):
        if len(rows) == 1:
            yield _columns([(rows[0][0], *_UNREADABLE)])
        else:
            for row in rows:
                yield from _converted([row])


def _columns(rows: list[tuple[Any, ...]]) -> tuple[Any, ...]:
    """Convert rows to columns: the bytes of ids, fingerprints and summaries, their lengths, numbers, formats, problems.

    Raises:
        TypeError, ValueError, OverflowError: no probe writes such a row.
    """
    columns = tuple(zip(*rows, strict=True))
    ids, sizes, mtimes, ctimes, fingerprints, frames, widths, heights, rates = columns[:9]
    codecs, interlaced, problems, remarks, summaries = columns[9:]
    if None in rates:
        rates = tuple(math.nan if rate is None else rate for rate in rates)
    values = sizes, mtimes, ctimes, frames, widths, heights, rates, interlaced
    numbers = tuple(array(code, column) for code, column in zip(_NUMBER_TYPES, values, strict=True))
    # Only a row with a problem may have no frames.
    least = np.array([problem is None for problem in problems]) if any(problems) else 1
    limits = (
        (least, LARGEST_FRAMES),
        (least, LARGEST_INDEXED_SIDE_PX),
        (least, LARGEST_INDEXED_SIDE_PX),
        (0, _LARGEST_RATE),
        (0, 1),
    )
    for column, (low, high) in zip(map(np.asarray, numbers[3:]), limits, strict=True):
        if (column < low).any() or (column > high).any():
            raise ValueError
    if not {str, type(None)}.issuperset(map(type, problems)):
        raise TypeError
    blobs = [summary if isinstance(summary, bytes) else b"" for summary in summaries]
    strings = _utf8(ids), _utf8(fingerprints), (b"".join(blobs), array("i", map(len, blobs)))
    utf8, lengths = zip(*strings, strict=True)
    return utf8, *lengths, *numbers, list(map(sys.intern, codecs)), list(map(sys.intern, remarks)), problems


def _utf8(strings: Sequence[str]) -> tuple[bytes, array[int]]:
    """Return strings as UTF-8 in one block, and the bytes of each."""
    text = "".join(strings)
    if text.isascii():
        return text.encode(), array("i", map(len, strings))
    encoded = [string.encode() for string in strings]
    return b"".join(encoded), array("i", map(len, encoded))


def joined(
    ids: Sequence[str], rows: Iterable[tuple[Any, ...]], unasked: list[str], missing: tuple[Any, ...] = _UNREADABLE
) -> Iterator[tuple[Any, ...]]:
    """Yield the row of each id.

    Args:
        ids: sorted, each once.
        rows: sorted by their first column, the id.
        unasked: receives the ids of all other rows.
        missing: the columns after the id where there is no row.
    """
    left = iter(rows)
    row = next(left, None)
    for id in ids:
        while row is not None and row[0] < id:
            unasked.append(row[0])
            row = next(left, None)
        if row is not None and row[0] == id:
            yield row
            row = next(left, None)
        else:
            yield id, *missing
    if row is not None:
        unasked += [row[0] for row in chain((row,), left)]


def encoded_pieces(pieces: Pieces, frames: int) -> bytes:
    """Return the pieces of a video of ``frames`` frames, encoded; empty if all of them are one without flags and bars.

    Args:
        pieces: from frame 0 on.
    """
    part = clip_pieces(pieces, 0, 0, frames)
    is_whole = len(part) == 1 and not part["flags"][0] and not sides_of(part).any()
    return b"" if is_whole else part.tobytes()


@dataclass(frozen=True, slots=True, eq=False)
class SplitVideos:
    """The videos whose frames are not one piece without flags and bars.

    Attributes:
        numbers: int32 [C], which videos, rising.
        bounds: int32 [C + 1]; the pieces of the i-th video are those at bounds[i] .. bounds[i + 1] - 1.
        pieces: [P] of :data:`v2v_server.corpus.scenes.scene.PIECE`.
    """

    numbers: _Int32
    bounds: _Int32
    pieces: Pieces

    @classmethod
    def of(cls, encoded: Iterable[bytes]) -> SplitVideos:
        """Make it from what :func:`encoded_pieces` returns for every video."""
        each = list(encoded)
        return cls.select(np.frombuffer(b"".join(each), PIECE), np.array([len(one) for one in each]) // PIECE.itemsize)

    @classmethod
    def select(cls, pieces: Pieces, counts: npt.NDArray[np.integer]) -> SplitVideos:
        """Make it from the pieces of every video in columns.

        Args:
            pieces: [P] of all videos.
            counts: [N] number of each video's pieces; 0 for one piece without flags and bars.
        """
        numbers = np.flatnonzero(counts)
        bounds = np.concatenate(([0], np.cumsum(counts[numbers])))
        return cls(numbers.astype(np.int32), bounds.astype(np.int32), pieces)

    def __len__(self) -> int:
        return len(self.numbers)

    def find(self, number: int) -> int | None:
        """Return the place among these of the video with a number; None if it is not one of them."""
        place = int(self.numbers.searchsorted(number))
        return place if place < len(self) and self.numbers[place] == number else None

    def encoded(self, number: int) -> bytes:
        """Return the encoded pieces of the video with a number; empty if it is not one of these."""
        if (place := self.find(number)) is None:
            return b""
        return self.pieces[self.bounds[place] : self.bounds[place + 1]].tobytes()

    def between(self, first: int, end: int) -> SplitVideos:
        """Return those of the videos ``first`` .. ``end`` - 1."""
        low, high = self.numbers.searchsorted(np.array((first, end), np.int32)).tolist()  # int64 would convert them all
        bounds = self.bounds[low : high + 1]
        return SplitVideos(self.numbers[low:high], bounds - bounds[0], self.pieces[bounds[0] : bounds[-1]])

    def owners(self) -> npt.NDArray[np.int64]:
        """Return [P], the place among these of the video of each piece."""
        return np.repeat(np.arange(len(self)), np.diff(self.bounds))

    def firsts(self) -> npt.NDArray[np.int64]:
        """Return [P], the first frame of each piece."""
        firsts = firsts_of(self.pieces, 0)
        firsts[self.bounds[:-1]] = 0
        return firsts


@dataclass(frozen=True, slots=True)
class VideoEntry(Persisted):
    """A video that can be used.

    Attributes:
        id: relative POSIX path, the video's permanent name.
        fingerprint: see :mod:`v2v_server.video.fingerprint`.
        frames: number of frames to decode.
        width_px, height_px: size of the upright picture, before ``rows``.
        frames_per_second: average rate; NaN where unknown.
        codec: FFmpeg's name of the format.
        threshold_pos, threshold_neg: contrast thresholds that the list file states, log units; None without.
        pieces: its pieces, see :func:`v2v_server.corpus.videos.encoded_pieces`; None where the catalogue was
            opened without ``scene``.
        remark: what of it is not served, or served with wrong grey levels or times
            (:class:`v2v_server.video.probe.VideoFacts`).
    """

    id: str
    fingerprint: str
    frames: int
    width_px: int
    height_px: int
    frames_per_second: FloatOrNaN
    codec: str
    threshold_pos: float | None = None
    threshold_neg: float | None = None
    pieces: bytes | None = None
    remark: str = ""


class Videos(Sequence[VideoEntry]):
    """The videos of a snapshot by id: facts in memory, looked up by number without reading the index.

    Args:
        table: the usable rows, sorted by id.
        thresholds: (positive, negative) of videos that have some, by number.
        split: the videos that are divided into pieces; None where that is unknown.

    Attributes:
        ids, fingerprints, frames, frames_per_second, width_px, height_px, interlaced, remark: columns, one value for
            each video.
        split: as given.
    """

    def __init__(
        self, table: VideoTable, thresholds: Mapping[int, Thresholds], split: SplitVideos | None = None
    ) -> None:
        self._table = replace(table, summaries=NO_STRINGS)  # tens of MB that only ``split`` is made of
        self._thresholds, self.split = thresholds, split
        self.ids, self.fingerprints, self.frames = table.ids, table.fingerprints, table.frames
        self.frames_per_second = table.frames_per_second
        self.width_px, self.height_px, self.interlaced = table.width_px, table.height_px, table.interlaced
        self.remark = table.remark

    def find(self, id: str) -> int | None:
        """Return the number of the video with an id; None if there is none."""
        return self.ids.find(id)

    def shape(self, id: str) -> tuple[int, int, int]:
        """Return number of frames, height and width (px) of the video with an id of these."""
        number = bisect_left(self.ids, id)
        return int(self.frames[number]), int(self.height_px[number]), int(self.width_px[number])

    def digest(self, rows: Rows) -> str:
        """Return 32 hexadecimal digits that name these videos with these rows.

        Fingerprints cover the track and its orientation.
        """
        of_kind = "".join(kind_of(id).in_digest for id in self.ids[:1])
        sha = hashlib.sha256(f"v2v catalogue 2\n{rows}\n{of_kind}".encode())
        pos, neg = NO_THRESHOLDS
        none, limits = f"{pos}\0{neg}", {number: f"{pos}\0{neg}" for number, (pos, neg) in self._thresholds.items()}
        table = self._table
        numbers = table.frames, table.width_px, table.height_px, table.frames_per_second
        for start in range(0, len(self), CHUNK):
            those = slice(start, start + CHUNK)
            columns = table.ids[those], table.fingerprints[those], *(column[those].tolist() for column in numbers)
            lines = [
                f"{id}\0{fingerprint}\0{frames}\0{width}\0{height}\0{rate}\0{limits.get(number, none)}\n"
                for number, (id, fingerprint, frames, width, height, rate) in enumerate(
                    zip(*columns, strict=True), start
                )
            ]
            sha.update("".join(lines).encode())
        return sha.hexdigest()[:32]

    def __len__(self) -> int:
        return len(self.frames)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Videos) and len(self) == len(other) and all(map(VideoEntry.__eq__, self, other))

    __hash__ = None  # type: ignore[assignment]

    def __iter__(self) -> Iterator[VideoEntry]:
        return map(self.__getitem__, range(len(self)))

    @overload
    def __getitem__(self, at: int) -> VideoEntry: ...

    @overload
    def __getitem__(self, at: slice) -> tuple[VideoEntry, ...]: ...

    def __getitem__(self, at: int | slice) -> VideoEntry | tuple[VideoEntry, ...]:
        if isinstance(at, slice):
            return tuple(self[number] for number in range(*at.indices(len(self))))
        number = range(len(self))[at]
        record = self._table.row(number)
        pos, neg = self._thresholds.get(number, NO_THRESHOLDS)
        return VideoEntry(
            id=record.id,
            fingerprint=record.fingerprint,
            frames=record.frames,
            width_px=record.width_px,
            height_px=record.height_px,
            frames_per_second=math.nan if record.frames_per_second is None else record.frames_per_second,
            codec=record.codec,
            threshold_pos=pos,
            threshold_neg=neg,
            pieces=None if self.split is None else self.split.encoded(number),
            remark=record.remark,
        )


def missing_arrays(source: VideoSource, ids: Sequence[str]) -> dict[str, str]:
    """Return the arrays that need a plane which some prepared files lack, with the remedy.

    Some files of this host are read, evenly spaced.
    """
    some = ids[:: max(1, len(ids) // _ASKED)]
    return {
        plane.serves: f"the plane {name}, which these prepared videos do not have: {plane.remedy}, or serve the videos "
        "that they were prepared from"
        for name, plane in PLANES.items()
        if plane.serves in ARRAYS and not (source.is_local and all(_has_plane(source, id, name) for id in some))
    }


def _has_plane(source: VideoSource, id: str, name: str) -> bool:
    try:
        with source.open_pixels(id, "") as pixels:
            return isinstance(pixels, StoreFile) and name in pixels.planes
    except VideoError:  # making a sample says why
        return True


@dataclass(frozen=True, slots=True)
class Sidecars:
    """The sidecars of one ending. The mappings are by the video's id.

    Attributes:
        fingerprints: videos without such a sidecar are missing.
        digest: names all of them.
        states: sizes and times, see :meth:`v2v_server.corpus.sources.source.VideoSource.sidecar_state`.
        problems: why a sidecar is not used.
    """

    fingerprints: Mapping[str, str]
    digest: str
    states: Mapping[str, str] = field(default_factory=dict)
    problems: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class CorpusFacts:
    """Facts about a corpus, all in memory: using them never reads the index on disk.

    Attributes:
        videos: the videos that can be used, by id.
        rows: the usable rows of each picture.
        digest: names this snapshot.
        scene_digest: names this snapshot together with the statistics of its videos; None without them.
        sidecars: the files beside the videos, by ending.
        missing: what arrays need that cannot be made from these videos, with the remedy.
    """

    videos: Sequence[VideoEntry]
    rows: Rows
    digest: str
    scene_digest: str | None
    sidecars: Mapping[str, Sidecars] = field(default_factory=dict)
    missing: Mapping[str, str] = field(default_factory=dict)

    def require_arrays(self, arrays: tuple[str, ...]) -> None:
        """Check that the videos have what these arrays are made from.

        Raises:
            UsageError: they do not.
        """
        for name in arrays:
            if name in self.missing:
                raise UsageError(f"arrays: {name} needs {self.missing[name]}")

    def sidecars_of(self, video: str, arrays: tuple[str, ...]) -> dict[str, str]:
        """Return the fingerprints of a video's sidecars that these arrays are made from, by ending."""
        found = {ending: self.sidecars[ending].fingerprints.get(video) for ending in sidecar_endings(arrays)}
        return {ending: fingerprint for ending, fingerprint in found.items() if fingerprint is not None}

    def sidecars_digest(self, arrays: tuple[str, ...]) -> str:
        """Return a name of all sidecars that these arrays are made from; "" if they are made from none."""
        digests = [self.sidecars[ending].digest for ending in sidecar_endings(arrays)]
        return hashlib.sha256("\n".join(digests).encode()).hexdigest()[:32] if digests else ""

    def digest_under(self, scene: str) -> str:
        """Return the digest that names this snapshot in samples of a spec.

        Args:
            scene: of the spec; with "off" the statistics do not count.

        Raises:
            UsageError: "auto", and the catalogue was opened without ``scene``.
        """
        if scene == "off":
            return self.digest
        if self.scene_digest is None:
            raise UsageError(
                f'scene = "{scene}" needs statistics of the videos, which this catalogue was opened without: start the '
                "server with --scene auto"
            )
        return self.scene_digest

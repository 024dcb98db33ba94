"""A folder of pieces of decoded videos, filled by whoever decodes them first.

A piece is a file of the store (:mod:`v2v_server.store.format`) with some hundred consecutive frames of a video, which
begin at a multiple of that number. So only what samples read is decoded and kept, and samples of other recipes find it.
Its name is a hash of the video's id, its fingerprint and the rows: a changed source has other names.

Several workers and servers may share a folder. A piece is written under another name, and gets its own when it is whole
and there is room for it; ``used``, behind a lock, says how many bytes there are. A worker that is killed leaves a file
that nobody reads, and that the next one to start removes, because its lock is gone. At the limit what is there stays:
every epoch reads all of it, so putting something else in its place would help nobody.

Whatever goes wrong here costs time and no sample: then its video is decoded as if there were no cache.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import secrets
import shutil
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain, islice
from pathlib import Path

import numpy as np
import numpy.typing as npt

from v2v_protocol.errors import CorpusError, UsageError, VideoError, VideoUnreadable
from v2v_server.store.format import PIECE_FRAMES, Head, group_frames_for
from v2v_server.store.packing import QUICK
from v2v_server.store.reader import StoreFile
from v2v_server.store.used import PARTIAL, Used, counted, locked_use, used_bytes
from v2v_server.store.writer import StoreWriter
from v2v_server.system.private import make_private
from v2v_server.video.collect import Cut
from v2v_server.video.decode import BIT_EXACT_CODECS, DecodedClip, stream_decoded
from v2v_server.video.fingerprint import check_fingerprint
from v2v_server.video.frame_index import FrameIndex
from v2v_server.video.orientation import Window

GIB = 1 << 30
LEAST_FREE_BYTES = GIB
"""So much of the disk is left to others."""

_LARGE_PICTURE_PX = 1 << 20
_EXPECTED_BITS = 4
"""Of a pixel, at most: what is not known before it is written."""
_REST_SECONDS = 60.0
"""A cache that could not be written to is left alone for so long."""


def piece_frames(rows: int, width_px: int) -> int:
    """Frames of a piece: fewer of large pictures, since a worker decodes whole pieces in the time of one sample."""
    frames = PIECE_FRAMES
    while frames > PIECE_FRAMES // 4 and rows * width_px * frames > _LARGE_PICTURE_PX * PIECE_FRAMES:
        frames //= 2
    return frames


class Cache:
    """The cache of a worker.

    Args:
        folder: made by :func:`make_cache`, and by nobody later: a disk that is gone must not fill the one below it.
        most_bytes: how much may lie there.
        least_free_bytes: how much of the disk stays free.

    Attributes:
        on_wait: called with True before this waits for other processes, and with False when it goes on.
        trouble: what was wrong when it was last asked, for people: what keeps it from keeping more, or a damaged piece.
    """

    def __init__(self, folder: Path, most_bytes: int, least_free_bytes: int = LEAST_FREE_BYTES) -> None:
        self.folder = folder
        self._most_bytes = most_bytes
        self._least_free_bytes = least_free_bytes
        self._rest_until, self._rest_reason = 0.0, ""
        self.trouble = ""
        self.on_wait: Callable[[bool], object] = lambda waits: None
        with contextlib.suppress(OSError):
            _remove_abandoned(folder)

    def clips(
        self,
        path: Path,
        video: str,
        fingerprint: str,
        rows: tuple[int, int],
        index: FrameIndex,
        start: int,
        cuts: Sequence[Cut],
        stride: int,
    ) -> tuple[DecodedClip, ...] | None:
        """Several cuts of a video, read here, or decoded and kept.

        Args:
            path: the video.
            video, fingerprint: its name and state.
            rows: (first, one after the last) that may be used: those that are kept. The cuts lie within.
            index: its frames, or a part that holds the pieces that are needed.
            start, cuts, stride: see :func:`v2v_server.video.decode.decode_cuts`.

        Returns:
            None where neither can be done: then it has to be decoded as if there were no cache.

        Raises:
            VideoError: another video lies there now.
            UsageError: a range outside the index.
        """
        self.trouble = ""
        last = start + max((cut.count - 1) * stride for cut in cuts)
        index.position(start, last - start + 1)
        size = piece_frames(rows[1] - rows[0], index.width_px)
        key = hashlib.sha256(repr((video, fingerprint, rows, size)).encode()).hexdigest()[:32]
        pieces = [
            _Piece(self.folder / key[:2] / f"{key}-{number}", number * size, min((number + 1) * size, index.end))
            for number in range(start // size, last // size + 1)
        ]
        made = self._read(pieces, fingerprint, index, start, cuts, stride)
        if made is not None:
            return made
        missing = [piece for piece in pieces if not piece.path.exists()]
        if not missing or index.first > missing[0].first or not self._has_room(missing, rows, index):
            return None
        check_fingerprint(path, fingerprint)
        try:
            self._fill(path, video, fingerprint, rows, index, missing)
        except OSError as error:
            self._rest(f"cannot be written to: {error.strerror or error}")
            return None
        except VideoError:
            return None  # what is damaged may lie beyond the frames that this sample needs
        made = self._read(pieces, fingerprint, index, start, cuts, stride)
        return None if made is None else tuple(replace(clip, origin="") for clip in made)

    @property
    def used_bytes(self) -> int:
        """How much lies there, of all that share the folder; 0 where that cannot be told."""
        return used_bytes(self.folder)

    def _read(
        self,
        pieces: Sequence[_Piece],
        fingerprint: str,
        index: FrameIndex,
        start: int,
        cuts: Sequence[Cut],
        stride: int,
    ) -> tuple[DecodedClip, ...] | None:
        """The cuts, if all pieces are there and sound. A damaged one is removed."""
        clips = [np.empty((cut.count, *_window(cut, index)[2:]), np.uint8) for cut in cuts]
        codec, bit_exact, sound = "", False, True
        for piece in pieces:
            try:
                with StoreFile(piece.path, fingerprint) as stored:
                    codec, bit_exact = stored.head.codec, stored.head.bit_exact
                    for cut, frames in zip(cuts, clips, strict=True):
                        # Of the frames start, start + stride ... those in this piece.
                        low = max(0, -(-(piece.first - start) // stride))
                        high = min(cut.count, -(-(piece.end - start) // stride))
                        if low < high:
                            stored.read(start + low * stride, stride, _window(cut, index), frames[low:high])
            except VideoUnreadable as error:
                if not isinstance(error.__cause__, FileNotFoundError):
                    self.trouble = error.reason
                return None
            except (VideoError, UsageError) as error:
                self._remove(piece.path, error.reason if isinstance(error, VideoError) else str(error))
                sound = False  # and on, so that all that are damaged are made anew together
        if not sound:
            return None
        times = [index.seconds(start, (cut.count - 1) * stride + 1)[::stride] for cut in cuts]
        return tuple(
            DecodedClip(frames, seconds, codec, bit_exact, "cache")
            for frames, seconds in zip(clips, times, strict=True)
        )

    def _has_room(self, missing: Sequence[_Piece], rows: tuple[int, int], index: FrameIndex) -> bool:
        if time.monotonic() < self._rest_until:
            self.trouble = self._rest_reason
            return False
        pixels = (rows[1] - rows[0]) * index.width_px * sum(piece.end - piece.first for piece in missing)
        try:
            free = shutil.disk_usage(self.folder).free
        except OSError as error:
            self._rest(f"is gone: {error.strerror or error}")
            return False
        expected = pixels * _EXPECTED_BITS // 8
        if self.used_bytes + expected > self._most_bytes:
            self.trouble = f"full: {self.used_bytes / GIB:.2f} of {self._most_bytes / GIB:g} GiB"
            return False
        if free - expected < self._least_free_bytes:
            self._rest(f"disk full: {free / GIB:.2f} GiB free")
            return False
        return True

    def _fill(
        self,
        path: Path,
        video: str,
        fingerprint: str,
        rows: tuple[int, int],
        index: FrameIndex,
        missing: Sequence[_Piece],
    ) -> None:
        """Decodes the missing pieces in one pass, and keeps each.

        Raises:
            VideoError: they do not decode.
            OSError: they cannot be written.
        """
        top, width = rows[0], index.width_px
        height, begin, end = rows[1] - rows[0], missing[0].first, missing[-1].end
        with contextlib.closing(stream_decoded(path, index, begin, end - begin, (top, 0, height, width))) as frames:
            for piece in missing:
                for _ in range(begin, piece.first):  # of a piece that is there
                    next(frames)
                begin = piece.end
                codec, picture = next(frames)
                head = Head(
                    video=video, fingerprint=fingerprint, height_px=index.height_px, width_px=width, top=top,
                    rows=height, first=piece.first, count=piece.end - piece.first, frames=piece.end,
                    frames_per_second=0.0, codec=codec, bit_exact=codec in BIT_EXACT_CODECS,
                    group=group_frames_for(height, width), packing=QUICK.method,
                )  # fmt: skip
                more = (later for _, later in islice(frames, head.count - 1))
                self._keep(piece.path, head, chain((picture,), more))

    def _keep(self, path: Path, head: Head, pictures: Iterable[npt.NDArray[np.uint8]]) -> None:
        """Writes a piece, and gives it its name if there is room."""
        partial = self.folder / PARTIAL / secrets.token_hex(8)
        try:
            partial.parent.mkdir(exist_ok=True)
            make_private(partial)
            with StoreWriter(partial, head, QUICK) as writer:
                fcntl.flock(writer.fileno(), fcntl.LOCK_EX | fcntl.LOCK_NB)  # as long as we live: see _remove_abandoned
                for picture in pictures:
                    writer.add(picture)
                writer.close()
            with self._locked_use() as used:
                if path.exists() or used.bytes + writer.bytes > self._most_bytes:
                    return
                path.parent.mkdir(exist_ok=True)
                used.add(writer.bytes)  # before: who is killed in between has counted too much, not too little
                partial.replace(path)
        finally:
            with contextlib.suppress(OSError):
                partial.unlink()

    def _remove(self, path: Path, why: str) -> None:
        """Removes a piece that cannot be read, so that it is made anew."""
        self.trouble = f"a damaged piece was removed: {why}"
        with contextlib.suppress(OSError), self._locked_use() as used:
            size = path.stat().st_size
            path.unlink()
            used.add(-size)

    @contextlib.contextmanager
    def _locked_use(self) -> Iterator[Used]:
        self.on_wait(True)
        try:
            with locked_use(self.folder) as used:
                yield used
        finally:
            self.on_wait(False)

    def _rest(self, why: str) -> None:
        self.trouble = self._rest_reason = why
        self._rest_until = time.monotonic() + _REST_SECONDS


@dataclass(frozen=True, slots=True)
class _Piece:
    """Frames ``first`` .. ``end`` - 1 of a video, and where they lie."""

    path: Path
    first: int
    end: int


def make_cache(folder: Path) -> None:
    """Makes the folder of a cache if need be, and counts what it holds: a worker that was killed may have counted what
    it did not keep.

    Raises:
        CorpusError: the folder cannot be made, read or written to.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with contextlib.suppress(BlockingIOError), locked_use(folder) as used:
            used.bytes = counted(folder)
    except OSError as error:
        raise CorpusError(f"--cache {folder}: cannot be written to: {error.strerror or error}") from error


def _remove_abandoned(folder: Path) -> None:
    """Removes what workers that are gone have left half-written: those that live hold locks."""
    for path in (folder / PARTIAL).iterdir():
        with contextlib.suppress(OSError), path.open("rb") as file:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            path.unlink()


def _window(cut: Cut, index: FrameIndex) -> Window:
    return cut.window or (0, 0, index.height_px, index.width_px)

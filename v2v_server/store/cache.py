"""Cache pieces of decoded videos in a folder, filled by the processes that decode them first.

A piece is a store file (:mod:`v2v_server.store.format`) with some hundred consecutive frames of a video, which begin at
a multiple of that number. So only frames that samples read are decoded and stored, and samples of other recipes reuse
them. Its name is a hash of the video's id, its fingerprint and the rows: a changed source has other names.

Several workers and servers may share the folder (:mod:`v2v_server.store.quota`). A killed worker leaves a temporary
file that is never read; the next worker to start removes it, because its lock is free. At the limit existing pieces
stay: every epoch reads all of them, so replacing one by another would gain nothing.

A fault here costs time but no sample: its video is then decoded without the cache.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import secrets
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain, islice
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from v2v_protocol.errors import CorpusError, UsageError, VideoError, VideoUnreadable
from v2v_server.store.format import PIECE_FRAMES, Head, group_frames_for
from v2v_server.store.packing import QUICK, RAW, Packing
from v2v_server.store.planes.chroma import CHROMA, chroma_planes, matrix_of, whole_chroma, with_chroma
from v2v_server.store.planes.detail import detail_planes, read_levels, same_transfer
from v2v_server.store.planes.motion import MOTION, read_motion, wants_motion, with_motion, with_planes
from v2v_server.store.quota import LEAST_FREE_BYTES, PARTIAL, QuotaFolder
from v2v_server.store.reader import StoreFile, has_planes
from v2v_server.store.writer import StoreWriter
from v2v_server.system.private import make_private
from v2v_server.system.status_fields import GIB
from v2v_server.video.collect import Cut, LastFrame
from v2v_server.video.decode import BIT_EXACT_CODECS, DecodedClip, stream_decoded
from v2v_server.video.fingerprint import check_fingerprint
from v2v_server.video.frame_index import FrameIndex
from v2v_server.video.luma import MIXED, Signal
from v2v_server.video.orientation import Window

_LOCK_SECONDS = 0.06
"""Longest wait for the lock of the folder; a sample does without the cache rather than wait."""
_LARGE_PICTURE_PX = 1 << 20
_EXPECTED_BITS = {QUICK: 4, RAW: 8}
"""Largest size of a packed pixel; the real size is known only after writing."""
_REST_SECONDS = 60.0
"""Time without writing to a cache after a write failed."""


def piece_frames(rows: int, width_px: int) -> int:
    """Return the number of frames in a piece. Larger pictures get fewer, because a worker decodes whole pieces in the
    time of one sample.
    """
    frames = PIECE_FRAMES
    while frames > PIECE_FRAMES // 4 and rows * width_px * frames > _LARGE_PICTURE_PX * PIECE_FRAMES:
        frames //= 2
    return frames


class Cache:
    """The cache of a worker.

    Args:
        folder: created by :func:`make_cache`.
        most_bytes: largest size of the folder, bytes.
        least_free_bytes: disk space to keep free, bytes.
        packing: of the pieces that it stores, QUICK or RAW; it reads all.

    Attributes:
        on_wait: called with True before this waits for other processes, and with False when it goes on.
        trouble: the last problem, for people: why nothing more is stored, or a damaged piece; empty if there is none.
    """

    def __init__(
        self, folder: Path, most_bytes: int, least_free_bytes: int = LEAST_FREE_BYTES, packing: Packing = QUICK
    ) -> None:
        self.folder = folder
        self._packing = packing
        self._quota = QuotaFolder(folder, most_bytes, _LOCK_SECONDS, least_free_bytes)
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
        most_bits: int | None = None,
    ) -> tuple[DecodedClip, ...] | None:
        """Return several cuts of a video, read from the cache, or decoded and stored in it.

        Args:
            path: the video.
            video, fingerprint: its catalogue id and fingerprint.
            rows: (first, one after the last) usable row; these are stored. The cuts lie within.
            index: its frames, or a part that holds the needed pieces.
            start, cuts, stride, most_bits: see :func:`v2v_server.video.decode.decode_cuts`.

        Returns:
            None if the cache can neither read nor store them; the caller then decodes without the cache.

        Raises:
            VideoError: the file is another video now.
            UsageError: a range outside the index.
        """
        self.trouble = ""
        last = start + max((cut.count - 1) * stride for cut in cuts)
        index.position(start, last - start + 1)
        size = piece_frames(rows[1] - rows[0], index.width_px)
        # Pieces that state their transfer have names of their own: older ones do not state it.
        named = (video, fingerprint, rows, size) if most_bits is None else (video, fingerprint, rows, size, most_bits)
        key = hashlib.sha256(repr(named).encode()).hexdigest()[:32]
        pieces = [
            _Piece(self.folder / key[:2] / f"{key}-{number}", number * size, min((number + 1) * size, index.end))
            for number in range(start // size, last // size + 1)
        ]
        picture = rows[0], 0, rows[1] - rows[0], index.width_px
        planes = [*([MOTION] if stride == 1 and wants_motion(cuts) else []), *chroma_planes(cuts)]
        lacking = [piece for piece in pieces if not has_planes(piece.path, planes)]
        # Keep what other streams stored; otherwise two streams would replace each other's pieces.
        kept = [name for name in (MOTION, CHROMA) if any(has_planes(piece.path, (name,)) for piece in lacking)]
        planes = [*dict.fromkeys([*planes, *kept])]
        made = self._read(pieces, fingerprint, index, start, cuts, stride, picture)
        if made is not None and not lacking:
            return made
        missing = [piece for piece in pieces if piece in lacking or not piece.path.exists()]
        if not missing or index.first > missing[0].first or not self._has_room(missing, rows, index):
            return made
        check_fingerprint(path, fingerprint)
        try:
            self._fill(path, video, fingerprint, rows, index, missing, planes, most_bits)
        except OSError as error:
            self._rest(f"cannot be written to: {error.strerror or error}")
            return made
        except VideoError:
            return made  # the damage may lie beyond the frames that this sample needs
        if made is None:
            made = self._read(pieces, fingerprint, index, start, cuts, stride, picture)
        return None if made is None else tuple(replace(clip, origin="") for clip in made)

    @property
    def used_bytes(self) -> int:
        """Bytes stored in the folder by all processes that share it; 0 if unknown."""
        return self._quota.used_bytes

    def _read(
        self,
        pieces: Sequence[_Piece],
        fingerprint: str,
        index: FrameIndex,
        start: int,
        cuts: Sequence[Cut],
        stride: int,
        picture: Window,
    ) -> tuple[DecodedClip, ...] | None:
        """Read the cuts if all pieces are present and sound. Damaged pieces are removed."""
        clips: list[npt.NDArray[Any]] = []
        codec, bit_exact, sound, signals = "", False, True, set[Signal]()
        files: list[tuple[StoreFile, range]] = []
        with contextlib.ExitStack() as opened:
            for piece in pieces:
                try:
                    stored = opened.enter_context(StoreFile(piece.path, fingerprint))
                    codec, bit_exact = stored.head.codec, stored.head.bit_exact
                    signal = stored.head.signal
                    signals.add(signal)
                    if not clips:
                        clips = [np.empty((cut.count, *_window(cut, index)[2:]), signal.dtype) for cut in cuts]
                    # The frames of start, start + stride ... that lie in this piece.
                    low = max(0, -(-(piece.first - start) // stride))
                    end = -(-(piece.end - start) // stride)
                    files.append((stored, range(low, min(end, max(cut.count for cut in cuts)))))
                    for cut, frames in zip(cuts, clips, strict=True):
                        if low < (high := min(cut.count, end)):
                            place = start + low * stride, stride, _window(cut, index)
                            read_levels(stored, *place, frames[low:high], signal)
                except VideoUnreadable as error:
                    if not isinstance(error.__cause__, FileNotFoundError):
                        self.trouble = error.reason
                    return None
                except (VideoError, UsageError) as error:
                    self._remove(piece.path, error.reason if isinstance(error, VideoError) else str(error))
                    sound = False  # continue, so that all damaged pieces are decoded again together
            if not sound:
                return None
            if len(signals) > 1:
                signal = signal._replace(transfer=MIXED)
            times = [index.seconds(start, (cut.count - 1) * stride + 1)[::stride] for cut in cuts]
            try:
                vectors = read_motion(files, start, cuts, stride, picture)
                if not all(stored.planes.issuperset(chroma_planes(cuts)) for stored, _ in files):
                    return None  # made for a stream without colour
                read = [
                    DecodedClip(frames, seconds, codec, bit_exact, "cache", signal=signal)
                    for frames, seconds in zip(clips, times, strict=True)
                ]
                read = list(with_chroma(read, cuts, files, start, stride))
            except VideoUnreadable as error:
                self.trouble = error.reason
                return None
            except VideoError as error:
                self._remove(Path(error.video), error.reason)
                return None
        return with_motion(read, cuts, vectors)

    def _has_room(self, missing: Sequence[_Piece], rows: tuple[int, int], index: FrameIndex) -> bool:
        if time.monotonic() < self._rest_until:
            self.trouble = self._rest_reason
            return False
        pixels = (rows[1] - rows[0]) * index.width_px * sum(piece.end - piece.first for piece in missing)
        try:
            free = self._quota.free_bytes
        except OSError as error:
            self._rest(f"is gone: {error.strerror or error}")
            return False
        expected = pixels * _EXPECTED_BITS[self._packing] // 8
        if self.used_bytes + expected > self._quota.most_bytes:
            self.trouble = f"full: {self.used_bytes / GIB:.2f} of {self._quota.most_bytes / GIB:g} GiB"
            return False
        if free - expected < self._quota.least_free_bytes:
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
        planes: Sequence[str],
        most_bits: int | None,
    ) -> None:
        """Decode the missing pieces in one pass, and store each.

        Raises:
            VideoError: they cannot be decoded.
            OSError: they cannot be written.
        """
        top, width = rows[0], index.width_px
        height, begin, end = rows[1] - rows[0], missing[0].first, missing[-1].end
        picture_px = top, 0, height, width
        chroma = whole_chroma(planes, picture_px)
        decoded = stream_decoded(path, index, begin, end - begin, picture_px, most_bits, chroma)
        with contextlib.closing(decoded) as frames:
            for piece in missing:
                for _ in range(begin, piece.first):  # frames of a piece that exists
                    next(frames)
                begin = piece.end
                stream, picture = next(frames)
                signal = stream.signal
                head = Head(
                    video=video, fingerprint=fingerprint, height_px=index.height_px, width_px=width, top=top,
                    rows=height, first=piece.first, count=piece.end - piece.first, frames=piece.end,
                    frames_per_second=0.0, codec=stream.codec, bit_exact=stream.codec in BIT_EXACT_CODECS,
                    group=group_frames_for(height, width), packing=self._packing.method, bits=signal.bits,
                    transfer=signal.transfer, matrix=matrix_of(stream),
                )  # fmt: skip
                more = chain(((stream, picture),), islice(frames, head.count - 1))
                self._keep(piece.path, head, more, [*planes, *detail_planes(signal)])

    def _keep(
        self, path: Path, head: Head, pictures: Iterable[tuple[LastFrame, npt.NDArray[Any]]], planes: Sequence[str]
    ) -> None:
        """Write a piece, and rename it into place if it fits the limit."""
        partial = self.folder / PARTIAL / secrets.token_hex(8)
        try:
            partial.parent.mkdir(exist_ok=True)
            make_private(partial)
            with StoreWriter(partial, head, self._packing, planes) as writer:
                fcntl.flock(
                    writer.fileno(), fcntl.LOCK_EX | fcntl.LOCK_NB
                )  # held for the life of this process: see _remove_abandoned
                for picture, arrays in with_planes(same_transfer(head, pictures), planes):
                    writer.add(picture, arrays)
                writer.close()
            with self._waiting():
                self._quota.add(partial, path)
        finally:
            with contextlib.suppress(OSError):
                partial.unlink()

    def _remove(self, path: Path, why: str) -> None:
        """Remove an unreadable piece, so that it is decoded again."""
        self.trouble = f"a damaged piece was removed: {why}"
        with contextlib.suppress(OSError), self._waiting():
            self._quota.remove(path)

    @contextlib.contextmanager
    def _waiting(self) -> Iterator[None]:
        self.on_wait(True)
        try:
            yield
        finally:
            self.on_wait(False)

    def _rest(self, why: str) -> None:
        self.trouble = self._rest_reason = why
        self._rest_until = time.monotonic() + _REST_SECONDS


@dataclass(frozen=True, slots=True)
class _Piece:
    """Frames ``first`` .. ``end`` - 1 of a video, and the path of their file."""

    path: Path
    first: int
    end: int


def make_cache(folder: Path) -> None:
    """Create the folder of a cache if it is missing, and recount its bytes.

    Raises:
        CorpusError: the folder cannot be created, read or written.
    """
    try:
        QuotaFolder(folder, 0, _LOCK_SECONDS).make()
    except OSError as error:
        raise CorpusError(f"--cache {folder}: cannot be written to: {error.strerror or error}") from error


def _remove_abandoned(folder: Path) -> None:
    """Remove temporary files of workers that are gone; live workers hold locks on theirs."""
    for path in (folder / PARTIAL).iterdir():
        with contextlib.suppress(OSError), path.open("rb") as file:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            path.unlink()


def _window(cut: Cut, index: FrameIndex) -> Window:
    return cut.window or (0, 0, index.height_px, index.width_px)

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
import hashlib
import secrets
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from v2v_protocol.errors import CorpusError, VideoError, VideoUnreadable, system_errors
from v2v_protocol.write_aside import make_output_folder
from v2v_server.store.format import PIECE_FRAMES, QUICK
from v2v_server.store.pixels import Pixels
from v2v_server.store.planes import OPTIONAL, PLANES, whole_cut
from v2v_server.store.quota import LEAST_FREE_BYTES, PARTIAL, QuotaFolder, delete_unless_read
from v2v_server.store.store_file import StoreFile, read_clips, write_store
from v2v_server.store.verified import CHANGES_MEANWHILE, read_unchanged
from v2v_server.system.log import GIB
from v2v_server.video.decode import ClipRequest, DecodedClip
from v2v_server.video.picture import PixelRect

_LOCK_SECONDS = 0.06
"""Longest wait for the lock of the folder; a sample does without the cache rather than wait."""
_LARGE_PICTURE_PX = 1 << 20
_EXPECTED_BITS = 4
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

    Attributes:
        on_wait: called with True before this waits for other processes, and with False when it goes on.
        trouble: the last problem, for people: why nothing more is stored, or a damaged piece; empty if there is none.
    """

    def __init__(self, folder: Path, most_bytes: int, least_free_bytes: int = LEAST_FREE_BYTES) -> None:
        self.folder = folder
        self._quota = QuotaFolder(folder, most_bytes, _LOCK_SECONDS, least_free_bytes)
        self._rest_until, self._rest_reason = 0.0, ""
        self.trouble = ""
        self.on_wait: Callable[[bool], object] = lambda waits: None
        with contextlib.suppress(OSError):
            for path in (folder / PARTIAL).iterdir():
                delete_unless_read(path)  # of a worker that is gone; a live one holds the lock of its file

    def clips(
        self, pixels: Pixels, video: str, fingerprint: str, request: ClipRequest
    ) -> tuple[DecodedClip, ...] | None:
        """Return the cuts of a request, read from the cache, or decoded and stored in it.

        Args:
            pixels: the video.
            video, fingerprint: its catalogue id and fingerprint.
            request: its usable rows are stored; the cuts lie within. Its index holds the needed pieces if it can.

        Returns:
            None if the cache can neither read nor store them; the caller then decodes without the cache.

        Raises:
            VideoError: the file is another video now.
            UsageError: a range outside the index.
        """
        self.trouble = ""
        request.check()
        index, usable, start = request.index, request.usable, request.start
        rows, last = (usable[0], usable[0] + usable[2]), start + (request.count - 1) * request.stride
        size = piece_frames(usable[2], usable[3])
        # Pieces that state their transfer have names of their own: older ones do not state it.
        named: tuple[Any, ...] = video, fingerprint, rows, size
        if request.most_bits is not None:
            named = *named, request.most_bits
        key = hashlib.sha256(repr(named).encode()).hexdigest()[:32]
        pieces = [
            _Piece(self.folder / key[:2] / f"{key}-{number}", number * size, min((number + 1) * size, index.end))
            for number in range(start // size, last // size + 1)
        ]
        planes = [name for name in OPTIONAL if PLANES[name].is_worth_storing(request)]
        held = {piece: _planes_in(piece.path) for piece in pieces} if planes else {}
        lacking = {piece: names for piece, names in held.items() if not names.issuperset(planes)}
        needed = [name for name in planes if PLANES[name].remedy]
        is_readable = all(names.issuperset(needed) for names in lacking.values())
        # Keep what other streams stored; otherwise two streams would replace each other's pieces.
        kept = [name for name in OPTIONAL if any(name in names for names in lacking.values())]
        made = self._read(pieces, fingerprint, request) if is_readable else None
        if made is not None and not lacking:
            return made
        for _ in pieces:  # reading may find one damaged piece after the other
            missing = [piece for piece in pieces if piece in lacking or not piece.path.exists()]
            if not missing or index.first > missing[0].first or not self._has_room(missing, usable):
                break
            state, wanted = pixels.check(fingerprint), tuple(dict.fromkeys((*planes, *kept)))
            try:
                self._fill(pixels, video, fingerprint, state, request, missing, wanted)
            except OSError as error:
                self._rest(f"cannot be written to: {error.strerror or error}")
                break
            except VideoError:
                break  # the damage may lie beyond the frames that this sample needs
            made, lacking = made or self._read(pieces, fingerprint, request), {}
            if made is not None:
                return tuple(replace(clip, origin="") for clip in made)
        return made

    def _read(self, pieces: Sequence[_Piece], fingerprint: str, request: ClipRequest) -> tuple[DecodedClip, ...] | None:
        """Read the cuts if all pieces are present and sound. Damaged pieces are removed."""
        with contextlib.ExitStack() as opened:
            files = []
            for piece in pieces:
                try:
                    files.append(opened.enter_context(StoreFile(piece.path, fingerprint)))
                    files[-1].require(piece.first, piece.end, request.usable)
                except VideoUnreadable as error:
                    if not isinstance(error.__cause__, FileNotFoundError):
                        self.trouble = error.reason
                    return None
                except VideoError as error:
                    self._remove(piece.path, error.reason)
            try:
                return read_clips(files, request, "cache") if len(files) == len(pieces) else None
            except VideoUnreadable as error:
                self.trouble = error.reason
            except VideoError as error:
                self._remove(Path(error.video), error.reason)
        return None

    def _has_room(self, missing: Sequence[_Piece], usable: PixelRect) -> bool:
        if time.monotonic() < self._rest_until:
            self.trouble = self._rest_reason
            return False
        pixels = usable[2] * usable[3] * sum(piece.end - piece.first for piece in missing)
        try:
            free = self._quota.free_bytes
        except OSError as error:
            self._rest(f"is gone: {error.strerror or error}")
            return False
        expected = pixels * _EXPECTED_BITS // 8
        used = self._quota.used_bytes
        if used + expected > self._quota.most_bytes:
            self.trouble = f"full: {used / GIB:.2f} of {self._quota.most_bytes / GIB:g} GiB"
            return False
        if free - expected < self._quota.least_free_bytes:
            self._rest(f"disk full: {free / GIB:.2f} GiB free")
            return False
        return True

    def _fill(
        self,
        pixels: Pixels,
        video: str,
        fingerprint: str,
        state: object,
        request: ClipRequest,
        missing: Sequence[_Piece],
        planes: Sequence[str],
    ) -> None:
        """Decode the missing pieces in one pass, and store each that fits the limit.

        Raises:
            VideoError: they cannot be decoded, or the file is not in that state any more.
            OSError: they cannot be written.
        """
        usable, index = request.usable, request.index
        begin, end = missing[0].first, missing[-1].end
        cut = whole_cut(end - begin, usable, planes)
        frames = pixels.pictures(ClipRequest(index, begin, (cut,), most_bits=request.most_bits))
        partial = self.folder / PARTIAL / secrets.token_hex(8)
        partial.parent.mkdir(exist_ok=True)
        for piece in missing:
            for _ in range(begin, piece.first):  # frames of a piece that exists
                next(frames)
            begin = piece.end
            try:
                write_store(
                    partial, frames, index, usable, piece.first, piece.end - piece.first, video=video,
                    fingerprint=fingerprint, packing=QUICK, planes=planes, is_private=True,
                )  # fmt: skip
                if pixels.check(fingerprint) != state:
                    raise VideoUnreadable(video, None, CHANGES_MEANWHILE)
                with self._waiting():
                    self._quota.add(partial, piece.path)
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


class Cached:
    """:class:`v2v_server.store.pixels.Pixels` of a video through a cache.

    Args:
        pixels: the video.
        cache: where decoded pieces of it are kept.
        video, fingerprint: its catalogue id and fingerprint.
    """

    is_stored = True

    def __init__(self, pixels: Pixels, cache: Cache, video: str, fingerprint: str) -> None:
        self._pixels, self._cache, self._name = pixels, cache, (video, fingerprint)
        self.facts, self.pictures = pixels.facts, pixels.pictures

    def check(self, fingerprint: str) -> None:
        """Do nothing: a piece states what it was made from, and the video is checked before it is decoded."""

    def clips(self, request: ClipRequest) -> tuple[DecodedClip, ...]:
        """Return the cuts of a request from the cache; decode them where it can neither read nor store them."""
        clips = self._cache.clips(self._pixels, *self._name, request)
        return read_unchanged(self._pixels, self._name[1], request) if clips is None else clips


@dataclass(frozen=True, slots=True)
class _Piece:
    """Frames ``first`` .. ``end`` - 1 of a video, and the path of their file."""

    path: Path
    first: int
    end: int


def _planes_in(path: Path) -> frozenset[str]:
    """Return the planes of a piece; all of one that cannot be read, since whatever reads it says why."""
    try:
        with StoreFile(path) as stored:
            return stored.planes
    except VideoError:
        return frozenset(PLANES)


def make_cache(folder: Path) -> None:
    """Create the folder of a cache if it is missing, and recount its bytes.

    Raises:
        CorpusError: the folder cannot be created, read or written.
    """
    with system_errors(CorpusError, f"--cache {folder}: cannot be written to"):
        make_output_folder(folder)
        QuotaFolder(folder, 0, _LOCK_SECONDS).make()

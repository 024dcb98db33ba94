"""A video whose file other programs may change in place, under the same name, size, head and tail.

The catalogue knows a hash of all that a video stores, and reading that much takes as long as decoding a clip. So a file
is read whole once, and again only if its state differs from the one that was read: size, times, inode. No program sets
the time of the last change of status, so a file that is restored afterwards tells as well. A file in the state in which
it was catalogued need not be read; any other state, such as that of a copy on this host, proves nothing.

The state is the same before and after a read, or the read is repeated. Of a folder of pictures that is the folder's own
state, which changes with its names, and the latest change of the pictures that were read: no other one is asked about.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

from v2v_protocol.errors import VideoChanged, VideoError, VideoUnreadable
from v2v_server.video.file_range import file_of
from v2v_server.video.fingerprint import CHANGED, check_content, files_in, unreadable

if TYPE_CHECKING:  # a server's command line starts without the decoder
    from v2v_server.store.pixels import Pixels
    from v2v_server.video.decode import ClipRequest, DecodedClip

CHANGES_MEANWHILE = "changes while it is read"
_TRIES = 3
_MOST_KNOWN = 1 << 16
_SOON_BYTES = 1 << 30
"""Up to this size a file is read whole for the sample that finds it changed; the work on it has a deadline."""
_TICK_SECONDS, _COARSE_TICK_SECONDS = 0.02, 2.0
"""Steps of the clock of a file system: of a usual one, and of one that counts whole seconds."""


def read_unchanged(pixels: Pixels, fingerprint: str, request: ClipRequest) -> tuple[DecodedClip, ...]:
    """Return the cuts of a request, from the catalogued video. A read is repeated if the file changed meanwhile.

    Raises:
        VideoChanged: it is another video by now.
        VideoUnreadable: it cannot be read, or changes each time.
        VideoError: it is damaged, and was before.
    """
    for _ in range(_TRIES):
        state = pixels.check(fingerprint)
        try:
            clips = pixels.clips(request)
        except VideoError:
            if pixels.check(fingerprint) == state:
                raise
        else:
            if pixels.check(fingerprint) == state:
                return clips
    raise VideoUnreadable("", None, CHANGES_MEANWHILE)


def content_of(pixels: Pixels) -> str:
    """Read all of a video, which could be read when it was catalogued, and return the hash of what it stores.

    Raises:
        VideoChanged: it is no video any more.
        VideoUnreadable: the system reports an error.
    """
    try:
        return pixels.facts().content
    except VideoUnreadable:
        raise
    except VideoError as error:
        kind = VideoUnreadable if isinstance(error.__cause__, OSError) else VideoChanged
        raise kind(error.video, error.frame, f"{CHANGED}: {error.reason}") from error


class KnownState(NamedTuple):
    """A state of a file that was looked into.

    Attributes:
        fingerprint: of the video that it was compared with.
        status: size, time of modification and of change, inode.
        latest_ns: the latest change of status of the file, or of the files in a folder.
        reason: why it is not that video; "" if it is.
    """

    fingerprint: str
    status: tuple[int, int, int, int]
    latest_ns: int
    reason: str


class Verified:
    """:class:`v2v_server.store.pixels.Pixels` of a file or folder that is decoded.

    Args:
        pixels: the video.
        path: its file or folder.
        known: what this process knows, by path; is added to.
        is_expected: returns whether the file is now in the state in which it was catalogued.
    """

    is_stored = False

    def __init__(
        self, pixels: Pixels, path: str, known: dict[str, KnownState], is_expected: Callable[[], bool] = lambda: False
    ) -> None:
        self._pixels, self._path, self._known, self._is_expected = pixels, path, known, is_expected
        self.facts, self.clips, self.pictures = pixels.facts, pixels.clips, pixels.pictures

    def check(self, fingerprint: str) -> KnownState:
        """Return the state of the file, in which it is the catalogued video.

        Raises:
            VideoChanged: it is another one by now.
            VideoUnreadable: it cannot be read, changes meanwhile, or is large and has to be read whole first
                (:meth:`learn`).
        """
        found = self.known(fingerprint)
        if found is None:
            if int(fingerprint.partition("-")[0]) > _SOON_BYTES:
                raise VideoUnreadable(self._path, None, "its file was written or touched: it is read whole first")
            found = self.learn(fingerprint)
        if found.reason:
            raise VideoChanged(self._path, None, found.reason)
        return found

    def known(self, fingerprint: str) -> KnownState | None:
        """Return the present state if it is known, or the one in which the video was catalogued; otherwise None.

        Raises:
            VideoUnreadable: the file cannot be read.
        """
        status, found = _status(self._path), self._known.pop(self._path, None)
        seen_ns: int = getattr(self._pixels, "latest_ns", 0)
        if (
            found is None
            or found[:2] != (fingerprint, status)
            or seen_ns > found.latest_ns
            or (found.reason and self._latest_ns(status) != found.latest_ns)  # restored, perhaps
        ):
            latest_ns = self._latest_ns(status)
            if not self._is_expected() or _status(self._path) != status:
                return None
            found = KnownState(fingerprint, status, latest_ns, "")
        return self._keep(found)

    def learn(self, fingerprint: str) -> KnownState:
        """Read all of the file, and return its state.

        Raises:
            VideoUnreadable: the file cannot be read, or changes meanwhile.
        """
        status = _status(self._path)
        latest_ns, reason = self._latest_ns(status), ""
        # Of two changes within a tick of the clock the second one does not show.
        tick = _TICK_SECONDS if latest_ns % 1_000_000_000 else _COARSE_TICK_SECONDS
        time.sleep(min(max(0.0, latest_ns / 1e9 + tick - time.time()), tick))
        try:
            self._pixels.check(fingerprint)
            check_content(self._path, content_of(self._pixels), fingerprint)
        except VideoChanged as error:
            reason = error.reason
        if _status(self._path) != status or self._latest_ns(status) != latest_ns:
            raise VideoUnreadable(self._path, None, CHANGES_MEANWHILE)
        return self._keep(KnownState(fingerprint, status, latest_ns, reason))

    def _latest_ns(self, status: tuple[int, int, int, int]) -> int:
        if not os.path.isdir(self._path):
            return status[2]
        try:
            return max((each.st_ctime_ns for _, each in files_in(self._path)), default=0)
        except OSError as error:
            raise unreadable(self._path, error) from error

    def _keep(self, found: KnownState) -> KnownState:
        self._known[self._path] = found
        if len(self._known) > _MOST_KNOWN:
            del self._known[next(iter(self._known))]
        return found


def _status(path: str) -> tuple[int, int, int, int]:
    """Return size, times and inode of a file or folder.

    It is opened, because a network file system may answer with an earlier state otherwise.

    Raises:
        VideoUnreadable: it cannot be opened.
    """
    try:
        file = os.open(file_of(path), os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
        try:
            found = os.fstat(file)
        finally:
            os.close(file)
    except OSError as error:
        raise unreadable(path, error) from error
    return found.st_size, found.st_mtime_ns, found.st_ctime_ns, found.st_ino

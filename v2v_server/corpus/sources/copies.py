"""Videos in object storage, each fetched once to a folder of this host.

A copy is named by a hash of address, id and fingerprint, so a changed object gets another name, and the content of a
name is what was catalogued. Any number of processes share a folder. The process that fetches a video holds a lock that
the others wait for, writes under another name, and renames. A reader holds a shared lock on its copy, which eviction
respects. If space runs out, the least recently read copies are evicted.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import hashlib
import os
import time
from array import array
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from functools import cached_property
from pathlib import Path, PurePosixPath
from typing import IO

from v2v_protocol.errors import CorpusError, UsageError, VideoChanged, VideoGone, VideoUnreadable
from v2v_server.corpus.manifest import MANIFEST_NAME
from v2v_server.corpus.sources.bucket import Bucket, is_url
from v2v_server.corpus.sources.listfile import ListEntry
from v2v_server.corpus.sources.names import UNPRINTABLE, count_left_out, is_video_name, printable
from v2v_server.corpus.sources.source import GONE, SourceOptions, State, VideoSource
from v2v_server.store.used import PARTIAL, locked_use
from v2v_server.system.private import make_private, open_private
from v2v_server.system.process import cache_folder
from v2v_server.video.fingerprint import fingerprint as fingerprint_of
from v2v_server.video.fingerprint import is_same_file

_SLOTS = 64
"""Videos that a host can fetch at a time, and so the most unfinished files that killed processes leave behind."""
_KEPT_SHARE = 0.9
"""Share of the limit that is used after an eviction. Evicting lists every file, so it frees space for several."""
_LOCK_SECONDS = 30.0
"""Longest wait for another process that evicts copies. No lease has begun yet, so no video is blamed for it."""
_SLOT_SECONDS = 20.0
"""Longest wait for another process that fetches a video of the same slot. Then the next free slot is used: the process
may be stopped, and fetching one video twice costs less than a waiting worker."""
_POLL_SECONDS = 0.05
_ROOM_SECONDS = 2.0
"""Wait before the next try if all copies are being read."""


class Copies(VideoSource):
    """The videos of an address, and their copies. Can be pickled.

    Args:
        bucket: where the videos come from.
        copies: folder of the copies; other corpora may share it.
        most_bytes: limit of the folder.
        listed: reads the videos to take from the address; None takes all.
    """

    is_local = False

    def __init__(
        self,
        bucket: Bucket,
        copies: Path,
        most_bytes: int,
        listed: Callable[[], tuple[ListEntry, ...] | None] = lambda: None,
    ) -> None:
        super().__init__(bucket.url, listed)
        self.bucket, self.copies, self.most_bytes = bucket, copies, most_bytes
        self._at_hand: tuple[tuple[str, str], IO[bytes]] | None = None

    def __reduce__(self) -> tuple[type[Copies], tuple[Bucket, Path, int]]:
        return Copies, (self.bucket, self.copies, self.most_bytes)

    @cached_property
    def _objects(self) -> dict[str, State]:
        """The objects, as first listed.

        Raises:
            CorpusError: they cannot be listed.
        """
        return self.bucket.objects()

    def videos(self, refused: dict[str, str], left_out: Counter[str]) -> Iterator[str]:
        """List the objects that a folder would list as videos, see :meth:`VideoSource.videos`."""
        for name in self._objects:
            if name.rpartition("/")[2] == MANIFEST_NAME:
                raise CorpusError(f"{self}: {name} makes it a prepared corpus: copy that to a disk")
        if self.listed is not None:
            yield from (entry.id for entry in self.listed)
            return
        for name in self._objects:
            parts = name.split("/")
            if any(part.startswith(".") for part in parts):
                continue
            if not is_video_name(parts[-1]):
                count_left_out(parts[-1], left_out)
            elif printable(name) != name:
                refused[printable(name)] = UNPRINTABLE
            elif "" in parts:
                refused[name] = "has an empty part between two slashes"
            else:
                yield name

    def make(self) -> None:
        """Create the folder.

        Raises:
            CorpusError: it cannot be created or written to.
        """
        try:
            (self.copies / PARTIAL).mkdir(parents=True, exist_ok=True)
            with locked_use(self.copies, _LOCK_SECONDS):
                pass
        except OSError as error:
            raise CorpusError(f"--copies {self.copies}: cannot be written to: {error.strerror or error}") from error

    def worker_flags(self) -> list[str]:
        """Return the flags that name the folder of copies and its limit."""
        return ["--copies", str(self.copies), "--copies-gib", str(self.most_bytes / (1 << 30))]

    def states(self, ids: Sequence[str]) -> array[int]:
        """Return the states of many objects, from the listing."""
        found = array("q")
        for id in ids:
            found.extend(self._objects.get(id, GONE))
        return found

    def state(self, id: str) -> State:
        """Ask the store for the state of one object.

        Raises:
            VideoUnreadable: it cannot be had.
        """
        return self.bucket.state(id)

    def verify(self, id: str, fingerprint: str, state: State | None) -> None:
        """Check the object against its state, with one question. An answer that cannot be had is no error.

        Raises:
            VideoGone, VideoChanged: the object is gone, or another one by now.
        """
        try:
            found = self.bucket.state(id, tries=1)
        except VideoGone:
            raise
        except VideoUnreadable:
            return
        if state is not None and found != state:
            raise VideoChanged(id, None, f"changed in {self} since it was catalogued")

    def has(self, id: str, fingerprint: str) -> bool:
        """Return whether the copy is there. If so, it stays until the next one is asked for, or fetched."""
        if self._at_hand is not None and self._at_hand[0] == (id, fingerprint):
            return True
        held = self._hold(self._path(id, fingerprint))
        if held is not None:
            self._keep(id, fingerprint, held)
        return held is not None

    def fetch(self, id: str, fingerprint: str) -> None:
        """Fetch the copy if it is missing; afterwards :meth:`has` returns True.

        Raises:
            VideoUnreadable: it cannot be had.
            VideoChanged: the object is another one by now.
        """
        self.release()
        self._keep(id, fingerprint, self._get(id, fingerprint))

    @contextlib.contextmanager
    def open_local(self, id: str, fingerprint: str) -> Iterator[Path]:
        """Lend the copy of a video until the end of the context.

        Args:
            fingerprint: of the video as catalogued; "" fetches what is there now.

        Raises:
            VideoUnreadable, VideoChanged: see :meth:`fetch`.
        """
        if fingerprint and self.has(id, fingerprint):
            yield self._path(id, fingerprint)
            return
        self.release()
        with self._get(id, fingerprint) as held:
            yield Path(held.name)

    def _keep(self, id: str, fingerprint: str, held: IO[bytes]) -> None:
        self.release()
        self._at_hand = (id, fingerprint), held

    def release(self) -> None:
        """Allow eviction of the copy that :meth:`has` or :meth:`fetch` keeps."""
        if self._at_hand is not None:
            self._at_hand[1].close()
            self._at_hand = None

    def _path(self, id: str, fingerprint: str) -> Path:
        mark = "-".join(fingerprint.split("-")[:2])  # what a file's head and tail tell
        key = hashlib.sha256(repr((self.bucket.url, id, mark)).encode()).hexdigest()[:32]
        return self.copies / key[:2] / f"{key}{PurePosixPath(id).suffix}"

    def _hold(self, path: Path) -> IO[bytes] | None:
        """Return the open copy, locked against eviction; None if it is not there."""
        with contextlib.ExitStack() as undo, contextlib.suppress(OSError):  # evicted, before or just now
            file = undo.enter_context(path.open("rb"))
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)  # a copy that another process locks is fetched again
            if os.path.samestat(os.fstat(file.fileno()), path.stat()):
                os.utime(path)
                undo.pop_all()
                return file
        return None

    def _get(self, id: str, fingerprint: str) -> IO[bytes]:
        """Fetch a video, and return its copy, locked against eviction."""
        try:
            with self._locked_slot(int(hashlib.sha256(id.encode()).hexdigest(), 16)) as slot:
                held = self._hold(self._path(id, fingerprint)) if fingerprint else None  # another process was faster
                return held or self._fetch(id, fingerprint, slot)
        except OSError as error:
            why = f"cannot be copied to {self.copies}: {error.strerror or error}"
            raise VideoUnreadable(id, None, why) from error

    @contextlib.contextmanager
    def _locked_slot(self, number: int) -> Iterator[Path]:
        """Lend a file to fetch into: the one of this number, or the next one if another process holds it.

        Raises:
            OSError: other processes hold all of them.
        """
        end = time.monotonic() + _SLOT_SECONDS
        for other in range(_SLOTS):
            slot = self.copies / PARTIAL / f"{(number + other) % _SLOTS:02}"
            with open(open_private(slot.with_suffix(".lock"), os.O_WRONLY | os.O_CREAT), "wb") as lock:
                if _lock(lock, end):
                    yield slot
                    return
        raise BlockingIOError(errno.EAGAIN, f"other processes keep all {_SLOTS} of its slots; end them")

    def _fetch(self, id: str, fingerprint: str, slot: Path) -> IO[bytes]:
        try:
            make_private(slot)
            self.bucket.fetch(id, slot)
            slot.chmod(0o600)  # where the store's own tools put another file there
            found = fingerprint_of(slot)
            if fingerprint and not is_same_file(found, fingerprint):
                why = f"changed in {self} since it was catalogued: {found} instead of {fingerprint}"
                raise VideoChanged(id, None, why)
            path = self._path(id, found)
            with slot.open("rb") as file:
                fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)  # the lock outlives renaming: no eviction in between
                self._place(id, slot, path)
                held = self._hold(path)
            if held is None:
                raise OSError("its copy was removed at once")
            return held
        finally:
            slot.unlink(missing_ok=True)

    def _place(self, id: str, slot: Path, path: Path) -> None:
        """Give the fetched file its name. If space runs out, evict copies without a reader, least recently read first.

        Raises:
            VideoUnreadable: the copies that are being read leave too little space.
        """
        size = slot.stat().st_size
        path.parent.mkdir(exist_ok=True)
        for wait in (_ROOM_SECONDS, _ROOM_SECONDS, 0.0):
            with locked_use(self.copies, _LOCK_SECONDS) as used:
                if used.bytes + size > self.most_bytes:
                    enough = max(0, int(self.most_bytes * _KEPT_SHARE) - size)
                    for oldest in _oldest_first(self.copies):
                        if used.bytes > enough:
                            used.add(-_evicted(oldest))
                if used.bytes + size <= self.most_bytes:
                    used.add(size - (path.stat().st_size if path.exists() else 0))
                    slot.replace(path)
                    return
            time.sleep(wait)
        why = f"its {size} bytes do not fit beside the {used.bytes} bytes that are being read: raise --copies-gib"
        raise VideoUnreadable(id, None, why)


def open_source(name: str, options: SourceOptions) -> Copies | None:
    """Open an address in object storage; None for any other name.

    Raises:
        UsageError, CorpusError: the address, the list or the folder of copies cannot be used.
    """
    if not is_url(name):
        return None
    if not options.copies_gib > 0:
        raise UsageError(f"--copies-gib {options.copies_gib:g}: give more than 0")
    folder = Path(options.copies or cache_folder(options.cache_dir) / "copies").absolute()
    copies = Copies(Bucket(name), folder, int(options.copies_gib * (1 << 30)), options.listed)
    copies.make()
    return copies


def _lock(file: IO[bytes], end: float) -> bool:
    """Try at least once, and until ``end`` (monotonic), to lock a file; return whether it is locked."""
    while True:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return True
        except BlockingIOError:
            if time.monotonic() >= end:
                return False
        time.sleep(_POLL_SECONDS)


def _oldest_first(folder: Path) -> list[Path]:
    found = []
    for below in folder.iterdir():
        if below.is_dir() and below.name != PARTIAL:
            with os.scandir(below) as entries:
                found += [(entry.stat().st_mtime_ns, entry.path) for entry in entries]
    return [Path(path) for _, path in sorted(found)]


def _evicted(path: Path) -> int:
    """Delete a copy, and return the bytes that this freed; 0 if it has a reader."""
    with contextlib.suppress(OSError), path.open("rb") as file:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        size = os.fstat(file.fileno()).st_size
        path.unlink()
        return size
    return 0

"""The folder of this host that videos are fetched to from object storage, once each.

A copy is named by a hash of address, id and fingerprint, so a changed object has another one, and what lies under a
name is what was catalogued. Any number of processes share a folder: who fetches a video holds a lock that the others
wait for, writes under another name, and renames. Who reads a copy holds a shared lock on it, which eviction respects:
when there is no room, those go that were not read for longest.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import hashlib
import os
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager, nullcontext
from functools import cached_property
from pathlib import Path, PurePosixPath
from typing import IO

from v2v_protocol.errors import CorpusError, UsageError, VideoChanged, VideoUnreadable
from v2v_server.cloud.bucket import TRIES, AccessDenied, Bucket, ObjectGone, ObjectState, StoreFault, is_url
from v2v_server.store.used import PARTIAL, locked_use
from v2v_server.system.private import make_private, open_private
from v2v_server.system.process import cache_folder
from v2v_server.video.fingerprint import fingerprint as fingerprint_of
from v2v_server.video.fingerprint import is_same_file

COPIES_GIB = 100.0
"""Unless somebody says otherwise."""
_SLOTS = 64
"""Videos that a host can fetch at a time; a process that is killed leaves at most that many parts behind."""
_KEPT_SHARE = 0.9
"""Of the room, after eviction: it looks at every file, so it makes room for more than one."""
_LOCK_SECONDS = 30.0
"""How long to wait for another process that makes room. No lease has begun yet, so no video is blamed for it."""
_SLOT_SECONDS = 20.0
"""How long to wait for another process that fetches a video of the same slot. After that the next free slot is used:
the process may be stopped, and one video fetched twice costs less than a worker that waits."""
_POLL_SECONDS = 0.05
_ROOM_SECONDS = 2.0
"""Until it is tried again where all copies are being read."""


class Copies:
    """The copies of one corpus. Can be pickled.

    Args:
        bucket: where the videos come from.
        folder: of the copies; may be that of other corpora, too.
        most_bytes: how much may lie there.
    """

    def __init__(self, bucket: Bucket, folder: Path, most_bytes: int) -> None:
        self.bucket, self.folder, self.most_bytes = bucket, folder, most_bytes
        self._at_hand: tuple[tuple[str, str], IO[bytes]] | None = None

    def __reduce__(self) -> tuple[type[Copies], tuple[Bucket, Path, int]]:
        return Copies, (self.bucket, self.folder, self.most_bytes)

    def __str__(self) -> str:
        return self.bucket.url

    def __fspath__(self) -> str:
        """For who names a corpus, not a file: :func:`v2v_server.corpus.refresh.index_path`."""
        return self.bucket.url

    @cached_property
    def listed(self) -> dict[str, ObjectState]:
        """What lay there when it was first asked.

        Raises:
            CorpusError: it cannot be listed.
        """
        return self.bucket.objects()

    def make(self) -> None:
        """Makes the folder.

        Raises:
            CorpusError: it cannot be made or written to.
        """
        try:
            (self.folder / PARTIAL).mkdir(parents=True, exist_ok=True)
            with locked_use(self.folder, _LOCK_SECONDS):
                pass
        except OSError as error:
            raise CorpusError(f"--copies {self.folder}: cannot be written to: {error.strerror or error}") from error

    def is_there(self, id: str, size_bytes: int, mark: int) -> bool:
        """Whether the object is as it was catalogued, as far as can be told: of a store that does not answer nothing
        bad is assumed. Asks once."""
        try:
            return self.bucket.state(id, tries=1) == ObjectState(size_bytes, mark)
        except ObjectGone:
            return False
        except (AccessDenied, StoreFault):
            return True

    def state(self, id: str) -> tuple[int, int, int]:
        """(size in bytes, mark, 0), as the catalogue keeps size and times of a file.

        Raises:
            VideoUnreadable: that cannot be told.
        """
        try:
            state = self.bucket.state(id)
        except (ObjectGone, AccessDenied, StoreFault) as error:
            raise VideoUnreadable(id, None, f"cannot be looked at: {error}") from error
        return state.size_bytes, state.mark, 0

    def has(self, id: str, fingerprint: str) -> bool:
        """Whether the copy is there. If so, it stays until the next one is asked for, or fetched."""
        if self._at_hand is not None and self._at_hand[0] == (id, fingerprint):
            return True
        held = self._hold(self._path(id, fingerprint))
        if held is not None:
            self._keep(id, fingerprint, held)
        return held is not None

    def fetch(self, id: str, fingerprint: str) -> None:
        """Makes sure that the copy is there; afterwards :meth:`has` says so.

        Raises:
            VideoUnreadable: it cannot be had.
            VideoChanged: the object is another one by now.
        """
        self.release()
        self._keep(id, fingerprint, self._get(id, fingerprint))

    @contextlib.contextmanager
    def open_local(self, id: str, fingerprint: str) -> Iterator[Path]:
        """The copy of a video, which stays until the end of the context.

        Args:
            fingerprint: of the video as it was catalogued; "" takes what is there now.

        Raises:
            VideoUnreadable, VideoChanged: as of :meth:`fetch`.
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
        """Nothing is kept from eviction any more."""
        if self._at_hand is not None:
            self._at_hand[1].close()
            self._at_hand = None

    def _path(self, id: str, fingerprint: str) -> Path:
        mark = "-".join(fingerprint.split("-")[:2])  # what a file's head and tail tell
        key = hashlib.sha256(repr((self.bucket.url, id, mark)).encode()).hexdigest()[:32]
        return self.folder / key[:2] / f"{key}{PurePosixPath(id).suffix}"

    def _hold(self, path: Path) -> IO[bytes] | None:
        """The open copy, locked against eviction; None if it is not there."""
        with contextlib.ExitStack() as undo, contextlib.suppress(OSError):  # evicted, before or just now
            file = undo.enter_context(path.open("rb"))
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)  # a copy that another process locks is fetched again
            if os.path.samestat(os.fstat(file.fileno()), path.stat()):
                os.utime(path)
                undo.pop_all()
                return file
        return None

    def _get(self, id: str, fingerprint: str) -> IO[bytes]:
        """Fetches a video; returns the held copy."""
        try:
            with self._locked_slot(int(hashlib.sha256(id.encode()).hexdigest(), 16)) as slot:
                held = self._hold(self._path(id, fingerprint)) if fingerprint else None  # another process was faster
                return held or self._fetch(id, fingerprint, slot)
        except ObjectGone as error:
            raise VideoUnreadable(id, None, f"is not in {self} any more") from error
        except AccessDenied as error:
            raise VideoUnreadable(id, None, f"cannot be fetched, access is denied: {error}") from error
        except StoreFault as error:
            raise VideoUnreadable(id, None, f"cannot be fetched after {TRIES} tries: {error}") from error
        except OSError as error:
            why = f"cannot be copied to {self.folder}: {error.strerror or error}"
            raise VideoUnreadable(id, None, why) from error

    @contextlib.contextmanager
    def _locked_slot(self, number: int) -> Iterator[Path]:
        """Lend a file to fetch into: that of the number, or the next one where another process keeps it.

        Raises:
            OSError: none can be had.
        """
        end = time.monotonic() + _SLOT_SECONDS
        for other in range(_SLOTS):
            slot = self.folder / PARTIAL / f"{(number + other) % _SLOTS:02}"
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
                fcntl.flock(
                    file, fcntl.LOCK_SH | fcntl.LOCK_NB
                )  # of the file under whatever name: nobody evicts it meanwhile
                self._place(id, slot, path)
                held = self._hold(path)
            if held is None:
                raise OSError("its copy was removed at once")
            return held
        finally:
            slot.unlink(missing_ok=True)

    def _place(self, id: str, slot: Path, path: Path) -> None:
        """Gives what was fetched its name. Where there is no room, copies that nobody reads make some, those not read
        for longest first.

        Raises:
            VideoUnreadable: there is none all the same.
        """
        size = slot.stat().st_size
        path.parent.mkdir(exist_ok=True)
        for wait in (_ROOM_SECONDS, _ROOM_SECONDS, 0.0):
            with locked_use(self.folder, _LOCK_SECONDS) as used:
                if used.bytes + size > self.most_bytes:
                    enough = max(0, int(self.most_bytes * _KEPT_SHARE) - size)
                    for oldest in _oldest_first(self.folder):
                        if used.bytes > enough:
                            used.add(-_evicted(oldest))
                if used.bytes + size <= self.most_bytes:
                    used.add(size - (path.stat().st_size if path.exists() else 0))
                    slot.replace(path)
                    return
            time.sleep(wait)
        why = f"its {size} bytes find no room beside the {used.bytes} that are being read: raise --copies-gib"
        raise VideoUnreadable(id, None, why)


def copies_of(
    source: str, folder: str | os.PathLike[str] | None, gib: float, cache_dir: str | os.PathLike[str] | None = None
) -> Copies | None:
    """The copies of a corpus that is named by an address; None of one that is named by a path.

    Args:
        source: of the corpus, as a user names it.
        folder: of the copies; None: ``copies`` in the folder of indexes.
        gib: at most so much lies there, GiB.
        cache_dir: see :func:`v2v_server.system.process.cache_folder`.

    Raises:
        UsageError, CorpusError: the address or the folder cannot serve.
    """
    if not is_url(source):
        return None
    if not gib > 0:
        raise UsageError(f"--copies-gib {gib:g}: give more than 0")
    copies = Copies(Bucket(source), Path(folder or cache_folder(cache_dir) / "copies").absolute(), int(gib * (1 << 30)))
    copies.make()
    return copies


def open_local(root: Path | Copies, id: str, fingerprint: str) -> AbstractContextManager[Path]:
    """The file of a video for as long as the context lasts, be it in a folder or in object storage.

    Raises:
        VideoUnreadable, VideoChanged: as of :meth:`Copies.open_local`; of a folder, whoever opens the file finds out.
    """
    return root.open_local(id, fingerprint) if isinstance(root, Copies) else nullcontext(root / id)


def _lock(file: IO[bytes], end: float) -> bool:
    """Try to lock a file until then, once at least; return whether it is."""
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
    """The bytes that it freed; none where somebody reads it."""
    with contextlib.suppress(OSError), path.open("rb") as file:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        size = os.fstat(file.fileno()).st_size
        path.unlink()
        return size
    return 0

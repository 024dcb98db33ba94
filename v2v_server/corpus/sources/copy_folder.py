"""A folder of copies of files that lie elsewhere, each fetched once to this host.

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
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path, PurePosixPath
from typing import IO

from v2v_protocol.errors import CorpusError, VideoUnreadable, system_errors
from v2v_server.store.quota import PARTIAL, QuotaFolder
from v2v_server.system.process import locked, make_private

_SLOTS = 64
"""Videos that a host can fetch at a time, and so the most unfinished files that killed processes leave behind."""
_LOCK_SECONDS = 30.0
"""Longest wait for another process that evicts copies. No lease has begun yet, so no video is blamed for it."""
_SLOT_SECONDS = 20.0
"""Longest wait for another process that fetches a video of the same slot. Then the next free slot is used: the process
may be stopped, and fetching one video twice costs less than a waiting worker."""
_ROOM_SECONDS = 2.0
"""Wait before the next try if all copies are being read."""


class CopyFolder:
    """Copies of the files of an address.

    Args:
        url: the address.
        folder: of the copies; other corpora may share it.
        most_bytes: limit of the folder.
        write: fetches a file, (id, fingerprint, where to write it), and returns the fingerprint of what was written.
            Raises as :meth:`fetch`.
    """

    def __init__(self, url: str, folder: Path, most_bytes: int, write: Callable[[str, str, Path], str]) -> None:
        self.folder, self.most_bytes = folder, most_bytes
        self._url, self._write = url, write
        self._quota = QuotaFolder(folder, most_bytes, _LOCK_SECONDS)
        self._at_hand: dict[tuple[str, str], IO[bytes]] = {}

    def make(self) -> None:
        """Create the folder of copies.

        Raises:
            CorpusError: it cannot be created or written to.
        """
        with system_errors(CorpusError, f"--copies {self.folder}: cannot be written to"):
            self._quota.make()

    def has(self, files: Mapping[str, str]) -> bool:
        """Return whether the copies are there. If so, they stay until others are asked for, or fetched."""
        if self._at_hand.keys() == files.items():
            return True
        held: dict[tuple[str, str], IO[bytes]] = {}
        for id, fingerprint in files.items():
            copy = self._hold(self._path(id, fingerprint))
            if copy is None:
                _close(held)
                return False
            held[id, fingerprint] = copy
        self.release()
        self._at_hand = held
        return True

    def fetch(self, files: Mapping[str, str]) -> None:
        """Fetch the copies that are missing; afterwards :meth:`has` returns True.

        Raises:
            VideoUnreadable: one cannot be fetched.
            VideoChanged: an object is another one by now.
        """
        self.release()
        for id, fingerprint in files.items():
            self._at_hand[id, fingerprint] = self._get(id, fingerprint)

    @contextlib.contextmanager
    def lend(self, id: str, fingerprint: str) -> Iterator[Path]:
        """Lend the copy of a video until the end of the context.

        Args:
            fingerprint: of the video as catalogued; "" fetches what is there now.

        Raises:
            VideoUnreadable, VideoChanged: see :meth:`fetch`.
        """
        if (id, fingerprint) in self._at_hand:
            yield self._path(id, fingerprint)
            return
        held = self._hold(self._path(id, fingerprint)) if fingerprint else None
        if held is None:
            self.release()
            held = self._get(id, fingerprint)
        with held:
            yield Path(held.name)

    def keep_as(self, id: str, found: str, fingerprint: str) -> None:
        """Let the copy that was made for probing be found under the video's full fingerprint.

        Args:
            found: fingerprint of the file, its size, head and tail.
            fingerprint: the full one.
        """
        # A link, because another process may be reading the copy under its first name, which then stays.
        with contextlib.suppress(OSError), self._locked_slot(id) as slot:
            slot.unlink(missing_ok=True)
            try:
                slot.hardlink_to(self._path(id, found))
                self._quota.remove(self._path(id, found))
                self._quota.add(slot, self._path(id, fingerprint), evicts=True)
            finally:
                slot.unlink(missing_ok=True)

    def release(self) -> None:
        """Allow eviction of the copies that :meth:`has` or :meth:`fetch` keeps."""
        _close(self._at_hand)
        self._at_hand = {}

    def _path(self, id: str, fingerprint: str) -> Path:
        # All of the fingerprint: the copy of an object that changed in the middle only has another name.
        key = hashlib.sha256(repr((self._url, id, fingerprint)).encode()).hexdigest()[:32]
        return self.folder / key[:2] / f"{key}{PurePosixPath(id).suffix}"

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
        unreadable = partial(VideoUnreadable, id, None)
        with system_errors(unreadable, f"cannot be copied to {self.folder}"), self._locked_slot(id) as slot:
            held = self._hold(self._path(id, fingerprint)) if fingerprint else None  # another process was faster
            return held or self._fetch(id, fingerprint, slot)

    @contextlib.contextmanager
    def _locked_slot(self, id: str) -> Iterator[Path]:
        """Lend a file to fetch into: the one of this id, or the next one if another process holds it.

        Raises:
            OSError: other processes hold all of them.
        """
        end, held = time.monotonic() + _SLOT_SECONDS, contextlib.ExitStack()
        number = int(hashlib.sha256(id.encode()).hexdigest(), 16)
        for other in range(_SLOTS):
            slot = self.folder / PARTIAL / f"{(number + other) % _SLOTS:02}"
            with contextlib.suppress(BlockingIOError):
                held.enter_context(locked(slot.with_suffix(".lock"), end - time.monotonic()))
                break
        else:
            raise BlockingIOError(errno.EAGAIN, f"other processes keep all {_SLOTS} of its slots; end them")
        with held:
            yield slot

    def _fetch(self, id: str, fingerprint: str, slot: Path) -> IO[bytes]:
        try:
            make_private(slot)
            found = self._write(id, fingerprint, slot)
            path = self._path(id, fingerprint or found)
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
        for wait in (_ROOM_SECONDS, _ROOM_SECONDS, 0.0):
            if self._quota.add(slot, path, evicts=True):
                return
            time.sleep(wait)
        why = (
            f"its {slot.stat().st_size} bytes do not fit beside the {self._quota.used_bytes} bytes that are being read"
        )
        raise VideoUnreadable(id, None, f"{why}: raise --copies-gib")


def _close(held: Mapping[tuple[str, str], IO[bytes]]) -> None:
    for file in held.values():
        file.close()

"""Videos in object storage, each fetched once to a folder of this host.

A copy is named by a hash of address, id and fingerprint, so a changed object gets another name, and the content of a
name is what was catalogued. Any number of processes share a folder. The process that fetches a video holds a lock that
the others wait for, writes under another name, and renames. A reader holds a shared lock on its copy, which eviction
respects. If space runs out, the least recently read copies are evicted.

Each store has exceptions of its own. Here they become the three of every source: gone, denied, and everything else,
which may pass.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import hashlib
import os
import posixpath
import random
import re
import time
from array import array
from bisect import bisect_left
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cached_property
from importlib import import_module
from itertools import takewhile
from pathlib import Path, PurePosixPath
from typing import IO, Any, TypeVar
from zipfile import Path as ZipPath
from zipfile import ZipFile

from v2v_protocol.errors import (
    CorpusError,
    ProtocolError,
    UsageError,
    VideoChanged,
    VideoDenied,
    VideoGone,
    VideoUnreadable,
)
from v2v_protocol.programs import printable
from v2v_server.corpus.sources.source import (
    GONE,
    MANIFEST_NAME,
    NO_STATE,
    UNPRINTABLE,
    FileState,
    ListEntry,
    SourceOptions,
    VideoSource,
    answers,
    count_left_out,
    is_sidecar,
    sidecar_fingerprint,
    state_text,
)
from v2v_server.kinds.registry import KINDS, kind_of
from v2v_server.store.quota import MOST_GIB, PARTIAL, QuotaFolder
from v2v_server.store.verified import content_of
from v2v_server.system.process import cache_folder, locked, make_private
from v2v_server.video.fingerprint import TIMES_ABOVE, check_content, is_same_file
from v2v_server.video.fingerprint import fingerprint as video_fingerprint

T = TypeVar("T")

TRIES = 3
_FIRST_WAIT_SECONDS = 0.5
_MARKS = ("ETag", "etag", "md5Hash", "generation", "blob_id", "mtime", "created", "Last-Modified")
"""What names a state of an object: the terms of S3, Google, Hugging Face, a disk, memory, HTTP."""
_OPTIONS: dict[str, dict[str, Any]] = {
    # No cached listings: they would hide that an object was deleted. We retry ourselves.
    "s3": {"use_listings_cache": False, "config_kwargs": {"connect_timeout": 5, "read_timeout": 15}},
    "gs": {"use_listings_cache": False},
    "hf": {"use_listings_cache": False},
}
_CREDENTIALS = re.compile("credential|token|unauthorized|forbidden|accesskey", re.IGNORECASE)


def is_url(source: str) -> bool:
    """Return whether a corpus is named by an address rather than a path."""
    return re.match(r"[a-z][a-z0-9+.-]+://", source) is not None


class Bucket:
    """An address such as ``s3://bucket/prefix``. Credentials are found as the store's own tools find them: environment,
    profile, role of the machine.

    Args:
        url: the address.
        only: the only object that is listed; "" lists all.

    Raises:
        UsageError: it contains a password, which would be shown wherever the address is.
    """

    def __init__(self, url: str, only: str = "") -> None:
        self.url, self.only = url.rstrip("/"), only
        if "@" in self.url.partition("://")[2].partition("/")[0]:
            raise UsageError("--videos: leave user and password out of the address; its store's own settings hold them")

    @cached_property
    def _store(self) -> Any:
        """Return the file system of fsspec.

        Raises:
            UsageError: a package is missing, or fsspec has no such kind of address.
        """
        kind = self.url.partition("://")[0]
        try:
            store = import_module("fsspec").filesystem(kind, **_OPTIONS.get(kind, {}))
        except ImportError as error:
            raise UsageError(
                f"--videos {self.url}: {error}; the extra 'cloud' brings fsspec and s3fs: pip install "
                "'.[server,cloud]' in a checkout of v2v-stream. Other stores need a package more: gcsfs for gs://, "
                "huggingface_hub for hf://"
            ) from error
        except ValueError as error:
            raise UsageError(f"--videos {self.url}: {error}") from error
        if hasattr(store, "retries"):
            store.retries = 1
        return store

    @cached_property
    def _prefix(self) -> str:
        return str(self._store._strip_protocol(self.url)).rstrip("/")

    def objects(self) -> dict[str, FileState]:
        """Return the states of all objects below the address, by relative path.

        Raises:
            CorpusError: they cannot be listed.
        """
        try:
            return {self.only: self.state(self.only)} if self.only else self.find("")
        except VideoGone as error:
            what = f"file {self.only}" if self.only else "bucket or prefix"
            raise CorpusError(f"--videos {self.url}: there is no such {what}") from error
        except VideoDenied as error:
            raise CorpusError(
                f"--videos {self.url}: {error.reason}: give this user credentials of the store as its own "
                "tools take them (for s3:// AWS_PROFILE, or AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY; and "
                "AWS_ENDPOINT_URL where it is not Amazon's) that may list and read"
            ) from error
        except VideoUnreadable as error:
            raise CorpusError(f"--videos {self.url}: cannot be listed: {error.reason}") from error

    def find(self, below: str, tries: int = TRIES) -> dict[str, FileState]:
        """Return the states of all objects below a folder of the address, "" or ending in a slash, by relative path.

        Listings over HTTP state no sizes: there each object is asked for its state.

        Raises:
            VideoGone, VideoDenied, VideoUnreadable: they cannot be listed.
        """

        def asked(name: str) -> FileState:
            try:
                return self.state(below + name, tries)
            except VideoUnreadable:
                return NO_STATE

        start = f"{self._prefix}/{below}"
        listed = self._ask(below, lambda: self._store.find(start.rstrip("/"), detail=True), tries)
        found = {path[len(start) :]: info for path, info in listed.items() if path.startswith(start) and path != start}
        states = {name: _state(info) for name, info in found.items() if info.get("size") is not None}
        states.update(answers(asked, [name for name in found if name not in states]))
        if below and not found:
            raise VideoGone(below, None, f"is not in {self.url} any more")
        return states

    def state(self, id: str, tries: int = TRIES) -> FileState:
        """Ask for the state of one object: its size, and 63 bits that stand for its ETag or the store's equivalent.

        Raises:
            VideoGone, VideoDenied, VideoUnreadable: the store does not deliver it.
        """
        return self._ask(id, lambda: _state(self._store.info(self._path(id))), tries)

    def fetch(self, id: str, to: Path) -> None:
        """Write an object to a file.

        Raises:
            VideoGone, VideoDenied, VideoUnreadable: the store does not deliver it.
        """
        self._ask(id, lambda: self._store.get_file(self._path(id), str(to)))

    def _path(self, id: str) -> str:
        if PurePosixPath(id).is_absolute() or ".." in PurePosixPath(id).parts:
            raise ProtocolError(f"video id {id!r} leads out of {self.url}")
        return f"{self._prefix}/{id}"

    def _ask(self, id: str, question: Callable[[], T], tries: int = TRIES) -> T:
        """Return an answer of the store. A question that may succeed later is repeated after a pause that doubles."""
        self._store  # noqa: B018 - errors of the installation are not the store's
        for left in reversed(range(tries)):
            try:
                return question()
            except ProtocolError:
                raise
            except Exception as error:
                # fsspec reports any failure over HTTP as a missing file; its cause is an answer's status or an OSError.
                is_wrapped = hasattr(error.__cause__, "status") or isinstance(error.__cause__, OSError)
                why = error.__cause__ if is_wrapped else error
                status = getattr(why, "status", 404 if isinstance(why, FileNotFoundError) else 0)
                if status in (404, 410):
                    raise VideoGone(id, None, f"is not in {self.url} any more") from error
                said = " ".join(f"{type(why).__name__}: {why}".split())[:300]
                is_denied = isinstance(why, PermissionError) or status in (401, 403)
                if is_denied or _CREDENTIALS.search(type(why).__name__):
                    raise VideoDenied(id, None, f"access is denied ({said})") from error
                if not left:
                    raise VideoUnreadable(
                        id, None, f"the store gives no answer ({said}; tried {tries} times)"
                    ) from error
            time.sleep(_FIRST_WAIT_SECONDS * 2 ** (tries - left - 1) * random.uniform(1, 1.5))
        raise AssertionError


def _state(info: dict[str, Any]) -> FileState:
    mark, size = next((str(info[key]) for key in _MARKS if info.get(key) is not None), ""), info.get("size")
    if size is None:  # answered in chunks: without a mark either, nothing tells a change
        size = 0 if mark else NO_STATE[0]
    return int(size), int.from_bytes(hashlib.sha256(mark.encode()).digest()[:8]) >> 1, 0


_ZIP_EPOCH = 315_619_200
"""A time that archives can state, 1980-01-02, in seconds since 1970."""
_SLOTS = 64
"""Videos that a host can fetch at a time, and so the most unfinished files that killed processes leave behind."""
_LOCK_SECONDS = 30.0
"""Longest wait for another process that evicts copies. No lease has begun yet, so no video is blamed for it."""
_SLOT_SECONDS = 20.0
"""Longest wait for another process that fetches a video of the same slot. Then the next free slot is used: the process
may be stopped, and fetching one video twice costs less than a waiting worker."""
_ROOM_SECONDS = 2.0
"""Wait before the next try if all copies are being read."""


class Copies(VideoSource):
    """The videos of an address, and their copies.

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
        self._quota = QuotaFolder(copies, most_bytes, _LOCK_SECONDS)
        self._at_hand: dict[tuple[str, str], IO[bytes]] = {}

    @property
    def copies_options(self) -> tuple[Path, float]:
        """Return the folder of copies and its limit, see :attr:`VideoSource.copies_options`."""
        return self.copies, self.most_bytes / (1 << 30)

    @cached_property
    def _objects(self) -> dict[str, FileState]:
        """Return the objects, as first listed.

        Raises:
            CorpusError: they cannot be listed.
        """
        return self.bucket.objects()

    @cached_property
    def _names(self) -> list[str]:
        return sorted(self._objects)

    def videos(self, refused: dict[str, str], left_out: Counter[str]) -> Iterator[str]:
        """List the objects that a folder would list as videos, see :meth:`VideoSource.videos`.

        Raises:
            CorpusError: it is a prepared corpus.
        """
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
            if not (id := self.kind.id_of(name)) and self.kind.id_of(name.partition("?")[0]):
                refused[printable(name)] = "is a link with a query, which is not followed: link to the file itself"
            elif not id:
                count_left_out(parts[-1], left_out)
            elif printable(name) != name:
                refused[printable(name)] = UNPRINTABLE
            elif "" in parts or id == "/":
                refused[name] = "has an empty part between two slashes, or is a picture outside of a folder"
            else:
                yield id

    def make(self) -> None:
        """Create the folder of copies.

        Raises:
            CorpusError: it cannot be created or written to.
        """
        try:
            self._quota.make()
        except OSError as error:
            raise CorpusError(f"--copies {self.copies}: cannot be written to: {error.strerror or error}") from error

    def states(self, ids: Sequence[str]) -> array[int]:
        """Return the states of many objects, from the listing."""
        found = array("q")
        for id in ids:
            found.extend(self.state(id, None if self.bucket.only else self._objects))
        return found

    def state(self, id: str, listed: Mapping[str, FileState] | None = None, tries: int = TRIES) -> FileState:
        """Return the state of one video, from the listing or else from the store.

        Raises:
            VideoUnreadable: the store does not answer, or has no such object.
        """
        if id.endswith("/"):
            return self.state_of_parts(id, self._parts(id, listed, tries))
        size, content, _ = self.bucket.state(id, tries) if listed is None else listed.get(id, GONE)
        return size, content, self.mark(id)

    def _parts(
        self, id: str, listed: Mapping[str, FileState] | None = None, tries: int = TRIES
    ) -> list[tuple[str, FileState]]:
        """Return the objects that make up a folder of pictures, by their places from there, and their states."""
        names = (
            self.bucket.find(id, tries)
            if listed is None
            else {name[len(id) :]: listed[name] for name in self._below(id)}
        )
        found = {name: state for name, state in names.items() if "/" not in name}
        for name in TIMES_ABOVE:
            with contextlib.suppress(VideoGone, KeyError):
                place = posixpath.normpath(id + name)
                found[name] = self.bucket.state(place, tries) if listed is None else listed[place]
        return sorted(found.items())

    def verify(self, id: str, fingerprint: str, state: FileState | str | None) -> None:
        """Check an object, or a sidecar, against its state, with one question. If the store gives no answer, that is no
        error.

        Raises:
            VideoGone, VideoChanged: the object is gone, or another one by now.
        """
        try:
            if is_sidecar(id):
                found = self.bucket.find(id, tries=1) if id.endswith("/") else {"": self.bucket.state(id, tries=1)}
                changed = state_text(sorted(found.items())) != state and state is not None
            else:
                changed = self.state(id, tries=1) != state and state is not None
        except VideoGone:
            raise
        except VideoUnreadable:
            return
        except OSError:  # beyond the limits of a sidecar
            changed = True
        if changed:
            raise VideoChanged(id, None, f"changed in {self} since it was catalogued")

    def sidecar_state(self, id: str) -> str | OSError:
        """Return a text that stands for the listed objects' states, see :meth:`VideoSource.sidecar_state`."""
        try:
            return state_text((name[len(id) :], self._objects[name]) for name in self._below(id))
        except OSError as error:
            return error

    def _below(self, id: str) -> Iterator[str]:
        """Yield the names of the listed objects of a sidecar, sorted."""
        if id.endswith("/"):
            following = (self._names[at] for at in range(bisect_left(self._names, id), len(self._names)))
            yield from takewhile(lambda name: name.startswith(id), following)
        elif id in self._objects:
            yield id

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
    def open_local(self, id: str, fingerprint: str) -> Iterator[Path]:
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
        """See :meth:`VideoSource.keep_as`."""
        # A link, because another process may be reading the copy under its first name, which then stays.
        with contextlib.suppress(OSError), self._locked_slot(_slot_number(id)) as slot:
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
        key = hashlib.sha256(repr((self.bucket.url, id, fingerprint)).encode()).hexdigest()[:32]
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
            with self._locked_slot(_slot_number(id)) as slot:
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
        end, held = time.monotonic() + _SLOT_SECONDS, contextlib.ExitStack()
        for other in range(_SLOTS):
            slot = self.copies / PARTIAL / f"{(number + other) % _SLOTS:02}"
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
            is_expected = self._is_expected(id)
            if id.endswith("/"):
                self._pack(id, slot)
            else:
                self.bucket.fetch(id, slot)
            slot.chmod(0o600)  # where the store's own tools put another file there
            found = self._fingerprint(id, slot)
            if fingerprint and not is_same_file(found, fingerprint):
                why = f"changed in {self} since it was catalogued: {found} instead of {fingerprint}"
                raise VideoChanged(id, None, why)
            if id == self._expected[0] and not (is_expected and self._is_expected(id)):
                self._check_content(id, slot, fingerprint)
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

    def _pack(self, id: str, slot: Path) -> None:
        """Fetch a folder into one file, a ZIP archive without compression."""
        part = slot.with_suffix(".part")
        try:
            with ZipFile(slot, "w") as packed:
                for name in self.bucket.find(id) if is_sidecar(id) else dict(self._parts(id)):
                    place = posixpath.normpath(id + name) if name in TIMES_ABOVE else id + name
                    self.bucket.fetch(place, part)
                    part.chmod(0o600)
                    os.utime(part, (_ZIP_EPOCH, _ZIP_EPOCH))  # equal objects give equal archives
                    packed.write(part, name)
        finally:
            part.unlink(missing_ok=True)

    def _fingerprint(self, id: str, slot: Path) -> str:
        if not is_sidecar(id):
            return video_fingerprint(slot)
        if not id.endswith("/"):
            return sidecar_fingerprint(slot)
        with ZipFile(slot) as packed:
            return sidecar_fingerprint(ZipPath(packed))

    def _check_content(self, id: str, slot: Path, fingerprint: str) -> None:
        """Read all of a fetched video, whose object did not have the catalogued mark before and after.

        Raises:
            VideoError: it is not the catalogued one.
        """
        named = slot.with_name(f"{slot.name}-of{PurePosixPath(id).suffix}")  # FFmpeg looks at the ending as well
        named.unlink(missing_ok=True)
        named.symlink_to(slot.name)
        try:
            with kind_of(id).open_pixels(named) as pixels:
                check_content(named, content_of(pixels), fingerprint)
        finally:
            named.unlink()

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


def open_source(name: str, options: SourceOptions) -> Copies | None:
    """Open an address in object storage; None for any other name.

    Raises:
        UsageError, CorpusError: the address or a setting is malformed, or there is no folder for copies.
    """
    if not is_url(name):
        return None
    if not 0 < options.copies_gib <= MOST_GIB:
        raise UsageError(f"--copies-gib {options.copies_gib:g}: give more than 0, at most {MOST_GIB:g}")
    folder = Path(options.copies or cache_folder(options.cache_dir) / "copies").absolute()
    bucket, listed, (above, _, file) = Bucket(name), options.listed, name.rpartition("/")
    if options.list_file is None and any(kind.id_of(file) == file != "" for kind in KINDS.values()):
        bucket, listed = Bucket(above, file), lambda: (ListEntry(file),)
    return Copies(bucket, folder, int(options.copies_gib * (1 << 30)), listed)


def _slot_number(id: str) -> int:
    return int(hashlib.sha256(id.encode()).hexdigest(), 16)


def _close(held: Mapping[tuple[str, str], IO[bytes]]) -> None:
    for file in held.values():
        file.close()

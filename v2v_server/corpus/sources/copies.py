"""Videos in object storage, each fetched once to a folder of this host.

Each store has exceptions of its own. Here they become the three of every source: gone, denied, and everything else,
which may pass.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import os
import posixpath
import random
import re
import time
import zlib
from array import array
from bisect import bisect_left
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager
from functools import cached_property
from importlib import import_module
from io import BytesIO
from itertools import takewhile
from pathlib import Path, PurePosixPath
from tempfile import TemporaryDirectory
from typing import Any, TypeVar
from zipfile import Path as ZipPath
from zipfile import ZipFile

from v2v_protocol.errors import (
    CorpusError,
    ProtocolError,
    UsageError,
    VideoChanged,
    VideoDenied,
    VideoError,
    VideoGone,
    VideoUnreadable,
)
from v2v_protocol.programs import install_line, printable
from v2v_server.corpus.sources.archives import (
    MOST_DIRECTORY_BYTES,
    MOST_ZIP_HEAD_BYTES,
    ZIP_END_BYTES,
    ZIP_HEAD_BYTES,
    MemberPath,
    directory_bytes,
    find_archive,
    is_deflated,
    name_in,
    same_ids,
    zip_head_rest,
)
from v2v_server.corpus.sources.copy_folder import CopyFolder
from v2v_server.corpus.sources.listing import ListEntry, answers, count_left_out
from v2v_server.corpus.sources.object_parts import PART_BYTES, ReadBytes, copy_bytes, inflate, open_part
from v2v_server.corpus.sources.sidecars import is_sidecar, sidecar_fingerprint, state_of_parts, state_text
from v2v_server.corpus.sources.source import (
    GONE,
    MANIFEST_NAME,
    NO_STATE,
    UNPRINTABLE,
    FileState,
    MemberPlace,
    SourceOptions,
    VideoSource,
    is_expected,
    mark_of,
    unmarked,
)
from v2v_server.kinds.registry import KINDS, kind_of
from v2v_server.store.quota import MOST_GIB
from v2v_server.store.verified import content_of
from v2v_server.system.process import cache_folder
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
                f"--videos {self.url}: {error}; the extra 'cloud' brings fsspec and s3fs: "
                f"{install_line('server,cloud')}. Other stores need a package more: gcsfs for gs://, huggingface_hub "
                "for hf://"
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

    def state(self, id: str, tries: int = TRIES, member: str = "") -> FileState:
        """Ask for the state of one object: its size, and 63 bits that stand for its ETag or the store's equivalent.

        Args:
            member: of the object, if it is an archive: what errors name.

        Raises:
            VideoGone, VideoDenied, VideoUnreadable: the store does not deliver it.
        """
        return self._ask(member or id, lambda: _state(self._store.info(self._path(id))), tries)

    def fetch(self, id: str, to: Path) -> None:
        """Write an object to a file.

        Raises:
            VideoGone, VideoDenied, VideoUnreadable: the store does not deliver it.
        """
        self._ask(id, lambda: self._store.get_file(self._path(id), str(to)))

    def read(
        self,
        id: str,
        part: tuple[int, int],
        is_same: Callable[[FileState], bool],
        use: Callable[[ReadBytes], T],
        tries: int = TRIES,
        member: str = "",
    ) -> T:
        """Pass a part of an object on, and return what is made of it. All bytes are of the same state.

        Args:
            part: its first byte, and the byte behind the last; that is 0 for the end of the object.
            is_same: returns whether a state is the catalogued one.
            use: reads the bytes. It is called once more if a try fails.
            member: see :meth:`state`.

        Raises:
            VideoGone, VideoDenied, VideoUnreadable: the store does not deliver it.
            VideoChanged: it is another object by now.
        """

        def check(state: FileState) -> None:
            if not is_same(state):
                raise VideoChanged(member or id, None, f"changed in {self.url} since it was catalogued: {id} differs")

        def question() -> T:
            with open_part(self._store, self._path(id), *part) as (read, told):
                check(self.state(id, tries, member) if told is None else _state(told))
                used = use(read)
                if told is None:
                    check(self.state(id, tries, member))
                return used

        return self._ask(member or id, question, tries)

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
            except (ProtocolError, VideoError):
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


def _state(info: Mapping[str, Any]) -> FileState:
    mark, size = next((str(info[key]) for key in _MARKS if info.get(key) is not None), ""), info.get("size")
    if size is None:  # answered in chunks: without a mark either, nothing tells a change
        size = 0 if mark else NO_STATE[0]
    return int(size), int.from_bytes(hashlib.sha256(mark.encode()).digest()[:8]) >> 1, 0


_ZIP_EPOCH = 315_619_200
"""A time that archives can state, 1980-01-02, in seconds since 1970."""


class Copies(VideoSource):
    """The videos of an address, and their copies.

    Args:
        bucket: where the videos come from.
        copies, most_bytes: see :class:`CopyFolder`.
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
        self.bucket = bucket
        self.copies: CopyFolder = CopyFolder(bucket.url, copies, most_bytes, self._write)

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
        if (listed := self.listed()) is not None:
            yield from (
                entry.id if entry.id in self._objects else self.archive_of(entry.id) or entry.id for entry in listed
            )
            return
        for name in self._objects:
            parts = name.split("/")
            if any(part.startswith(".") for part in parts):
                continue
            if not (id := self.kind.entry_of(name)) and self.kind.entry_of(name.partition("?")[0]):
                refused[printable(name)] = "is a link with a query, which is not followed: link to the file itself"
            elif not id:
                count_left_out(parts[-1], left_out)
            elif printable(name) != name:
                refused[printable(name)] = UNPRINTABLE
            elif "" in parts or id == "/":
                refused[name] = "has an empty part between two slashes, or is a picture outside of a folder"
            elif why := same_ids(name, self.kind.archive_endings, self._is_there):
                refused[name] = why
            else:
                yield id

    def archive_of(self, id: str) -> str:
        """Return the listed archive that the id of a member leads into; "" if it leads into none."""
        return find_archive(id, self.kind.archive_endings, self._is_folder, self._objects.__contains__)

    def _is_folder(self, path: str) -> bool:
        return next(self._below(f"{path}/"), None) is not None

    def _is_there(self, path: str) -> bool:
        return path in self._objects or self._is_folder(path)

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
        if member := self._member(id):  # what delivers its bytes checks the archive
            return unmarked(self, id, member.state)
        if id.endswith("/"):
            return state_of_parts(self, id, self._parts(id, listed, tries))
        size, content, _ = self.bucket.state(id, tries) if listed is None else listed.get(id, GONE)
        return size, content, mark_of(self, id)

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
            elif member := self._member(id, unmarked(self, id, state) if isinstance(state, tuple) else ()):
                changed = not member.is_in(self.bucket.state(member.archive, tries=1, member=id))
            elif state is None and self.archive_of(id):
                return  # in which state it was is not known
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
            if self.tables and (table := self.tables.get(archive := self.archive_of(id))):
                member = MemberPath(archive, 0, name_in(archive, id), table)  # type: ignore[abstract]
                if member.is_dir() if id.endswith("/") else member.is_file():
                    raise OSError(errno.ENOTSUP, "lies in an archive of object storage, where none is read: unpack it")
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

    def open_local(self, id: str, fingerprint: str) -> AbstractContextManager[Path]:
        """Lend the copy of a video, see :meth:`CopyFolder.lend`."""
        return self.copies.lend(id, fingerprint)

    def _write(self, id: str, fingerprint: str, slot: Path) -> str:
        """Fetch a file, and return its fingerprint.

        Raises:
            VideoUnreadable: the store does not deliver it.
            VideoChanged: it is another one by now.
        """
        expected = is_expected(self, id)
        if member := self._member(id):
            self._write_member(id, member, slot)
        elif id.endswith("/"):
            self._pack(id, slot)
        else:
            self.bucket.fetch(id, slot)
        slot.chmod(0o600)  # where the store's own tools put another file there
        found = self._fingerprint(id, slot)
        if fingerprint and not is_same_file(found, fingerprint):
            why = f"changed in {self} since it was catalogued: {found} instead of {fingerprint}"
            raise VideoChanged(id, None, why)
        if id == self.expected[0] and not (expected and is_expected(self, id)):
            self._check_content(id, slot, fingerprint)
        return found

    def _write_member(self, id: str, member: MemberPlace, slot: Path) -> None:
        """Fetch a member of an archive with one question.

        Raises:
            VideoError: see :meth:`Bucket.read`; or it is damaged in the archive.
            VideoUnreadable: it is larger than all copies may be. Few deflated bytes can stand for a full disk.
        """
        if member.size > self.copies.most_bytes:
            raise VideoUnreadable(id, None, f"its {member.size} bytes exceed the limit of copies: raise --copies-gib")
        is_zip = member.archive.endswith(".zip")

        def use(read: ReadBytes) -> None:
            with slot.open("wb") as file:
                if is_zip:
                    copy_bytes(read, head := BytesIO(), ZIP_HEAD_BYTES)
                    if (rest := zip_head_rest(head.getvalue(), -1)) < 0:
                        raise VideoError(
                            id, None, f"its header in {member.archive} is damaged: upload the archive again"
                        )
                    copy_bytes(read, BytesIO(), rest)
                if is_zip and is_deflated(head.getvalue()):
                    try:
                        inflate(read, file, member.size)
                    except (zlib.error, ValueError) as error:
                        raise VideoError(
                            id, None, f"cannot be inflated ({error}): upload {member.archive} again"
                        ) from error
                else:
                    copy_bytes(read, file, member.size)

        # One byte at least: there is no range of none. Deflated bytes may be a few more than those that they stand for.
        more = MOST_ZIP_HEAD_BYTES + member.size // 1000 if is_zip else 0
        part = member.start, member.start + more + max(member.size, 1)
        self.bucket.read(member.archive, part, member.is_in, use, member=id)

    @contextlib.contextmanager
    def lend_archive(self, archive: str, state: FileState) -> Iterator[str]:
        """Lend a pipe with the bytes of a tar file, or a file that has the directory of a zip file in its place, and
        nothing else of it; see :meth:`HasArchives.lend_archive`.
        """
        if state[0] <= 0:
            raise VideoUnreadable(archive, None, "is empty, or its store does not say how large it is")
        with TemporaryDirectory(prefix="v2v-archive-") as folder:
            path = Path(folder, "archive")
            if archive.endswith(".zip"):
                self._write_directory(archive, state, path)
                yield str(path)
                return
            os.mkfifo(path)
            ours = os.open(path, os.O_RDONLY | os.O_NONBLOCK)  # without a reader, a writer could not open it
            with ThreadPoolExecutor(1) as thread:
                fed = thread.submit(self._feed, archive, state, os.open(path, os.O_WRONLY))
                try:
                    yield str(path)
                finally:
                    os.close(ours)  # of a process that did not read to the end: then writing ends, too
                fed.result()

    def _feed(self, archive: str, state: FileState, pipe: int) -> None:
        def use(read: ReadBytes) -> None:
            with contextlib.suppress(BrokenPipeError):
                while block := read(PART_BYTES):
                    to.write(block)

        with open(pipe, "wb", buffering=0) as to:
            self.bucket.read(archive, (0, 0), state.__eq__, use, tries=1)  # the pipe has what was written to it

    def _write_directory(self, archive: str, state: FileState, path: Path) -> None:
        """Write the end of a zip file with its directory, and nothing in front of it.

        Raises:
            VideoError: see :meth:`Bucket.read`; or the directory is too large.
        """

        def last(count: int) -> bytes:
            count = min(count, state[0])

            def use(read: ReadBytes) -> bytes:
                copy_bytes(read, end := BytesIO(), count)
                return end.getvalue()

            return self.bucket.read(archive, (state[0] - count, state[0]), state.__eq__, use)

        end = last(ZIP_END_BYTES)
        if (needed := directory_bytes(end)) > MOST_DIRECTORY_BYTES:
            why = f"has a directory of {needed} bytes; the limit is {MOST_DIRECTORY_BYTES}: split it"
            raise VideoUnreadable(archive, None, why)
        end = last(needed) if needed > len(end) else end
        with path.open("wb") as file:
            file.seek(state[0] - len(end))
            file.write(end)

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
    if options.list_file is None and any(kind.entry_of(file) == file != "" for kind in KINDS.values()):
        bucket, listed = Bucket(above, file), lambda: (ListEntry(file),)
    return Copies(bucket, folder, int(options.copies_gib * (1 << 30)), listed)

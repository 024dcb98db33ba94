"""A folder of this host, also by the name of a video or of a list file in it."""

from __future__ import annotations

import errno
import os
import stat
from collections import Counter
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, closing, contextmanager, nullcontext, suppress
from dataclasses import replace
from functools import lru_cache, partial
from itertools import chain
from operator import attrgetter
from pathlib import Path, PurePosixPath
from typing import cast

from v2v_protocol.errors import CorpusError, VideoChanged, VideoError, VideoUnreadable
from v2v_protocol.programs import printable
from v2v_protocol.write_aside import OUTPUT_MARKER
from v2v_server.corpus.sources.archives import (
    CHANGES_WHILE_READ,
    ArchiveTable,
    MemberPath,
    find_archive,
    name_in,
    read_table,
    same_ids,
)
from v2v_server.corpus.sources.listing import LIST_SUFFIXES, ListEntry, answers, count_left_out, read_list
from v2v_server.corpus.sources.sidecars import check_local, is_sidecar, local_state, sidecar_id, state_of_parts
from v2v_server.corpus.sources.source import (
    GONE,
    MANIFEST_NAME,
    UNPRINTABLE,
    FileState,
    SourceOptions,
    VideoSource,
    archive_mark,
    is_expected,
    unmarked,
)
from v2v_server.kinds.kind import VideosKind
from v2v_server.kinds.registry import VIDEOS
from v2v_server.store.pixels import Pixels
from v2v_server.store.verified import KnownState, Verified
from v2v_server.video.file_range import FileRange, open_bytes
from v2v_server.video.fingerprint import CHANGED, check_fingerprint, files_in, unreadable

PSEUDO_FILE_SYSTEMS = frozenset({
    "binfmt_misc", "bpf", "cgroup", "cgroup2", "configfs", "debugfs", "devpts", "devtmpfs", "efivarfs", "fusectl",
    "mqueue", "nsfs", "proc", "pstore", "securityfs", "selinuxfs", "sysfs", "tracefs",
})  # fmt: skip
"""Kinds whose files are the kernel's: reading one may block, end never, or change something."""
PSEUDO = "lies in a file system of the kernel, such as /proc or /sys, where no videos are"
MOST_PATHS = 64
"""Paths with two or more links by which one folder is searched."""


class Folder(VideoSource):
    """Videos below a folder.

    Args:
        root: the folder, resolved; the ids are relative to it.
        listed: reads the videos to take from it; None takes all.
    """

    def __init__(self, root: Path, listed: Callable[[], tuple[ListEntry, ...] | None] = lambda: None) -> None:
        super().__init__(str(root), listed, root)
        self.folder: Path = root
        self._known: dict[str, KnownState] = {}

    def path_of(self, id: str) -> str:
        """Return the path of a video's file; that of a folder ends with a slash."""
        return f"{self.name}/{id}"  # a Path takes longer to make than a file's state to be told

    def videos(self, refused: dict[str, str], left_out: Counter[str]) -> Iterator[str]:
        """List the videos, see :meth:`VideoSource.videos` and :func:`video_files`."""
        folders: set[str] = set()
        found = (
            video_files(self.folder, refused, left_out, self.kind)
            if self.listed() is None
            else self._regular_files(refused)
        )
        for id in found:
            folders.add(id.rpartition("/")[0])
            yield id
        self._refuse_prepared(folders)

    def state(self, id: str) -> FileState:
        """Ask for the state of one file.

        Raises:
            VideoUnreadable: the file is missing or cannot be read.
        """
        path = self.path_of(id)
        try:
            if path.endswith("/"):
                return state_of_parts(self, id, [(name, _numbers(status)) for name, status in files_in(path)])
            if (member := self._member(id)) is not None:
                mark = archive_mark(member.archive, _numbers(os.stat(self.path_of(member.archive))))
                return unmarked(self, id, replace(member, mark=mark).state)
            status = os.stat(path)
        except (FileNotFoundError, NotADirectoryError) as error:
            if not self.members and (archive := self.archive_of(id)):
                raise VideoUnreadable(id, None, f"its place in {archive} is not known") from error
            raise unreadable(id, error) from error
        except OSError as error:
            raise unreadable(id, error) from error
        return unmarked(self, id, _numbers(status)) if stat.S_ISREG(status.st_mode) else GONE

    def archive_of(self, id: str) -> str:
        """Return the archive that the id of a member leads into, below the folder; "" if it leads into none."""
        at, endings = f"{self.name}/", self.kind.archive_endings
        return find_archive(id, endings, lambda path: os.path.isdir(at + path), lambda path: os.path.isfile(at + path))

    def _file(self, id: str) -> Path:
        """Return a video's file, or the part of an archive that is one."""
        if (member := self._member(id)) is None:
            return Path(self.path_of(id))
        return cast(Path, FileRange(self.path_of(member.archive), member.start, member.start + member.size))

    def _sidecar(self, id: str) -> Path:
        """Return where a sidecar lies, or would lie.

        Raises:
            VideoUnreadable: its archive cannot be read.
        """
        path = self.folder / id
        if os.path.lexists(path) or not (archive := self.archive_of(id)):
            return path
        try:
            state = _numbers(os.stat(self.path_of(archive)))
            table = self.tables.get(archive) or _read_once(self, archive, state)
        except OSError as error:
            raise unreadable(id, error) from error
        member = MemberPath(self.path_of(archive), archive_mark(archive, state), name_in(archive, id), table)  # type: ignore[abstract]
        return cast(Path, member)

    @contextmanager
    def lend_archive(self, archive: str, state: FileState) -> Iterator[str]:
        """Lend an archive's own path, see :meth:`HasArchives.lend_archive`."""
        yield f"{self.name}/{archive}"
        if self.state(archive) != state:
            raise VideoChanged(archive, None, CHANGES_WHILE_READ)

    def open_local(self, id: str, fingerprint: str) -> AbstractContextManager[Path]:
        """Lend the file; only a sidecar of one file is checked.

        Raises:
            VideoUnreadable, VideoChanged: a sidecar cannot be read, or is another one by now.
        """
        if not is_sidecar(id):
            return nullcontext(self._file(id))
        path = self._sidecar(id)
        if fingerprint and not id.endswith("/"):
            check_local(path, id, fingerprint)
        return nullcontext(path)

    @contextmanager
    def open_pixels(self, id: str, fingerprint: str) -> Iterator[Pixels]:
        """Lend the frames of a video, see :meth:`VideoSource.open_pixels`; decoded ones are verified
        (:mod:`v2v_server.store.verified`).
        """
        with super().open_pixels(id, fingerprint) as pixels:
            path, expected = os.fspath(self._file(id)), partial(is_expected, self, id)
            yield pixels if pixels.is_stored else Verified(pixels, path, self._known, expected)

    def has(self, files: Mapping[str, str]) -> bool:
        """Return whether no video has to be read whole first. One that cannot be read counts as well."""
        with suppress(VideoError), closing(self._videos(files)) as videos:
            return all(pixels.known(fingerprint) for pixels, fingerprint in videos)
        return True

    def fetch(self, files: Mapping[str, str]) -> None:
        """Read each video whole whose file may have changed.

        Raises:
            VideoError: it is another one by now, or cannot be read.
        """
        with closing(self._videos(files)) as videos:
            for pixels, fingerprint in videos:
                pixels.learn(fingerprint)

    def _videos(self, files: Mapping[str, str]) -> Generator[tuple[Verified, str], None, None]:
        for id, fingerprint in files.items():
            if not is_sidecar(id):
                with self.open_pixels(id, fingerprint) as pixels:
                    if isinstance(pixels, Verified):
                        yield pixels, fingerprint

    def with_sidecars(self, ids: Sequence[str], endings: Sequence[str]) -> Mapping[str, Sequence[str]]:
        """Return the videos beside which such a name is listed. Each folder is listed once."""
        names = dict[str, frozenset[str] | None]()
        found: dict[str, list[str]] = {ending: [] for ending in endings}
        for id in ids:
            below = id.rstrip("/").rpartition("/")[0]
            if below not in names:
                names[below] = _names_with(self._sidecar(f"{below}/" if below else ""), endings)
            there = names[below]
            if there is not None and not there:
                continue
            for ending, videos in found.items():
                if there is None or sidecar_id(id, ending).rstrip("/").rpartition("/")[2] in there:
                    videos.append(id)
        return found

    def sidecar_state(self, id: str) -> str | OSError:
        """Return a text that stands for sizes and times, see :meth:`VideoSource.sidecar_state`."""
        try:
            path = self._sidecar(id)
            state = local_state(path, id)
            return f"{path.mark:x} {state}" if state and isinstance(path, MemberPath) else state
        except VideoError as error:
            return OSError(error.reason)
        except OSError as error:
            return error

    def verify(self, id: str, fingerprint: str, state: FileState | str | None) -> None:
        """Check the file's size, head and tail; of a sidecar, only sizes and times.

        Raises:
            VideoError: it is gone, another one by now, or cannot be read.
        """
        if is_sidecar(id):
            if os.path.lexists(self.path_of(id)) or not (archive := self.archive_of(id)):
                check_local(self.folder / id, id, fingerprint, str(state or ""))
            elif state and not str(state).startswith(f"{archive_mark(archive, self.state(archive)):x} "):
                raise VideoChanged(id, None, f"{CHANGED}: {archive} is another file")
        elif os.path.isdir(path := self.path_of(id)):  # not as a worker has listed it
            check_fingerprint(path, fingerprint)
        else:
            if state is None and self.archive_of(id):
                return  # its place is not known, and this process parses no archive
            self.expected = id, unmarked(self, id, state) if isinstance(state, tuple) else ()
            with super().open_pixels(id, fingerprint) as pixels:
                pixels.check(fingerprint)

    def _regular_files(self, refused: dict[str, str]) -> Iterator[str]:
        """Yield the listed ids that do not name something else than a file; instead of members, their archives.

        Opening a FIFO blocks until there is a writer, and reading a device may never end. An id that names nothing is
        kept: probing it reports why.
        """
        pseudo = pseudo_devices()

        def file_to_read(id: str) -> str:
            try:
                status = os.stat(os.path.join(self.name, id))
            except OSError:
                return self.archive_of(id) or id
            wanted = stat.S_IFDIR if id.endswith("/") else stat.S_IFREG
            return id * (stat.S_IFMT(status.st_mode) == wanted and status.st_dev not in pseudo)

        for id, file in answers(file_to_read, [entry.id for entry in self.listed() or ()]):
            if file:
                yield file
            else:
                refused[id] = "is not a regular file" if id[-1] != "/" else "is not a folder"

    def _refuse_prepared(self, below: set[str]) -> None:
        """Check that no video comes from a prepared folder, whose rows are cut already.

        Args:
            below: the folders that videos lie in.

        Raises:
            CorpusError: one does.
        """

        def is_prepared(folder: PurePosixPath) -> bool:
            try:
                return (self.folder / folder / MANIFEST_NAME).exists()
            except OSError:  # a video of such a folder cannot be read either, and is refused itself
                return False

        folders = {PurePosixPath(folder) for folder in below}
        folders.update({parent for folder in folders for parent in folder.parents})
        for folder, refused in answers(is_prepared, sorted(folders)):
            if refused:
                raise CorpusError(
                    f"{self.folder / folder} is a prepared folder and cannot be a part of another corpus: serve it "
                    "alone, or move it out"
                )


@lru_cache(maxsize=64)
def _read_once(source: Folder, archive: str, state: FileState) -> ArchiveTable:
    """Return the table of an archive, in a process that was not told where a sidecar lies.

    Raises:
        OSError: it cannot be read, or is no archive.
    """
    try:
        with open_bytes(source.path_of(archive)) as file:
            return ArchiveTable.from_bytes(read_table(file, archive, source.kind.id_of).to_bytes(), state[0])
    except ValueError as error:
        raise OSError(errno.EIO, str(error)) from error


def _numbers(status: os.stat_result) -> FileState:
    return status.st_size, status.st_mtime_ns, status.st_ctime_ns


def _names_with(folder: Path, endings: Sequence[str]) -> frozenset[str] | None:
    """Return the names in a folder that have one of these endings; None if it cannot be listed."""
    suffixes = tuple(ending.rstrip("/") for ending in endings)
    try:
        names = os.listdir(folder) if isinstance(folder, Path) else (entry.name for entry in folder.iterdir())
        return frozenset(name for name in names if name.endswith(suffixes))
    except OSError:
        return None


def open_source(name: str, options: SourceOptions) -> Folder:
    """Open a folder, a video or a list file.

    Raises:
        CorpusError: there is none.
        OSError: this user may not look at it.
    """
    return Folder(*locate(name, options))


def locate(name: str, options: SourceOptions) -> tuple[Path, Callable[[], tuple[ListEntry, ...] | None]]:
    """Return the folder that ids are relative to, and what reads the videos to take from it.

    Raises:
        CorpusError: there is no such folder, video or list file.
        OSError: this user may not look at it.
    """
    path = Path(name)
    if path.is_dir():
        root = path.resolve()
        is_video = options.kind.has_parts and "/" in map(options.kind.id_of, os.listdir(root))
        if options.list_file is None and is_video:
            return root.parent, lambda: (ListEntry(f"{root.name}/"),)
        return root, options.listed
    if not path.is_file():
        raise CorpusError(f"{name}: there is no such folder, video or list file on this host")
    if options.list_file is not None:
        raise CorpusError(f"{name}: not a folder; a list file names videos of a folder")
    if path.suffix.lower() in LIST_SUFFIXES:
        return path.parent.resolve(), partial(read_list, path, options.kind)
    if printable(path.name) != path.name:
        raise CorpusError(f"{printable(path.name)}: {UNPRINTABLE}")
    return path.parent.resolve(), lambda: (ListEntry(path.name),)


def video_files(
    root: Path, refused: dict[str, str], left_out: Counter[str], kind: VideosKind = VIDEOS
) -> Iterator[str]:
    """Return relative POSIX paths of the video files below ``root``, known by their suffixes, and of archives that may
    hold some. An archive beside a folder or an archive of its name without the ending is refused.

    Links are followed; a link to a folder that it lies in is not. A folder that several links lead to has its videos
    under each path, because each such id is part of the digests of existing corpora. Folders that link to each other
    have a factorial number of paths, so a folder is searched by at most :data:`MOST_PATHS` paths with two or more
    links; paths with fewer links are not limited. Kernel file systems (/proc, /sys, /dev) are not entered. Hidden files
    and folders (".name") are passed over, and so are folders below ``root`` that hold outputs (``OUTPUT_MARKER``).

    Args:
        root: the folder.
        refused: receives, by relative path, why a folder or file cannot be taken in.
        left_out: counts, by suffix, files that may be videos of other endings; and, by path, folders of outputs.
        kind: what a video is; the id of a folder of pictures ends with a slash.
    """
    pseudo, paths_of = pseudo_devices(), Counter[tuple[int, int]]()

    def below(folder: Path, prefix: str, above: frozenset[tuple[int, int]], links: int) -> Iterator[list[str]]:
        """Yield the videos below a folder, some at a time.

        Args:
            prefix: of their ids.
            above: identities (device, inode) of the folders that it lies in.
            links: of the path that leads here.
        """
        name = printable(prefix.rstrip("/") or ".")
        try:
            here = folder.stat()
            if here.st_dev in pseudo:
                refused[name] = PSEUDO
                return
            identity = (here.st_dev, here.st_ino)
            if identity in above:
                return
            if links > 1:
                paths_of[identity] += 1
                if (paths := paths_of[identity]) > MOST_PATHS:
                    if paths == MOST_PATHS + 1:
                        refused[name] = f"links lead to this folder by more than {MOST_PATHS} paths: remove some links"
                    return
            with os.scandir(folder) as listing:
                entries = sorted(listing, key=attrgetter("name"))
            if prefix and any(entry.name == OUTPUT_MARKER for entry in entries):
                left_out[prefix] += 1
                return
        except OSError as error:
            refused[name] = f"the folder cannot be read: {error.strerror or error}"
            return
        found: list[str] = []
        names = {entry.name for entry in entries}
        for entry in entries:
            if entry.name[0] == ".":
                continue
            relative = prefix + entry.name
            try:
                is_file = entry.is_file()
                is_folder = not is_file and entry.is_dir()
                is_pseudo = is_file and entry.is_symlink() and entry.stat().st_dev in pseudo
            except OSError as error:  # a link that leads in a circle, or where this user may not look
                refused[printable(relative)] = f"cannot be read: {error.strerror or error}"
                continue
            if is_folder:
                yield found
                found = []
                more = links + entry.is_symlink()
                yield from below(folder / entry.name, f"{relative}/", above | {identity}, more)
            elif id := kind.entry_of(relative):
                if printable(relative) != relative:
                    refused[printable(relative)] = UNPRINTABLE
                elif not is_file:
                    refused[relative] = "is not a regular file, or is a broken link"
                elif is_pseudo:
                    refused[relative] = PSEUDO
                elif why := same_ids(entry.name, kind.archive_endings, names.__contains__):
                    refused[relative] = why
                else:
                    found.append(id)
            elif is_file:
                count_left_out(entry.name, left_out)
        yield found

    return chain.from_iterable(below(root, "", frozenset(), 0))


def pseudo_devices() -> frozenset[int]:
    """Return the device numbers (``st_dev``) of the kernel file systems that are mounted here."""
    found = set()
    try:
        mounts = Path("/proc/self/mountinfo").read_bytes().splitlines()
    except OSError:
        return frozenset()
    for mount in mounts:
        before, _, after = mount.partition(b" - ")
        is_dev = before.split()[4] == b"/dev"  # in a container a tmpfs of its own
        if is_dev or after.split()[0].decode("ascii", "replace") in PSEUDO_FILE_SYSTEMS:
            major, _, minor = before.split()[2].partition(b":")
            found.add(os.makedev(int(major), int(minor)))
    return frozenset(found)

"""Read what earlier runs of `v2v-prepare` left in a folder, and refuse unsuitable folders."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import shutil
from collections.abc import Generator, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from v2v_protocol.errors import CorpusError, VideoError
from v2v_protocol.write_aside import is_writable
from v2v_server.corpus.catalogue import Catalogue
from v2v_server.corpus.manifest import MANIFEST_NAME, Header, PreparedVideo, prepared_name, read_manifest
from v2v_server.corpus.videos import VideoEntry
from v2v_server.prepare.transcode import PARTIAL_SUFFIX
from v2v_server.store.quota import LEAST_FREE_BYTES
from v2v_server.video.fingerprint import fingerprint

_LOCK_NAME = ".v2v-prepare.lock"
_NOT_THERE = frozenset((errno.ENOENT, errno.ENOTDIR, errno.EISDIR, errno.ELOOP))
_READERS = 16
_AT_A_TIME = 1024
"""Files that are read at a time, so that the memory for the requests does not grow with the corpus."""


def check_destination(target: Path, source: Path, single: bool = False, catalogue: Catalogue | None = None) -> None:
    """Check a destination without reading a video of the source.

    Args:
        target: the destination, resolved.
        source: the folder of the source, resolved.
        single: the source is one video: other files of its folder are never used.
        catalogue: the source, once it is probed: see :func:`refuse_links`.

    Raises:
        CorpusError: it is no folder, is write-protected, holds something else, overlaps with the source or lies in a
            prepared folder, or the disk is nearly full.
    """
    try:
        at = next(each for each in (target, *target.parents) if each.exists())
        if not at.is_dir():
            raise CorpusError(f"{target}: {at} is a file; give the name of a folder")
        if not is_writable(at):
            raise CorpusError(f"{target}: {at} is write-protected; choose another destination, or allow writing")
        below = target != source and target.is_relative_to(source)
        if source.is_relative_to(target) or (below and not single):
            raise CorpusError(f"{target} and the source {source} overlap; choose a destination outside the source")
        if catalogue is not None:
            refuse_links(catalogue, target)
        check_free_space(at)
        if (target / MANIFEST_NAME).exists():
            return
        for folder in target.parents:
            if (folder / MANIFEST_NAME).exists():
                raise CorpusError(f"{target} lies in the prepared folder {folder}; choose another destination")
        foreign = sorted(entry.name for entry in at.iterdir() if not entry.name.startswith(".")) if at == target else []
        if foreign:
            raise CorpusError(
                f"{target}: holds {foreign[0]} ({len(foreign)} entries) and no manifest of v2v-prepare; choose an "
                "empty or a new folder"
            )
    except OSError as error:
        raise CorpusError(f"{target}: cannot be written to: {error.strerror or error}") from error


def check_free_space(folder: Path) -> None:
    """Check that the disk is not nearly full.

    Raises:
        CorpusError: it is.
        OSError: the free space cannot be read.
    """
    free = shutil.disk_usage(folder).free
    if free < LEAST_FREE_BYTES:
        raise CorpusError(
            f"{folder}: the disk has {free / 1e9:.2f} GB free, of which {LEAST_FREE_BYTES / 1e9:.1f} must stay free; "
            "finished files are kept; free disk space and run the same command to continue"
        )


def refuse_links(catalogue: Catalogue, target: Path) -> None:
    """Check that no file of the source is a link into the destination.

    Args:
        catalogue: the source.
        target: the destination, resolved.

    Raises:
        CorpusError: one is, or the source is a prepared folder itself.
    """
    root = catalogue.folder
    if catalogue.prepared is not None:
        raise CorpusError(f"{root} is a prepared folder itself; prepare its source instead")
    # Resolving a path queries each of its parts, so do it once for every folder, and for files that are links.
    inside: dict[str, bool] = {}
    for video in catalogue.videos:
        path = root / video.id
        folder = os.path.dirname(video.id)
        if folder not in inside:
            inside[folder] = path.parent.resolve().is_relative_to(target)
        if inside[folder] or (path.is_symlink() and path.resolve().is_relative_to(target)):
            raise CorpusError(f"{target}: {video.id} of the source is a link into it; choose another destination")


@contextlib.contextmanager
def locked(target: Path) -> Iterator[None]:
    """Lock the folder against other processes. The system releases the lock when this process ends in any way.

    Raises:
        CorpusError: another process works there.
        OSError: the folder cannot be written to.
    """
    with (target / _LOCK_NAME).open("w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise CorpusError(f"{target}: another v2v-prepare works there; wait until it ends") from None
        yield


def known_records(target: Path, header: Header, videos: Sequence[VideoEntry]) -> dict[str, PreparedVideo]:
    """Return the records of all earlier runs, including those set aside, after removing unfinished files.

    Args:
        target: the destination.
        header: settings of this run.
        videos: videos of its source.

    Raises:
        CorpusError: the folder was prepared with other settings or from another source.
        OSError: it cannot be read, or unfinished files cannot be removed.
    """
    if not (target / MANIFEST_NAME).exists():
        return {}
    manifest = read_manifest(target)
    if manifest.header.settings != header.settings:
        # One header describes all files of a folder, so it cannot hold two settings; and preparing all of them again
        # without being asked may cost days.
        made = sum(video.problem is None for records in (manifest.videos, manifest.aside) for video in records.values())
        raise CorpusError(
            f"{target} holds {made} videos prepared with {manifest.header.settings}, but {header.settings} is "
            "requested; choose another folder, or delete this one to prepare all of them again"
        )
    known = manifest.aside | manifest.videos
    _refuse_other_source(target, manifest.header.source, header.source, known, videos)
    for partial in target.rglob(f".*{PARTIAL_SUFFIX}"):
        partial.unlink()
    return known


def _refuse_other_source(
    target: Path, earlier: str, now: str, known: dict[str, PreparedVideo], videos: Sequence[VideoEntry]
) -> None:
    """Refuse another corpus. Otherwise it would look like this one with every video changed or removed, and its files
    would replace those of the same names, which may have taken days. A source that keeps its name, or some video, is
    the same.
    """
    if earlier == now or not known:
        return
    if any(video.id in known and known[video.id].source_fingerprint == video.fingerprint for video in videos):
        return
    raise CorpusError(
        f"{target} was prepared from a folder called {earlier}, and none of its {len(known)} videos is one of the "
        f"{len(videos)} of {now}; choose another folder for another corpus. If it is the same one renamed, begin with "
        "all of its videos, or use its old name"
    )


def standing_files(
    target: Path, videos: Sequence[VideoEntry], known: dict[str, PreparedVideo]
) -> Generator[tuple[VideoEntry, bool], None, None]:
    """Yield for each video, in order, whether its prepared file exists, is unchanged, and belongs to this state of the
    source.

    Beginning and end of each file are read, many files at a time, because this waits for the disk.

    Raises:
        CorpusError: a file exists and cannot be read.
    """
    pool = ThreadPoolExecutor(_READERS)
    try:
        for start in range(0, len(videos), _AT_A_TIME):
            some = videos[start : start + _AT_A_TIME]
            yield from zip(some, pool.map(lambda video: _stands(target, video, known), some), strict=True)
    finally:
        pool.shutdown(cancel_futures=True)


def has_failed(video: VideoEntry, known: dict[str, PreparedVideo]) -> bool:
    """Return whether an earlier run could not prepare this state of the source."""
    record = known.get(video.id)
    return record is not None and record.problem is not None and record.source_fingerprint == video.fingerprint


def _stands(target: Path, video: VideoEntry, known: dict[str, PreparedVideo]) -> bool:
    record = known.get(video.id)
    if record is None or record.problem is not None or record.source_fingerprint != video.fingerprint:
        return False
    try:
        return fingerprint(target / prepared_name(video.id)) == record.fingerprint
    except VideoError as error:
        if isinstance(error.__cause__, OSError) and error.__cause__.errno not in _NOT_THERE:
            raise CorpusError(
                f"{target / prepared_name(video.id)} {error.reason}, so it cannot be checked, and "
                "nothing was changed; make it readable, or delete it to prepare it again"
            ) from error
        return False

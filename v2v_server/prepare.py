"""`v2v-prepare`: decode a corpus once, and store what training needs.

The prepared folder mirrors the source: the same relative paths, so the same ids, order, list files and permutation. Its
files are store files (:mod:`v2v_server.store.format`), whatever their suffixes, with the exact frames of their sources.
A manifest lists them. A file is verified by reading all of it back: it has to give the exact frames that were decoded.
The statistics of its scene are computed on the way.

The folder stays consistent after any interruption: a file gets its final name only when complete and verified, and its
line in the manifest after that. A second run keeps every file that is what it would write (:func:`find_standing`), and
does the rest. Files of videos that a run does not include stay, for a later run that includes them.
"""

from __future__ import annotations

import errno
import hashlib
import math
import os
import shutil
from base64 import b64encode
from collections import defaultdict
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import xxhash

from v2v_protocol.errors import CorpusError, UsageError, VideoError, VideoUnreadable, system_errors
from v2v_protocol.persisted import Persisted
from v2v_protocol.sample import Refusal
from v2v_protocol.write_aside import is_writable, write_aside_and_rename
from v2v_server.corpus.catalogue import Catalogue
from v2v_server.corpus.scenes.analysis import SceneAnalysis
from v2v_server.corpus.scenes.scene import MOST_ANALYSED_FRAMES, Scene
from v2v_server.corpus.sources.prepared import (
    Header,
    PreparedVideo,
    prepared_name,
    read_manifest,
    write_manifest,
)
from v2v_server.corpus.sources.source import MANIFEST_NAME
from v2v_server.corpus.videos import VideoEntry
from v2v_server.kinds.registry import kind_of
from v2v_server.store.format import DEFAULT_SIZE, SIZES
from v2v_server.store.planes import OPTIONAL, whole_cut
from v2v_server.store.quota import LEAST_FREE_BYTES
from v2v_server.store.store_file import StoreFile, write_store
from v2v_server.store.verified import CHANGES_MEANWHILE, Verified
from v2v_server.system.compile_cache import compile_cache
from v2v_server.system.isolate import Died, run_lent
from v2v_server.system.process import locked
from v2v_server.video.decode import ClipRequest, Cut
from v2v_server.video.frame_index import FrameIndex
from v2v_server.video.picture import MOST_BITS, PixelRect
from v2v_server.video.rows import Rows

_STORED_BITS_PER_PIXEL = 2.2
"""Size of a store file, median of the measured clips (docs/prepare.md): 0.7 to 3.4."""

_TELLING_SHARE = 0.02
_LOCK_NAME = ".v2v-prepare.lock"
_NOT_THERE = frozenset((errno.ENOENT, errno.ENOTDIR, errno.EISDIR, errno.ELOOP))
_READERS = 16
_AT_A_TIME = 1024
"""Files that are read at a time, so that the memory for the requests does not grow with the corpus."""
_CRASHES = "crashes the transcoder: its process died"

PrepareProgress = Callable[[int, int, int, int], None]
"""Progress callback: (source frames done, source frames in total, bytes written, bytes expected in total)."""


@dataclass(frozen=True, slots=True)
class Report:
    """Results of a run.

    Attributes:
        videos: a record of every video of the source, by id.
        kept: number of videos that an earlier run had finished.
        looked_at: number of videos that an earlier run had finished except for their scene statistics.
        not_looked_at: prepared videos whose statistics could not be computed, and why. Their files stay.
        unusable: files of the source that a server cannot use either.
    """

    videos: tuple[PreparedVideo, ...]
    kept: int
    unusable: tuple[Refusal, ...]
    looked_at: int = 0
    not_looked_at: tuple[Refusal, ...] = ()

    @property
    def prepared(self) -> tuple[PreparedVideo, ...]:
        """Return the videos that have a prepared file."""
        return tuple(video for video in self.videos if video.problem is None)

    @property
    def failed(self) -> tuple[PreparedVideo, ...]:
        """Return the videos that have no prepared file."""
        return tuple(video for video in self.videos if video.problem is not None)

    @property
    def complete(self) -> bool:
        """Return whether every video file was prepared, with everything requested."""
        return not (self.failed or self.unusable or self.not_looked_at)


def prepare(
    catalogue: Catalogue,
    destination: str | os.PathLike[str],
    size: str = DEFAULT_SIZE,
    *,
    processes: int = 1,
    scene: bool = False,
    planes: tuple[str, ...] = (),
    single: bool = False,
    progress: PrepareProgress | None = None,
) -> Report:
    """Transcode a corpus. A video that cannot be transcoded is recorded with the reason, and the others continue.

    Args:
        catalogue: the source; its ``rows`` are stored.
        destination: the folder to create or to continue.
        size: how the files are packed, a key of :data:`v2v_server.store.format.SIZES`.
        processes: number of parallel transcoding processes, spawned; 0 transcodes in this process.
        scene: also compute the scene statistics; for a video prepared without them they are computed from its source,
            and its file stays.
        planes: names of the planes to store (:data:`v2v_server.store.planes.OPTIONAL`); a video prepared without one of
            them is prepared again, and keeps its others.
        single: the source is one video, so the destination may lie in its folder.
        progress: called at the start, after each video whose file was checked, and after each that was done.

    Raises:
        CorpusError: source and destination overlap, the destination holds something else or was prepared with other
            settings or from another source, a prepared file cannot be read, another process works there, the source is
            a prepared folder itself, or the disk is too full.
        UsageError: a number of processes below 0, an unknown size, or a kind of videos that is not prepared.
    """
    if processes < 0:
        raise UsageError(f"{processes} processes: give 0 or more")
    if size not in SIZES:
        raise UsageError(f"size {size!r}: choose one of {', '.join(SIZES)}")
    if why := catalogue.kind.unprepared:
        raise UsageError(why)
    tell = progress or (lambda done, total, made, expected: None)
    total = sum(video.frames for video in catalogue.videos)
    tell(0, total, 0, 0)
    target = Path(destination).resolve()
    check_destination(target, catalogue.source.folder, single, catalogue)
    name = Path(catalogue.source.name).name
    header = Header(str(catalogue.rows), size, len(catalogue.videos), name, catalogue.digest)
    records: dict[str, PreparedVideo] = {}
    jobs: list[Transcoding] = []
    done, looked_at, not_looked_at = 0, 0, list[Refusal]()
    try:
        target.mkdir(parents=True, exist_ok=True)
        with locked(target / _LOCK_NAME):
            known = known_records(target, header, catalogue.videos)
            with closing(_standing_files(target, catalogue, size)) as files:
                for video, file in files:
                    record = known.get(video.id)
                    record = record if record and record.source_fingerprint == video.fingerprint else None
                    if file is not None:
                        records[video.id] = _record(video, file.bytes, record.scene if record else "")
                    elif record and record.problem:
                        # It stays until the video was tried again: a finished folder stays finished.
                        records[video.id] = record
                    stands = file is not None and file.planes.issuperset(planes)
                    looks = scene and not (file and records[video.id].scene)
                    if stands and not looks:
                        done += video.frames
                    else:
                        # A file that is written again for one plane keeps its others.
                        kept = file.planes.intersection(OPTIONAL) if file else ()
                        wanted = tuple(dict.fromkeys((*planes, *sorted(kept))))
                        jobs.append(Transcoding(video, size, target, stands, looks, wanted))
                    tell(done, total, 0, 0)
            room = _Room(target, catalogue, [job.video for job in jobs])
            with write_manifest(target, header, records.values()) as add:
                for job, made in _outcomes(catalogue, jobs, target, processes):
                    video, before = job.video, records.get(job.video.id)
                    if isinstance(made, Made):
                        record = _record(video, made.bytes, _text(made.scene) or (before.scene if before else ""))
                        looked_at += job.stands
                    elif before and before.problem is None:
                        record = before
                        not_looked_at.append(Refusal(video.id, None, made))
                    else:
                        record = _record(video, problem=made)
                    records[video.id] = record
                    add(record)
                    done += video.frames
                    room.done(video, made.bytes if isinstance(made, Made) and not job.stands else 0)
                    tell(done, total, room.made, room.expected)
                    check_free_space(target)
    except BlockingIOError:
        raise CorpusError(f"{target}: another v2v-prepare works there; wait until it ends") from None
    except OSError as error:
        raise CorpusError(f"{target}: cannot be written to: {error.strerror or error}") from error
    return Report(
        videos=tuple(records[id] for id in sorted(records)),
        kept=len(catalogue.videos) - len(jobs),
        unusable=catalogue.refusals,
        looked_at=looked_at,
        not_looked_at=tuple(not_looked_at),
    )


class _Room:
    """Check of the free disk space for the expected files.

    Raises:
        CorpusError: there is not enough, by a first estimate.
        OSError: the free space cannot be read.
    """

    def __init__(self, target: Path, catalogue: Catalogue, left: Sequence[VideoEntry]) -> None:
        self._pixels = {video.id: _pixels(video, catalogue.rows) for video in left}
        self._all_pixels, self._done_pixels = sum(self._pixels.values()), 0
        self.made = 0
        free = shutil.disk_usage(target).free
        if self.expected > free - LEAST_FREE_BYTES:
            raise CorpusError(
                f"{target}: about {self.expected / 1e9:.1f} GB will be written, but the disk has "
                f"{free / 1e9:.1f} GB free, of which {LEAST_FREE_BYTES / 1e9:.1f} must stay free; "
                "free disk space, keep fewer rows, or select fewer videos with --list"
            )

    def done(self, video: VideoEntry, made: int) -> None:
        """Count a finished video and the bytes written for it."""
        self._done_pixels += self._pixels[video.id]
        self.made += made

    @property
    def expected(self) -> int:
        """Expected total of bytes, estimated from the finished videos once they are representative."""
        if self.made and self._done_pixels > _TELLING_SHARE * self._all_pixels:
            return int(self.made / self._done_pixels * self._all_pixels)
        return int(_STORED_BITS_PER_PIXEL / 8 * self._all_pixels)


def _pixels(video: VideoEntry, rows: Rows) -> int:
    try:
        top, bottom = rows.bounds(video.height_px)
    except UsageError:
        return 0
    return video.frames * (bottom - top) * video.width_px


def _outcomes(
    catalogue: Catalogue, jobs: Sequence[Transcoding], target: Path, processes: int
) -> Iterator[tuple[Transcoding, Made | str]]:
    """Yield the file of each job, or why there is none, in order of completion."""

    @contextmanager
    def lend(job: Transcoding) -> Iterator[Transcoding]:
        window, index = _window(job.video, catalogue.rows), catalogue.frame_index(job.video.id).to_bytes()
        with catalogue.lend(job.video) as source:
            yield replace(job, source=source, window=window, index=index)

    for job, result in run_lent(
        _attempt, jobs, lend, processes, deadline_seconds=_deadline_seconds, writable=(target, *compile_cache())
    ):
        if isinstance(result, Died):
            result = f"hangs the transcoder: {result.how}" if result.overdue_seconds else f"{_CRASHES} ({result.how})"
        elif isinstance(result, Exception):
            result = getattr(result, "reason", str(result))
        yield job, result


def _window(video: VideoEntry, rows: Rows) -> PixelRect:
    top, bottom = rows.bounds(video.height_px)
    return top, 0, bottom - top, video.width_px


def _deadline_seconds(job: Transcoding) -> float:
    """Return the time limit for a video, seconds: some fifty times what a core takes to transcode and verify it. It
    ends jobs whose storage never answers.
    """
    video = job.video
    return 600 + video.frames * (0.5 + 5e-6 * video.width_px * video.height_px)


def _attempt(job: Transcoding) -> Made | str:
    """Return the result of one job, or the reason why there is none."""
    try:
        return transcode(job)
    except VideoError as error:
        return error.reason if error.frame is None else f"frame {error.frame}: {error.reason}"
    except OSError as error:
        return f"cannot be written: {error.strerror or error}"
    except Exception as error:  # noqa: BLE001 - one strange file must not end the preparation of all others
        return f"preparing failed: {type(error).__name__}: {error}"


def _record(video: VideoEntry, bytes: int = 0, scene: str = "", problem: str | None = None) -> PreparedVideo:
    rate = video.frames_per_second
    # A fingerprint begins with the size in bytes.
    size = int(video.fingerprint.partition("-")[0])
    return PreparedVideo(
        video.id, video.fingerprint, size, video.frames, None if math.isnan(rate) else rate, video.height_px,
        video.width_px, bytes, problem, scene, video.remark,
    )  # fmt: skip


def _text(scene: Scene | None) -> str:
    return "" if scene is None else b64encode(scene.to_bytes()).decode()


def check_destination(
    target: Path, source: Path | None, single: bool = False, catalogue: Catalogue | None = None
) -> None:
    """Check a destination without reading a video of the source.

    Args:
        target: the destination, resolved.
        source: the folder of the source, resolved; None if it is not on this host.
        single: the source is one video: other files of its folder are never used.
        catalogue: the source, once it is probed: see :func:`refuse_links`.

    Raises:
        CorpusError: it is no folder, is write-protected, holds something else, overlaps with the source or lies in a
            prepared folder, or the disk is nearly full.
    """
    with system_errors(CorpusError, f"{target}: cannot be written to"):
        at = next(each for each in (target, *target.parents) if each.exists())
        if not at.is_dir():
            raise CorpusError(f"{target}: {at} is a file; give the name of a folder")
        if not is_writable(at):
            raise CorpusError(f"{target}: {at} is write-protected; choose another destination, or allow writing")
        below = source is not None and target != source and target.is_relative_to(source)
        if source is not None and (source.is_relative_to(target) or (below and not single)):
            raise CorpusError(f"{target} and the source {source} overlap; choose a destination outside the source")
        if source is not None and catalogue is not None:
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


def known_records(target: Path, header: Header, videos: Sequence[VideoEntry]) -> dict[str, PreparedVideo]:
    """Return the records of the run before, after removing unfinished files.

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
        made = sum(video.problem is None for video in manifest.videos.values())
        raise CorpusError(
            f"{target} holds {made} videos prepared with {manifest.header.settings}, but {header.settings} is "
            "requested; choose another folder, or delete this one to prepare all of them again"
        )
    known, earlier, now = manifest.videos, manifest.header.source, header.source
    # Another corpus would look like this one with every video changed or removed, and its files would replace those of
    # the same names, which may have taken days. A source that keeps its name, or some video, is the same.
    kept = (known[video.id].source_fingerprint == video.fingerprint for video in videos if video.id in known)
    if earlier != now and known and not any(kept):
        raise CorpusError(
            f"{target} was prepared from a folder called {earlier}, and none of its {len(known)} videos is one of the "
            f"{len(videos)} of {now}; choose another folder for another corpus. If it is the same one renamed, begin "
            "with all of its videos, or use its old name"
        )
    for unfinished in target.rglob(f".*{PARTIAL_SUFFIX}"):
        unfinished.unlink()
    return known


@dataclass(frozen=True, slots=True)
class _Standing:
    """A prepared file that stands: its planes and its size."""

    planes: frozenset[str]
    bytes: int


def _standing_files(
    target: Path, catalogue: Catalogue, size: str
) -> Generator[tuple[VideoEntry, _Standing | None], None, None]:
    """Yield each video, in order, with its prepared file, see :func:`find_standing`.

    Many files are read at a time, because this waits for the disk.

    Raises:
        CorpusError: a file exists and cannot be read.
    """
    pool = ThreadPoolExecutor(_READERS)
    find = partial(find_standing, target, catalogue.rows, size)
    try:
        for start in range(0, len(catalogue.videos), _AT_A_TIME):
            some = catalogue.videos[start : start + _AT_A_TIME]
            yield from zip(some, pool.map(find, some), strict=True)
    finally:
        pool.shutdown(cancel_futures=True)


def find_standing(target: Path, rows: Rows, size: str, video: VideoEntry) -> _Standing | None:
    """Return the prepared file of a video if it is whole, and its head is what would be written; None if not.

    Raises:
        CorpusError: it exists and cannot be read.
    """
    path = target / prepared_name(video.id)
    try:
        wanted = video.fingerprint, video.height_px, _window(video, rows), 0, video.frames, SIZES[size].method
        with StoreFile(path) as stored:
            head = stored.head
            usable = head.top, 0, head.rows, head.width_px
            found = head.fingerprint, head.height_px, usable, head.first, head.count, head.packing
            return _Standing(stored.planes, path.stat().st_size) if found == wanted and stored.is_whole else None
    except UsageError:
        return None
    except VideoError as error:
        if isinstance(error.__cause__, OSError) and error.__cause__.errno not in _NOT_THERE:
            raise CorpusError(
                f"{path} {error.reason}, so it cannot be checked, and nothing was changed; make it readable, or "
                "delete it to prepare it again"
            ) from error
        return None


PARTIAL_SUFFIX = ".v2v-partial"
_Hashes = defaultdict[str, xxhash.xxh3_128]
"""Of the arrays of all frames of a file, by plane; "" is the luma."""


@dataclass(frozen=True, slots=True)
class Transcoding(Persisted):
    """One video to prepare.

    Attributes:
        video: as catalogued.
        size: how the file is packed, a key of :data:`v2v_server.store.format.SIZES`.
        root: the folder to write to, resolved.
        stands: whether the target is this already, and only its statistics are wanted.
        scene: whether to compute the scene statistics.
        planes: names of the planes to store beside the luma, of :data:`v2v_server.store.planes.OPTIONAL`.
        source: its file, or its copy on this host. Source, window and index are filled in when the job is due.
        window: the part of its upright pictures to store.
        index: its ``FrameIndex.to_bytes()``.
    """

    video: VideoEntry
    size: str
    root: Path
    stands: bool = False
    scene: bool = False
    planes: tuple[str, ...] = ()
    source: Path = Path()
    window: PixelRect = (0, 0, 0, 0)
    index: bytes = b""

    @property
    def target(self) -> Path:
        """Return the file to write; its folder is created if missing."""
        return self.root / prepared_name(self.video.id)


@dataclass(frozen=True, slots=True)
class Made(Persisted):
    """A prepared and verified file.

    Attributes:
        bytes: its size.
        scene: statistics of its frames; None if they were not requested.
    """

    bytes: int
    scene: Scene | None = None


def transcode(job: Transcoding) -> Made:
    """Write the prepared file, and read it back. Its final name holds either the complete, verified file or the earlier
    one.

    Raises:
        VideoError: the source is not the catalogued file, a frame of it does not decode, or the written file does not
            give the same frames.
        OSError: the target cannot be written.
    """
    if job.stands:
        return _read_back(job, job.target)
    index = FrameIndex.from_bytes(job.index)
    if not job.target.parent.resolve().is_relative_to(job.root):
        raise VideoError(os.fspath(job.source), None, f"{job.target.parent} is a link out of the destination")
    job.target.parent.mkdir(parents=True, exist_ok=True)
    # Hidden, so that no catalogue includes it; hashed, so that the suffix fits even with the longest names.
    name = hashlib.sha256(os.fsencode(job.target.name)).hexdigest()[:16]
    hidden = job.target.with_name(f".{name}{PARTIAL_SUFFIX}")
    cut, rate = whole_cut(len(index), job.window, job.planes), job.video.frames_per_second
    written = _Hashes(xxhash.xxh3_128)
    with (
        kind_of(job.video.id).open_pixels(job.source) as pixels,
        write_aside_and_rename(job.target, partial=hidden) as path,
    ):
        source = Verified(pixels, os.fspath(job.source), {})
        source.learn(job.video.fingerprint)
        state = source.check(job.video.fingerprint)
        write_store(
            path, source.pictures(ClipRequest(index, 0, (cut,), most_bits=MOST_BITS)), index, job.window, 0,
            len(index), video=job.video.id, fingerprint=job.video.fingerprint, packing=SIZES[job.size],
            planes=job.planes, frames_per_second=0.0 if math.isnan(rate) else rate, stored_index=job.index,
            lasting=True, see=partial(_add, written),
        )  # fmt: skip
        if source.known(job.video.fingerprint) != state:
            raise VideoUnreadable(os.fspath(job.source), None, f"{CHANGES_MEANWHILE}: run the same command again")
        return _read_back(job, path, written)


def _add(hashes: _Hashes, arrays: Mapping[str, npt.NDArray[Any]]) -> None:
    """Add what there is of the next frame."""
    for name, array in arrays.items():
        hashes[name].update(np.ascontiguousarray(array).data)


def _read_back(job: Transcoding, path: Path, written: _Hashes | None = None) -> Made:
    """Read a store file: for its statistics, and all of it if it is to be compared with what was written."""
    index, analysis, read = FrameIndex.from_bytes(job.index), SceneAnalysis(), _Hashes(xxhash.xxh3_128)
    with StoreFile(path, job.video.fingerprint) as stored:
        count = min(len(index), MOST_ANALYSED_FRAMES) if written is None else len(index)
        for number, picture in enumerate(stored.pictures(ClipRequest(index, 0, (Cut(count, job.window),)))):
            _add(read, {"": picture.grey})
            if job.scene and number < MOST_ANALYSED_FRAMES:
                analysis.add(picture.grey)
        for name in filter(None, written or ()):
            for array in stored.arrays(name):
                _add(read, {name: array})
    if written is not None and any(read[name].digest() != each.digest() for name, each in written.items()):
        raise VideoError(os.fspath(job.source), None, "verification: the stored file does not reproduce the frames")
    return Made(path.stat().st_size, analysis.scene() if job.scene else None)

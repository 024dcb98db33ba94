"""`v2v-prepare`: decode a corpus once, and store what training needs.

The prepared folder mirrors the source: the same relative paths, so the same ids, order, list files and permutation. Its
files are store files (:mod:`v2v_server.store.format`), whatever their suffixes, with the exact frames of their sources.
A manifest lists them.

The folder stays consistent after any interruption: a file gets its final name only when complete and verified, and its
line in the manifest after that. A second run keeps files that the manifest lists if file and source are unchanged, and
does the rest. Records of videos that a run does not include are set aside, not dropped (see
:mod:`v2v_server.corpus.manifest`).
"""

from __future__ import annotations

import math
import os
import shutil
from base64 import b64encode
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path

from v2v_protocol.errors import CorpusError, UsageError, VideoError
from v2v_protocol.persisted import Persisted
from v2v_protocol.sample import Refusal
from v2v_server.corpus.catalogue import Catalogue
from v2v_server.corpus.manifest import Header, ManifestWriter, PreparedVideo
from v2v_server.corpus.scenes.scene import Scene
from v2v_server.corpus.videos import VideoEntry
from v2v_server.prepare.report import Report
from v2v_server.prepare.resume import has_failed, known_records, locked, refuse_overlap, standing_files
from v2v_server.prepare.transcode import Made, Transcoding, look_again, transcode
from v2v_server.store.packing import DEFAULT_SIZE, SIZES
from v2v_server.store.planes import OPTIONAL
from v2v_server.store.reader import has_planes
from v2v_server.system.compile_cache import compile_cache
from v2v_server.system.isolate import Died, run_isolated
from v2v_server.video.orientation import Window
from v2v_server.video.rows import Rows

LEAST_FREE_BYTES = 1 << 30
"""Always keep this much disk space free: a full disk stops other programs."""

_STORED_BITS_PER_PIXEL = 2.2
"""Size of a store file, median of the measured clips (docs/prepare.md): 0.7 to 3.4."""

_TELLING_SHARE = 0.02
_CRASHES = "crashes the transcoder: its process died"

Progress = Callable[[int, int, int, int], None]
"""Progress callback: (source frames done, source frames in total, bytes written, bytes expected in total)."""


def prepare(
    catalogue: Catalogue,
    destination: str | os.PathLike[str],
    size: str = DEFAULT_SIZE,
    *,
    processes: int = 1,
    scene: bool = False,
    planes: tuple[str, ...] = (),
    single: bool = False,
    progress: Progress | None = None,
) -> Report:
    """Transcode a corpus. A video that cannot be transcoded is recorded with the reason, and the others continue.

    Args:
        catalogue: the source; its ``rows`` are stored.
        destination: the folder to create or to continue.
        size: how the files are packed, a key of :data:`v2v_server.store.packing.SIZES`.
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
        UsageError: a number of processes below 0, or an unknown size.
    """
    if processes < 0:
        raise UsageError(f"{processes} processes: give 0 or more")
    if size not in SIZES:
        raise UsageError(f"size {size!r}: choose one of {', '.join(SIZES)}")
    tell = progress or (lambda done, total, made, expected: None)
    total = sum(video.frames for video in catalogue.videos)
    tell(0, total, 0, 0)
    target = Path(destination).resolve()
    refuse_overlap(catalogue, target, single)
    header = Header(str(catalogue.rows), size, len(catalogue.videos), catalogue.folder.name, catalogue.digest)
    made: dict[str, PreparedVideo] = {}
    not_looked_at = []
    try:
        target.mkdir(parents=True, exist_ok=True)
        with locked(target):
            known = known_records(target, header, catalogue.videos)
            earlier = _earlier(target, catalogue, known, scene, planes, lambda done: tell(done, total, 0, 0))
            standing, finished, lacking = earlier.standing, earlier.finished, earlier.lacking
            left = [video for video in catalogue.videos if video.id not in finished]
            done = total - sum(video.frames for video in left)
            room = _Room(target, catalogue, left)
            wanted = {video.id for video in catalogue.videos}
            aside = [record for id, record in known.items() if id not in wanted]
            with ManifestWriter(target, header, [*standing.values(), *earlier.failed], aside) as manifest:
                for video, outcome in _outcomes(catalogue, left, earlier, target, size, scene, planes, processes):
                    if isinstance(outcome, Refusal):
                        not_looked_at.append(outcome)
                    else:
                        manifest.add(outcome)
                        made[outcome.id] = outcome
                    done += video.frames
                    room.done(video, 0 if isinstance(outcome, Refusal) else outcome.bytes)
                    tell(done, total, room.made, room.expected)
                    room.check()
    except OSError as error:
        raise CorpusError(f"{target}: cannot be written to: {error.strerror or error}") from error
    records = standing | made
    return Report(
        videos=tuple(records[id] for id in sorted(records)),
        kept=len(finished),
        unusable=catalogue.refusals,
        looked_at=len((made.keys() & standing.keys()) - lacking),
        aside=len(aside),
        not_looked_at=tuple(not_looked_at),
    )


class _Room:
    """Check of the free disk space for the expected files.

    Raises:
        CorpusError: there is not enough, by a first estimate.
        OSError: the free space cannot be read.
    """

    def __init__(self, target: Path, catalogue: Catalogue, left: Sequence[VideoEntry]) -> None:
        self._target = target
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

    def check(self) -> None:
        """Check the free space during the run.

        Raises:
            CorpusError: the disk is nearly full.
        """
        free = shutil.disk_usage(self._target).free
        if free < LEAST_FREE_BYTES:
            raise CorpusError(
                f"{self._target}: the disk has {free / 1e9:.2f} GB free, of which {LEAST_FREE_BYTES / 1e9:.1f} must "
                "stay free; finished files are kept; free disk space and run the same command to continue"
            )


def _pixels(video: VideoEntry, rows: Rows) -> int:
    try:
        top, bottom = rows.bounds(video.height_px)
    except UsageError:
        return 0
    return video.frames * (bottom - top) * video.width_px


@dataclass(frozen=True, slots=True)
class _Earlier:
    """Results of earlier runs for the videos of this one.

    Attributes:
        standing: records by id, whose prepared file exists.
        finished: ids of those that are complete.
        lacking: ids of those whose files lack a requested plane.
        failed: records without a file. They stay until the video was tried again: a finished folder stays finished.
    """

    standing: dict[str, PreparedVideo]
    finished: set[str]
    lacking: set[str]
    failed: list[PreparedVideo]


def _earlier(
    target: Path,
    catalogue: Catalogue,
    known: dict[str, PreparedVideo],
    scene: bool,
    planes: tuple[str, ...],
    tell: Callable[[int], None],
) -> _Earlier:
    earlier = _Earlier({}, set(), set(), [])
    done = 0
    with closing(standing_files(target, catalogue.videos, known)) as files:
        for video, stands in files:
            if stands:
                record = earlier.standing[video.id] = known[video.id]
                if not has_planes(target / video.id, planes):
                    earlier.lacking.add(video.id)
                elif record.scene or not scene:
                    earlier.finished.add(video.id)
                    done += video.frames
            elif has_failed(video, known):
                earlier.failed.append(known[video.id])
            tell(done)
    return earlier


def _outcomes(
    catalogue: Catalogue,
    videos: Iterable[VideoEntry],
    earlier: _Earlier,
    target: Path,
    size: str,
    scene: bool,
    planes: tuple[str, ...],
    processes: int,
) -> Iterator[tuple[VideoEntry, PreparedVideo | Refusal]]:
    """Yield the new record of each video, in order of completion, or a problem if the existing record has to stay."""
    jobs = []
    for video in videos:
        try:
            window = _window(video, catalogue.rows)
            jobs.append(_ToPrepare(video, window, earlier.standing.get(video.id), video.id in earlier.lacking))
        except UsageError as error:
            yield video, _record(video, str(error))

    changed: list[tuple[_ToPrepare, str]] = []

    def transcodings() -> Iterator[tuple[_ToPrepare, Transcoding]]:
        for job in jobs:
            id = job.video.id
            keeps_scene = job.standing is not None and job.standing.scene != ""
            # A file that is made again for one plane keeps its others.
            more = [name for name in OPTIONAL if job.lacks_planes and has_planes(target / id, (name,))]
            try:
                index = catalogue.frame_index(id).to_bytes()
            except VideoError as error:
                changed.append((job, error.reason))
                continue
            yield job, Transcoding(
                id, catalogue.path(id), job.video.fingerprint, index, job.video.frames_per_second,
                job.window, size, target, target / id, scene or keeps_scene,
                tuple(dict.fromkeys((*planes, *more))),
            )  # fmt: skip

    isolated = run_isolated(
        _attempt,
        transcodings(),
        processes,
        lambda job: _deadline_seconds(job[0]),
        writable=(target, *compile_cache()),
    )
    found: Iterator[tuple[_ToPrepare, Made | Scene | str | Died]] = ((job, result) for (job, _), result in isolated)
    for job, result in chain(found, changed):
        if isinstance(result, Died):
            result = f"hangs the transcoder: {result.how}" if result.overdue_seconds else f"{_CRASHES} ({result.how})"
        if isinstance(result, Scene) and job.standing is not None:
            yield job.video, replace(job.standing, scene=_text(result))
        elif isinstance(result, str) and job.standing is not None:
            yield job.video, Refusal(job.video.id, None, result)
        else:
            # Only a process that a video has taken over analyses what it was told to transcode.
            made = f"{_CRASHES} (it sent a malformed result)" if isinstance(result, Scene) else result
            yield job.video, _record(job.video, made)


@dataclass(frozen=True, slots=True)
class _ToPrepare(Persisted):
    """A video to transcode, or only to analyse if its prepared file exists and lacks no plane."""

    video: VideoEntry
    window: Window
    standing: PreparedVideo | None
    lacks_planes: bool


def _window(video: VideoEntry, rows: Rows) -> Window:
    top, bottom = rows.bounds(video.height_px)
    return top, 0, bottom - top, video.width_px


def _deadline_seconds(job: _ToPrepare) -> float:
    """Return the time limit for a video, seconds: some fifty times what a core takes to transcode and verify it. It
    ends jobs whose storage never answers.
    """
    video = job.video
    return 600 + video.frames * (0.5 + 5e-6 * video.width_px * video.height_px)


def _attempt(job: tuple[_ToPrepare, Transcoding]) -> Made | Scene | str:
    """Return the result of one job, or the reason why there is none."""
    try:
        return transcode(job[1]) if job[0].standing is None or job[0].lacks_planes else look_again(job[1])
    except VideoError as error:
        return error.reason if error.frame is None else f"frame {error.frame}: {error.reason}"
    except OSError as error:
        return f"cannot be written: {error.strerror or error}"
    except Exception as error:  # noqa: BLE001 - one strange file must not end the preparation of all others
        return f"preparing failed: {type(error).__name__}: {error}"


def _record(video: VideoEntry, result: Made | str) -> PreparedVideo:
    rate = video.frames_per_second
    # A fingerprint begins with the size in bytes.
    size = int(video.fingerprint.partition("-")[0])
    record = PreparedVideo(
        video.id, video.fingerprint, size, video.frames, None if math.isnan(rate) else rate, video.height_px,
        video.width_px,
        remark=video.remark,
    )  # fmt: skip
    if isinstance(result, str):
        return replace(record, problem=result)
    return replace(
        record,
        fingerprint=result.fingerprint,
        bytes=result.bytes,
        scene="" if result.scene is None else _text(result.scene),
    )


def _text(scene: Scene) -> str:
    return b64encode(scene.to_bytes()).decode()

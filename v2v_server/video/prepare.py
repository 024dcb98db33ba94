"""`v2v-prepare`: a corpus transcoded once to what training needs.

The prepared folder mirrors the source: the same relative paths, so the same ids, order, list files and permutation, and
a manifest that says what the files are. Its files are MP4 whatever their names end in; FFmpeg goes by content.

Whatever happens, the folder stays sound: a file gets its name only when whole and verified, and its line in the
manifest after that. A second run keeps what the manifest lists, if file and source are still those, and does the rest.
"""

from __future__ import annotations

import contextlib
import fcntl
import math
import os
from base64 import b64encode
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from v2v_protocol.errors import CorpusError, UsageError, VideoError
from v2v_server.video.catalogue import Catalogue, Problem, VideoEntry
from v2v_server.video.encode import Encoding
from v2v_server.video.fingerprint import fingerprint
from v2v_server.video.isolate import Died, run_isolated
from v2v_server.video.manifest import (
    MANIFEST_NAME,
    Header,
    ManifestWriter,
    PreparedVideo,
    read_manifest,
)
from v2v_server.video.orientation import Window
from v2v_server.video.rows import Rows
from v2v_server.video.transcode import PARTIAL_SUFFIX, Made, Transcoding, transcode

DEFAULT_FLOOR_DB = 35.0

_LOCK_NAME = ".v2v-prepare.lock"

Progress = Callable[[int, int], None]
"""(source frames dealt with, source frames in all)."""


@dataclass(frozen=True, slots=True)
class Report:
    """What a run has done.

    Attributes:
        videos: a record of every video of the source, by id.
        kept: how many of them an earlier run had done.
        unusable: files of the source that no server takes in either.
        floor_db: least PSNR of a clip.
    """

    videos: tuple[PreparedVideo, ...]
    kept: int
    unusable: tuple[Problem, ...]
    floor_db: float

    @property
    def prepared(self) -> tuple[PreparedVideo, ...]:
        """Those that have a prepared file."""
        return tuple(video for video in self.videos if video.problem is None)

    @property
    def failed(self) -> tuple[PreparedVideo, ...]:
        """Those that have none."""
        return tuple(video for video in self.videos if video.problem is not None)

    @property
    def below_floor(self) -> tuple[PreparedVideo, ...]:
        """Those whose PSNR is below the floor, worst first. Their files are kept, and served."""
        low = [video for video in self.prepared if _psnr(video) < self.floor_db]
        return tuple(sorted(low, key=_psnr))

    @property
    def source_bytes(self) -> int:
        """Of the sources that were prepared."""
        return sum(video.source_bytes for video in self.prepared)

    @property
    def prepared_bytes(self) -> int:
        """Of the prepared files."""
        return sum(video.bytes for video in self.prepared)

    @property
    def complete(self) -> bool:
        """Whether every video file was prepared, and well enough."""
        return not (self.failed or self.below_floor or self.unusable)


def prepare(
    catalogue: Catalogue,
    destination: str | os.PathLike[str],
    encoding: Encoding,
    *,
    processes: int = 1,
    floor_db: float = DEFAULT_FLOOR_DB,
    scene: bool = False,
    progress: Progress | None = None,
) -> Report:
    """Transcode a corpus; a video that cannot be is recorded with the reason, and the others go on.

    Args:
        catalogue: the source; its ``rows`` are what is kept of the pictures.
        destination: the folder to make or to go on with.
        encoding: codec settings.
        processes: how many transcode at a time, spawned; 0 transcodes in this one.
        floor_db: least PSNR of a clip for ``Report.below_floor``.
        scene: also take the statistics of what each video shows; one prepared without them is prepared again.
        progress: told at the start and after each video.

    Raises:
        CorpusError: source and destination overlap, the destination holds something else or was prepared with other
            settings, another process is at work there, or the source is prepared itself.
        UsageError: a number outside its limits.
    """
    if processes < 0 or not math.isfinite(floor_db):
        raise UsageError(f"{processes} processes, floor {floor_db:g} dB: give 0 or more, and a finite number")
    target = Path(destination).resolve()
    _refuse_overlap(catalogue, target)
    header = Header(
        str(catalogue.rows), encoding.codec, encoding.quality, encoding.gop, len(catalogue.videos),
        catalogue.root.name, catalogue.digest, tile_px=encoding.tile_px, tile_overlap_px=encoding.tile_overlap_px,
    )  # fmt: skip
    try:
        target.mkdir(parents=True, exist_ok=True)
        with _locked(target):
            known = _known(target, header)
            kept = {video.id: known[video.id] for video in catalogue.videos if _stands(target, video, known, scene)}
            with ManifestWriter(target, header, kept.values()) as manifest:
                made = _transcode_rest(catalogue, target, encoding, kept, scene, processes, manifest, progress)
    except OSError as error:
        raise CorpusError(f"{target}: cannot be written to: {error.strerror or error}") from error
    records = kept | made
    return Report(tuple(records[id] for id in sorted(records)), len(kept), catalogue.problems, floor_db)


def _refuse_overlap(catalogue: Catalogue, target: Path) -> None:
    root = catalogue.root
    if catalogue.prepared is not None:
        raise CorpusError(f"{root} is a prepared folder itself; prepare its source instead")
    if target == root or target.is_relative_to(root) or root.is_relative_to(target):
        raise CorpusError(f"{target} and the source {root} lie in one another; choose a destination beside the source")
    for video in catalogue.videos:
        if (root / video.id).resolve().is_relative_to(target):
            raise CorpusError(f"{target}: {video.id} of the source is a link into it; choose another destination")


@contextlib.contextmanager
def _locked(target: Path) -> Iterator[None]:
    """Keeps other processes out of the folder; the system lets go of the lock however this one ends."""
    with (target / _LOCK_NAME).open("w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise CorpusError(f"{target}: another v2v-prepare is at work there; wait for its end") from None
        yield


def _known(target: Path, header: Header) -> dict[str, PreparedVideo]:
    """The records of earlier runs, after clearing away what they left unfinished."""
    if not (target / MANIFEST_NAME).exists():
        for folder in target.parents:
            if (folder / MANIFEST_NAME).exists():
                raise CorpusError(f"{target} lies in the prepared folder {folder}; choose another destination")
        foreign = sorted(entry.name for entry in target.iterdir() if not entry.name.startswith("."))
        if foreign:
            raise CorpusError(
                f"{target}: holds {foreign[0]} ({len(foreign)} entries) and no manifest of v2v-prepare; choose an "
                "empty or a new folder"
            )
        return {}
    manifest = read_manifest(target)
    if not manifest.header.same_settings(header):
        raise CorpusError(
            f"{target} was prepared with {manifest.header.settings()}, and now {header.settings()} is asked for; "
            "choose another folder, or delete this one"
        )
    for partial in target.rglob(f".*{PARTIAL_SUFFIX}"):
        partial.unlink()
    return manifest.videos


def _stands(target: Path, video: VideoEntry, known: dict[str, PreparedVideo], scene: bool) -> bool:
    """Whether the prepared file is there, unchanged, and that of this state of the source."""
    record = known.get(video.id)
    if record is None or record.problem is not None or record.source_fingerprint != video.fingerprint:
        return False
    if scene and not record.scene:
        return False
    try:
        return fingerprint(target / video.id) == record.fingerprint
    except VideoError:
        return False


def _transcode_rest(
    catalogue: Catalogue,
    target: Path,
    encoding: Encoding,
    kept: dict[str, PreparedVideo],
    scene: bool,
    processes: int,
    manifest: ManifestWriter,
    progress: Progress | None,
) -> dict[str, PreparedVideo]:
    left = {video.id: video for video in catalogue.videos if video.id not in kept}
    total = sum(video.frames for video in catalogue.videos)
    done = total - sum(video.frames for video in left.values())
    made: dict[str, PreparedVideo] = {}
    if progress is not None:
        progress(done, total)
    for record in _records(catalogue, left.values(), target, encoding, scene, processes):
        manifest.add(record)
        made[record.id] = record
        done += left[record.id].frames
        if progress is not None:
            progress(done, total)
    return made


def _records(
    catalogue: Catalogue,
    videos: Iterable[VideoEntry],
    target: Path,
    encoding: Encoding,
    scene: bool,
    processes: int,
) -> Iterator[PreparedVideo]:
    jobs = []
    for video in videos:
        try:
            jobs.append(_Job(video, _window(video, catalogue.rows)))
        except UsageError as error:
            yield _record(video, 0, 0, str(error))

    def transcodings() -> Iterator[tuple[_Job, Transcoding]]:
        for job in jobs:
            id = job.video.id
            index = catalogue.frame_index(id).to_bytes()
            yield job, Transcoding(
                catalogue.path(id), job.video.fingerprint, index, job.video.frames_per_second, job.window, encoding,
                target, target / id, scene,
            )  # fmt: skip

    for (job, _), result in run_isolated(_attempt, transcodings(), processes):
        if isinstance(result, Died):
            result = f"crashes the transcoder: its process died ({result.how})"
        yield _record(job.video, *job.window[2:], result)


@dataclass(frozen=True, slots=True)
class _Job:
    video: VideoEntry
    window: Window


def _window(video: VideoEntry, rows: Rows) -> Window:
    top, bottom = rows.bounds(video.height_px)
    return top, 0, bottom - top, video.width_px


def _attempt(job: tuple[_Job, Transcoding]) -> Made | str:
    """What was made, or why nothing was."""
    try:
        return transcode(job[1])
    except VideoError as error:
        return error.reason if error.frame is None else f"frame {error.frame}: {error.reason}"
    except OSError as error:
        return f"cannot be written: {error.strerror or error}"
    except Exception as error:  # noqa: BLE001 - one strange file must not end the preparation of all others
        return f"preparing failed: {type(error).__name__}: {error}"


def _record(video: VideoEntry, height: int, width: int, result: Made | str) -> PreparedVideo:
    rate = video.frames_per_second
    # A fingerprint begins with the size in bytes.
    size = int(video.fingerprint.partition("-")[0])
    record = PreparedVideo(
        video.id, video.fingerprint, size, video.frames, None if math.isnan(rate) else rate, height, width
    )
    if isinstance(result, str):
        return replace(record, problem=result)
    return replace(
        record,
        fingerprint=result.fingerprint,
        bytes=result.bytes,
        psnr_db=result.psnr_db,
        worst_psnr_db=result.worst_psnr_db,
        scene="" if result.scene is None else b64encode(result.scene.to_bytes()).decode(),
    )


def _psnr(video: PreparedVideo) -> float:
    return math.inf if video.psnr_db is None else video.psnr_db

"""Read many files in processes of their own, so that a file that kills its reader costs only itself: what each video
holds, what its scene shows, and its sidecars. The index keeps what is found.

An analysis of a scene decodes the beginning of a video once. The index keeps the result for the file's fingerprint and
the rows that were analysed, and the pieces once more as a summary: a start reads only these. A prepared folder's
manifest may state it, too.

What a sidecar holds, and whether it fits its video, is kept in the same way, and believed while sizes and times of the
files stay the same. New and changed sidecars are read under limits of time and memory.
"""

from __future__ import annotations

import hashlib
import math
import sqlite3
import time
from base64 import b64decode
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TypeVar

import numpy as np
import xxhash

from v2v_protocol.errors import UsageError, VideoError, VideoUnreadable
from v2v_protocol.persisted import Persisted
from v2v_protocol.programs import counted, printable
from v2v_server.corpus.index import FigureKind, Figures, Store
from v2v_server.corpus.scenes.scene import ANALYSIS_VERSION, MOST_ANALYSED_FRAMES, PIECE, Scene
from v2v_server.corpus.sources.listing import Notice, by_parts
from v2v_server.corpus.sources.prepared import Manifest, manifest_of
from v2v_server.corpus.sources.sidecars import files_between, open_sidecar, read_files, sidecar_id
from v2v_server.corpus.sources.source import VideoSource, rate_of
from v2v_server.corpus.videos import IndexRow, Sidecars, SplitVideos, VideoTable, encoded_pieces, joined
from v2v_server.kinds.kind import VideosKind
from v2v_server.kinds.registry import VIDEOS, kind_of
from v2v_server.labels import check_labels
from v2v_server.system.compile_cache import compile_cache
from v2v_server.system.isolate import Died, run_isolated, run_twice
from v2v_server.video.decode import ClipRequest, Cut
from v2v_server.video.fingerprint import fingerprint
from v2v_server.video.frame_index import FrameIndex
from v2v_server.video.picture import PixelRect
from v2v_server.video.probe import VideoFacts
from v2v_server.video.rows import Rows

LONGEST_SECONDS = 3600.0
"""Limit for reading a whole file, also on slow storage; beyond it the file is treated as endless."""

LARGEST_PROBE_BYTES = 2 << 30
"""Memory that a process may allocate to probe a file: enough for 16 pictures of the largest size, or a list of 2**24
frames. A file of some kB can claim a thousand million frames, for which a demuxer would allocate memory."""

_MOST_TOGETHER = 1024
_MOST_SECONDS = 10.0
VideoProgress = Callable[[int, int], None]
"""(files done so far, files to do)."""
ProbeJob = tuple[str, tuple[int, ...]]
"""Id of a video, and the state of a member of an archive; empty for a file."""
ProbeFile = Callable[[VideoSource, ProbeJob], IndexRow]
"""(source, job) -> what is known of that file; see :func:`probe_file`."""
T = TypeVar("T")


def probe_file(source: VideoSource, job: ProbeJob) -> IndexRow:
    """Probe one file; an error becomes the record's ``problem``.

    A file that cannot be read gets the size -1, which no file has: it is probed again at the next start.
    """
    id, kind = job[0], source.kind
    owner, source.expected = kind_of(id), job if job[1] else ("", ())
    if owner.unprepared and owner.name != kind.name:  # what can be prepared may be a store, which needs no flag
        return IndexRow(id, -1, problem=f"is {owner.help}: add --videos-kind {owner.name}")
    try:
        before = source.state(id)
        with source.open_local(id, "") as path:
            mark = fingerprint(path)
            facts = kind.with_flags(_facts(path, kind), rate_of(source, id))
        name = facts.made_of or (f"{mark}-{facts.content}" if facts.content else mark)
        if source.state(id) != before:
            return IndexRow(id, -1, problem="changes while it is read; the next start tries again")
        if source.copies is not None:
            source.copies.keep_as(id, mark, name)
    except OSError as error:
        return IndexRow(id, -1, problem=f"cannot be read: {error.strerror or error}")
    except VideoUnreadable as error:
        return IndexRow(id, -1, problem=error.reason)
    except VideoError as error:
        where = "" if error.frame is None else f"frame {error.frame}: "
        return IndexRow(id, *before, problem=where + error.reason)
    except Exception as error:  # noqa: BLE001 - one strange file must not end the probing of all others
        return IndexRow(id, *before, problem=f"probing failed: {type(error).__name__}: {error}")
    return IndexRow(
        id,
        *before,
        fingerprint=name,
        frames=facts.frames,
        width_px=facts.width_px,
        height_px=facts.height_px,
        frames_per_second=None if math.isnan(facts.frames_per_second) else facts.frames_per_second,
        codec=facts.codec,
        interlaced=facts.interlaced,
        remark=facts.remark,
        frame_index=facts.index.to_bytes(),
    )


def facts_of(path: Path, kind: VideosKind = VIDEOS) -> VideoFacts:
    """Return what is known of the video in a file. Errors: :class:`v2v_server.store.pixels.Pixels`."""
    with kind.open_pixels(path) as pixels:
        return pixels.facts()


def _facts(path: Path, kind: VideosKind, is_last: bool = False) -> VideoFacts:
    """Return what is known of the video; retry once after an error of the system rather than of the decoder.

    Raises:
        VideoUnreadable: the system reported an error twice.
        VideoError: the file is not a supported video.
    """
    try:
        return facts_of(path, kind)
    except VideoError as error:
        if not isinstance(error.__cause__, OSError):
            raise
        if is_last:
            raise VideoUnreadable(error.video, error.frame, error.reason) from error
    return _facts(path, kind, is_last=True)


def probe_files(
    source: VideoSource,
    ids: Iterable[str],
    processes: int,
    probe: ProbeFile = probe_file,
    longest_seconds: float = LONGEST_SECONDS,
) -> Generator[IndexRow, None, None]:
    """Yield a record of each id, in any order.

    A file at which a process died is probed once more after all others, alone.

    Args:
        source: where the videos come from.
        ids: relative paths.
        processes: number of processes to probe in; 0 probes in this one, which a file that crashes the decoder ends.
        probe: probes one file; must be picklable.
        longest_seconds: limit for one file; the next start tries it again.
    """
    results = run_twice(
        partial(probe, source),
        ((id, source.members.get(id, ())) for id in ids),
        processes,
        deadline_seconds=lambda job: longest_seconds,
        memory_bytes=LARGEST_PROBE_BYTES,
        writable=() if source.is_local else None,  # copies are fetched: from a network, into a folder
    )
    for (id, _), found in results:
        yield _culprit(source, id, found) if isinstance(found, Died) else replace(found, id=id)


def _culprit(source: VideoSource, id: str, death: Died) -> IndexRow:
    if death.overdue_seconds:
        return IndexRow(id, -1, problem=f"cannot be probed: {death.how}; the next start tries again")
    if not death.is_crash:
        why = f"could not be probed: the process ended over it twice ({death.how}), which says nothing of the file"
        return IndexRow(id, -1, problem=f"{why}; the next start tries again")
    why = f"crashes the decoder: the process that probed it died ({death.how})"
    size, modified, changed = source.states([id])  # none of a file that is gone: if it comes back, it is probed again
    return IndexRow(id, size, modified, changed, problem=why)


def batches(
    items: Iterable[T], total: int, progress: VideoProgress, clock: Callable[[], float] = time.monotonic
) -> Iterator[list[T]]:
    """Yield items in batches that are written to the index at once: a kill loses at most one.

    Args:
        total: number of items, for ``progress``.
        progress: called after each item.
    """
    batch: list[T] = []
    begun = clock()
    for done, item in enumerate(items, 1):
        batch.append(item)
        progress(done, total)
        if len(batch) == _MOST_TOGETHER or clock() - begun > _MOST_SECONDS:
            yield batch
            batch, begun = [], clock()
    if batch:
        yield batch


_ENDING = f", look {ANALYSIS_VERSION}"
_HASH_BYTES = 8
"""At the beginning of a summary; the encoded pieces follow."""


@dataclass(frozen=True, slots=True)
class SceneCollection:
    """How the videos of a corpus are analysed.

    Attributes:
        rows: of the corpus.
    """

    rows: Rows

    @property
    def kind(self) -> FigureKind:
        """Distinguish analyses of one file."""
        return FigureKind("scene", f"{self.rows}{_ENDING}")

    def collect(
        self,
        store: Store,
        source: VideoSource,
        table: VideoTable,
        processes: int,
        progress: VideoProgress,
        notice: Notice,
    ) -> bool:
        """Analyse each usable video without a scene in the index, and store the scene unless the analysis fails.

        Returns:
            whether there were such videos.

        Raises:
            sqlite3.Error: the index cannot be written.
        """
        missing = np.flatnonzero((table.summaries.lengths == 0) & (table.problem == np.array(None))).tolist()
        if missing and store.has_other_versions(self.kind.name, _ENDING):
            notice(f"analysing {counted(len(missing), 'video')} again: this release finds more than earlier ones")
        with closing(self._found(store, source, table, missing, processes)) as found:
            for batch in batches(found, len(missing), progress):
                store.put_figures(self.kind, (figures(*each) for each in batch))
        return bool(missing)

    def read(self, store: Store, table: VideoTable, unknown: set[str], digest: str) -> tuple[SplitVideos, str]:
        """Return the pieces of videos, and a digest of all scenes.

        Args:
            table: the videos of a snapshot, with the summaries of their scenes.
            unknown: ids of videos without a known scene; those that have none in the index are added.
            digest: of the snapshot.

        Raises:
            sqlite3.Error: the index is damaged.
        """
        lengths = table.summaries.lengths
        is_known = (lengths >= _HASH_BYTES) & (lengths % PIECE.itemsize == _HASH_BYTES)
        is_known[[place for id in unknown if (place := table.ids.find(id)) is not None]] = False
        unknown.update(table.ids[place] for place in np.flatnonzero(~is_known).tolist())
        summaries = table.summaries.where(is_known)
        state = hashlib.sha256(is_known.data)
        state.update(lengths.data)
        state.update(summaries.utf8.data)
        begin = np.cumsum(summaries.lengths) - summaries.lengths
        is_piece = np.ones(len(summaries.utf8), bool)
        is_piece[(begin[:, None] + np.arange(_HASH_BYTES)).ravel()] = False
        split = SplitVideos.select(summaries.utf8[is_piece].view(PIECE), summaries.lengths // PIECE.itemsize)
        split = replace(split, numbers=np.flatnonzero(is_known)[split.numbers].astype(np.int32))
        return split, self._digest(store, table.ids, unknown, digest, state.hexdigest())

    def _digest(self, store: Store, ids: Sequence[str], unknown: set[str], digest: str, state: str) -> str:
        """Return the digest of all scenes. It takes reading them all, so the index keeps it for one state of them."""
        kept, key = FigureKind("scene digest", self.kind.version), f"{digest} {state}"
        if (known := store.figures("", key, kept)) is not None:
            return known.decode()
        sha = hashlib.sha256(f"v2v catalogue with scenes 1\n{digest}\n".encode())
        nothing = Scene.unknown().to_bytes()
        for id, _, data in joined(ids, store.all_figures(self.kind), [], (b"", nothing)):
            sha.update(nothing if id in unknown else data)
        with suppress(sqlite3.Error):  # a locked index costs the next start this time again
            store.put_figures(kept, [Figures("", key, b"", sha.hexdigest()[:32].encode())])
        return sha.hexdigest()[:32]

    def _found(
        self, store: Store, source: VideoSource, table: VideoTable, missing: list[int], processes: int
    ) -> Generator[tuple[IndexRow | _SceneJob, Scene], None, None]:
        left, manifest = [], manifest_of(source)
        for place in missing:
            record = table.row(place)
            if (data := self._stated(manifest, record)) is None:
                left.append(place)
            else:
                yield record, Scene.from_bytes(data)

        def jobs() -> Iterator[_SceneJob]:
            for record in map(table.row, left):
                index = store.frame_index(record.id, record.fingerprint) or b""
                place = source.members.get(record.id, ())
                yield _SceneJob(record.id, record.fingerprint, record.frames, index, self._window(record), place)

        results = run_twice(
            partial(_analyse, source),
            jobs(),
            processes,
            deadline_seconds=lambda job: LONGEST_SECONDS,
            memory_bytes=2 * LARGEST_PROBE_BYTES,
            writable=compile_cache() if source.is_local else None,
        )
        for job, found in results:
            if isinstance(found, Scene):
                yield job, found
            # Otherwise the video counts as unknown, and the next start tries again.

    def _stated(self, manifest: Manifest | None, record: IndexRow) -> bytes | None:
        """Return the encoded scene that a prepared folder's manifest states, if it is of the rows of the corpus."""
        if manifest is None or Rows.parse(manifest.header.rows) != self.rows:
            return None
        video = manifest.videos[record.id]
        is_there = video.scene and record.fingerprint == video.source_fingerprint
        return b64decode(video.scene) if is_there else None

    def _window(self, record: IndexRow) -> PixelRect | None:
        try:
            top, bottom = self.rows.bounds(record.height_px)
        except UsageError:
            return None  # no sequence is made of it either
        return top, 0, bottom - top, record.width_px


def figures(video: IndexRow | _SceneJob, scene: Scene) -> Figures:
    """Return what the index keeps of a scene; the summary is a hash of it and the encoded pieces."""
    data = scene.to_bytes()
    summary = xxhash.xxh3_64_digest(data) + encoded_pieces(scene.pieces, video.frames)
    return Figures(video.id, video.fingerprint, summary, data)


@dataclass(frozen=True, slots=True)
class _SceneJob(Persisted):
    id: str
    fingerprint: str
    frames: int
    index: bytes
    window: PixelRect | None
    place: tuple[int, ...]


def _analyse(source: VideoSource, job: _SceneJob) -> Scene | None:
    """Return the scene of one video, from what decodes before the first error.

    It is None where the system, not the decoder, reports an error.
    """
    # Import lazily: processes that only open a catalogue need no OpenCV.
    from v2v_server.corpus.scenes.analysis import SceneAnalysis

    analysis, source.expected = SceneAnalysis(), (job.id, job.place) if job.place else ("", ())
    if job.index and job.window is not None:
        try:
            with source.open_pixels(job.id, job.fingerprint) as pixels:
                index = FrameIndex.from_bytes(job.index)
                for picture in pixels.pictures(
                    ClipRequest(index, 0, (Cut(min(len(index), MOST_ANALYSED_FRAMES), job.window),))
                ):
                    analysis.add(picture.grey)
        except VideoError as error:
            if isinstance(error, VideoUnreadable) or isinstance(error.__cause__, OSError):
                return None
            # A worker that decodes the frames after the error reports the same error.
    return analysis.scene()


Shape = Callable[[str], tuple[int, int, int]]
"""Number of frames, and height and width of the upright picture, of the video of an id."""
_SidecarJob = tuple[str, str, str, int, int, int]
"""Id of the video, id and ending of its sidecar, and the shape of the video."""
_SidecarFound = tuple[str, str, str, bytes]
"""Fingerprint, why it is refused, which files are not read, and the table of its files; the texts may be empty."""

_TOGETHER = 64
_LONGEST_REASON = 500
_LARGEST_PART_BYTES = 512 << 10
"""Limit of the files that a lease names: its message has 1 MiB."""


def sidecar_kind(ending: str) -> FigureKind:
    """Return the kind of figures that holds the sidecars of an ending."""
    return FigureKind(f"sidecar {ending}", "2")


def files_for_lease(data: bytes | None, fingerprint: str, start: int, count: int) -> bytes | str:
    """Return the table of the files of some frames; or why the sidecar cannot be used.

    Args:
        data: what the index holds of the sidecar; None: nothing.
        fingerprint: as catalogued.
        start, count: the frames.
    """
    mark, _, table = (data or b"").partition(b"\n")
    with suppress(ValueError):  # damaged
        if mark == fingerprint.encode():
            part = files_between(table, start, start + count)
            too_long = f"has too many files for a clip of {count} frames: the list of them has {len(part)} bytes"
            return part if len(part) <= _LARGEST_PART_BYTES else f"{too_long}; the limit is {_LARGEST_PART_BYTES}"
    return "differs from the index, which another program changed: restart the server to serve it as it is now"


def collect_sidecars(
    source: VideoSource,
    store: Store,
    videos: Mapping[str, str],
    shape: Shape,
    endings: Sequence[str],
    processes: int,
    notice: Notice,
) -> tuple[dict[str, Sidecars], list[str]]:
    """Return the sidecars of each ending, and notes for the user. Only new and changed ones are read.

    Args:
        source: where the videos come from.
        store: the index.
        videos: fingerprint of each video's file, by id.
        shape: of each video.
        endings: see :mod:`v2v_server.corpus.sources.source`.
        processes: number of processes that read; 0 reads in this one.
        notice: progress callback.
    """
    sidecars, notes = dict[str, Sidecars](), list[str]()
    for ending, ids in source.with_sidecars(sorted(videos), endings).items():
        states = _states(source, ending, ids, notice) if ids else {}
        problems = {video: _line(state) for video, state in states.items() if isinstance(state, OSError)}
        present = {video: state for video, state in states.items() if isinstance(state, str) and state}
        found = _known(store, ending, present) if present else {}
        jobs = [(video, sidecar_id(video, ending), ending, *shape(video)) for video in present if video not in found]
        for video, facts in _read(source, store, ending, jobs, present, videos, processes, notice):
            found[video] = facts
        problems |= {video: facts[1] for video, facts in found.items() if facts[1]}
        fingerprints = {video: found[video][0] for video in sorted(found) if found[video][0]}
        sidecars[ending] = Sidecars(fingerprints, _digest(ending, fingerprints), present, problems)
        missing = [
            f"{sidecar_id(video, ending)}: {why}" for video, why in problems.items() if video not in fingerprints
        ]
        refused = [f"{video}: {why}" for video, why in problems.items() if video in fingerprints]
        not_read = [f"{sidecar_id(video, ending)}: {facts[2]}" for video, facts in found.items() if facts[2]]
        notes += [f"{len(fingerprints)} of {len(videos)} videos have a sidecar {ending}"] if fingerprints else []
        notes += [
            f"{len(those)} sidecars {text} ({those[0]})"
            for those, text in (
                (missing, "cannot be read and count as missing"),
                (refused, f"{ending} are refused, and their videos are served without these labels"),
                (not_read, f"{ending} have files that are no labels"),
            )
            if those
        ]
    return sidecars, notes


def _states(source: VideoSource, ending: str, ids: Sequence[str], notice: Notice) -> dict[str, str | OSError]:
    """Return the state of each video's sidecar, or why it cannot be told."""

    def states(part: Sequence[str]) -> list[str | OSError]:
        return [source.sidecar_state(sidecar_id(video, ending)) for video in part]

    found = dict[str, str | OSError]()
    with closing(by_parts(states, ids)) as answered:
        for part, those in answered:
            found.update(zip(part, those, strict=True))
            notice(f"looking for sidecars {ending} in {source}: {len(found)} of {len(ids)} videos")
    return found


def _known(store: Store, ending: str, states: Mapping[str, str]) -> dict[str, list[str]]:
    """Return the facts of unchanged sidecars from the index."""
    with suppress(sqlite3.Error):  # an index that cannot be read costs time only
        store.make_figures()
        rows = ((row[0], row[-1]) for row in store.rows(sidecar_kind(ending)))
        entries = {id: data.decode("utf-8", "replace").split("\n") for id, data in rows if isinstance(data, bytes)}
        return {id: entry[1:] for id, entry in entries.items() if entry[0] == states.get(id) and len(entry) == 4}
    return {}


def _read(
    source: VideoSource,
    store: Store,
    ending: str,
    jobs: Sequence[_SidecarJob],
    states: Mapping[str, str],
    videos: Mapping[str, str],
    processes: int,
    notice: Notice,
) -> Iterator[tuple[str, list[str]]]:
    """Read new and changed sidecars, put what is found into the index, and yield it: (video, facts)."""
    isolated = run_isolated(
        partial(read_sidecar, source),
        jobs,
        processes,
        deadline_seconds=lambda job: LONGEST_SECONDS,
        memory_bytes=LARGEST_PROBE_BYTES,
        writable=() if source.is_local else None,  # copies are fetched: from a network, into a folder
    )
    fresh = list[Figures]()
    try:
        for done, ((video, id, *_), result) in enumerate(isolated, 1):
            notice(f"read {id}, {done} of {len(jobs)} new or changed sidecars {ending}")
            if isinstance(result, Died):
                result = "", f"reading it took too much time or memory, or crashed ({result.how})", "", b""
            *facts, table = result
            if facts[0]:
                text, mark = "\n".join((states[video], *facts)), facts[0].encode() + b"\n"
                fresh.append(Figures(video, videos[video], text.encode(), mark + table))
            if len(fresh) == _TOGETHER:
                _save(store, ending, fresh)
            yield video, facts
    finally:
        _save(store, ending, fresh)  # also of an interrupted start


def _save(store: Store, ending: str, fresh: list[Figures]) -> None:
    with suppress(sqlite3.Error):  # the next start reads them again; until then leases refuse folders, in words
        store.put_figures(sidecar_kind(ending), fresh)
    fresh.clear()


def _digest(ending: str, fingerprints: Mapping[str, str]) -> str:
    sha = hashlib.sha256(f"v2v sidecars 1\n{ending}\n".encode())
    for id in sorted(fingerprints):
        sha.update(f"{id}\0{fingerprints[id]}\n".encode())
    return sha.hexdigest()[:32]


def read_sidecar(source: VideoSource, job: _SidecarJob) -> _SidecarFound:
    """Read a sidecar whole, and check that it fits its video; an error becomes the reason why it is not used."""
    _, id, ending, frames, height_px, width_px = job
    mark, table = "", b""
    try:
        with open_sidecar(source, id, "") as opened:
            mark, table = read_files(opened)
            return mark, "", _line(check_labels(ending, opened, (height_px, width_px), frames)), table
    except Exception as error:  # noqa: BLE001 - one strange file must not end the reading of all others
        is_unread = isinstance(error, OSError | VideoError)  # may pass: the next start tries again
        return "" if is_unread else mark, _line(error), "", table


def _line(text: Exception | str) -> str:
    """Return a text, or what an error says, for people: one line, not too long."""
    plain = text.reason if isinstance(text, VideoError) else getattr(text, "strerror", None) or str(text)
    if isinstance(text, Exception) and not isinstance(text, OSError | VideoError | ValueError):
        plain = f"reading it failed ({type(text).__name__}: {plain})"
    return printable(plain.replace("\n", " "))[:_LONGEST_REASON]

"""The catalogue: which videos a corpus has, under stable names, and what each of them holds.

Opening it lists the files of the source, and brings the index up to date: what is new or changed is probed, what is
gone is forgotten.
"""

from __future__ import annotations

import hashlib
import os
import sqlite3
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import groupby
from pathlib import Path

import numpy as np
import numpy.typing as npt

from v2v_protocol.errors import CorpusError, IndexUnreadable, UsageError, VideoChanged, undo_on_error
from v2v_protocol.messages import Lease
from v2v_protocol.sample import ARRAYS, Refusal, RefusalKind, sidecar_endings
from v2v_protocol.spec import StreamSpec
from v2v_server.corpus.index import SCHEMA_VERSION, FigureKind, Shard, Store
from v2v_server.corpus.members import list_members
from v2v_server.corpus.probe import (
    SceneCollection,
    VideoProgress,
    batches,
    collect_sidecars,
    files_for_lease,
    probe_files,
    sidecar_kind,
)
from v2v_server.corpus.scenes.scene import Scene, frames_before
from v2v_server.corpus.sources.listing import (
    ListEntry,
    Notice,
    by_parts,
    format_problems,
    is_said,
    left_out_note,
    silent,
)
from v2v_server.corpus.sources.prepared import ABSENT, Header, Manifest, manifest_of, rows_of
from v2v_server.corpus.sources.sidecars import sidecar_id
from v2v_server.corpus.sources.source import (
    COPIES_GIB,
    GONE,
    FileState,
    SourceOptions,
    VideoSource,
    open_source,
    unmarked,
)
from v2v_server.corpus.videos import (
    NO_THRESHOLDS,
    CorpusFacts,
    IndexRow,
    Sidecars,
    Thresholds,
    VideoEntry,
    Videos,
    VideoTable,
    joined,
    missing_arrays,
)
from v2v_server.kinds.kind import VideosKind
from v2v_server.kinds.registry import VIDEOS, kind_of
from v2v_server.store.format import PIECE_FRAMES
from v2v_server.store.store_file import STORE_FORMAT
from v2v_server.system.log import gauge, text
from v2v_server.system.process import cache_folder, without_collections
from v2v_server.video.fingerprint import CHANGED
from v2v_server.video.frame_index import FrameIndex, unseekable
from v2v_server.video.rows import Rows

_NO_FILE = "its file is missing or changed"
_KEPT_SLICES = 64
_KEPT_LONG_FRAMES = 1 << 22
"""Frames of the opened indexes that are kept, 32 MiB: two days at 25 a second; one index at least."""
_SMALL_INDEX_BYTES, _SMALL_INDEX_FRAMES = 4096, 4096
"""Up to here an index goes into a lease as it is stored: to open it, cut it and pack it again would be a quarter of all
that a server does for a sample. A thousand frames at a constant rate are 100 bytes, at a varying one 2 kB. To open it
takes a worker 1 ms at most."""


@dataclass(frozen=True)
class Corpus:
    """A listed source.

    Attributes:
        source: where the videos come from.
        rows: which rows of the pictures may be used.
        ids: of the files that may be videos, and of archives that may hold some.
        refused: files, folders and lines of the list that give no video, by id, with reasons.
        left_out: reports files of other endings; "" if there are none.
    """

    source: VideoSource
    rows: Rows
    ids: tuple[str, ...]
    refused: dict[str, str]
    left_out: str = ""


def list_corpus(source: VideoSource, rows: Rows | None, notice: Notice) -> Corpus:
    """List the files of a source.

    Args:
        source: where the videos come from.
        rows, notice: as in :func:`v2v_server.corpus.catalogue.open_catalogue`.

    Raises:
        CorpusError: the source cannot be listed, makes no sense, or has no video; or its folder of copies cannot be
            written to.
    """
    if source.copies is not None:
        source.copies.make()
    rows = rows_of(source, rows)
    source.rates = {entry.id: entry.rate for entry in source.listed() or () if entry.rate is not None}
    refused: dict[str, str] = {}
    left_out = Counter[str]()
    ids = list[str]()
    for id in source.videos(refused, left_out):
        if [id] != ids[-1:]:  # a folder of pictures may be named by each
            ids.append(id)
        if is_said(len(ids)):
            notice(f"looking for videos in {source}: {len(ids)} so far")
    note = left_out_note(left_out, has_videos=bool(ids))
    if not ids:
        raise _no_video(source, refused, note)
    return Corpus(source, rows, tuple(ids), refused, note)


def _no_video(source: VideoSource, refused: Mapping[str, str], note: str = "") -> CorpusError:
    looked_for, problems = source.kind.looked_for, format_problems(refused)
    return CorpusError(f"{source}: no video found; looked for {looked_for}{problems}{note and '. '}{note}")


def index_path(
    name: str | os.PathLike[str], cache_dir: str | os.PathLike[str] | None, shard: Shard | None = None
) -> Path:
    """Return the path of the index file of a corpus, or of a shard of it.

    Args:
        name: of its source.
        cache_dir: as in :func:`v2v_server.corpus.catalogue.open_catalogue`.

    Raises:
        CorpusError: none was chosen, and this user has no home folder.
    """
    digest = hashlib.sha256(os.fsencode(name)).hexdigest()[:16]
    of = "" if shard is None else f"-{shard.number}-of-{shard.count}"
    return cache_folder(cache_dir) / f"catalogue-{digest}{of}.sqlite3"


def refresh_index(
    source: VideoSource,
    ids: Sequence[str],
    path: Path,
    scenes: SceneCollection | None,
    processes: int,
    progress: VideoProgress,
    notice: Notice,
    refused: dict[str, str],
) -> tuple[Store, VideoTable, list[str]]:
    """Return an open index that knows every id, its table, and notes for the user.

    The index is in memory, with a note, where the file cannot be used.

    Args:
        source: where the videos come from.
        ids: of the videos to know, and of archives of them.
        path: of the index.
        scenes: how to analyse what the videos show; None does not.
        processes, progress, notice: as in :func:`v2v_server.corpus.catalogue.open_catalogue`.
        refused: receives, by id, why an archive or a member is refused.

    """
    ids = [id for id, _ in groupby(sorted(ids))]  # a list may name a video twice
    try:
        store, table = _refreshed(path, source, ids, scenes, processes, progress, notice, refused)
    except (sqlite3.Error, OSError, UnicodeDecodeError) as error:
        note = (
            f"the catalogue's index {path} cannot be used ({error}); this start keeps it in memory, and the next one "
            "probes every video again. Make room or give write access, delete the file if it is damaged, or choose "
            "another place with V2V_CACHE_DIR"
        )
        if "locked" in str(error):  # the outcome of a wait that was said
            notice(f"the catalogue's index {path} cannot be used ({error}): probing every video again", is_urgent=True)
        return *_refreshed(None, source, ids, scenes, processes, progress, notice, refused), [note]
    if store.replaced_version is None:
        return store, table, []
    note = (
        f"the catalogue's index {path} was written by another release (version {store.replaced_version}, this one has "
        f"{SCHEMA_VERSION}): every video was probed again"
    )
    return store, table, [note]


def _refreshed(
    path: Path | None,
    source: VideoSource,
    ids: list[str],
    scenes: SceneCollection | None,
    processes: int,
    progress: VideoProgress,
    notice: Notice,
    refused: dict[str, str],
) -> tuple[Store, VideoTable]:
    store = Store(path, notice)
    with undo_on_error(store.close):
        ids = sorted(list_members(source, store, ids, processes, notice, refused))
        kind = None if scenes is None else scenes.kind
        if kind is not None:
            store.make_figures()
        with without_collections():
            unasked = list[str]()
            table, states = VideoTable.read(joined(ids, store.rows(kind), unasked), len(ids))
            states[table.codec == "v2v store"] = GONE  # earlier releases named store files by their own bytes
            stale = _changed(source, ids, states, notice)
        del states
        store.forget(_gone(source, unasked, notice))
        with closing(probe_files(source, [ids[at] for at in stale], processes)) as found:
            for batch in batches(found, len(stale), progress):
                store.put(batch)
        if stale:
            table = _table(store, ids, kind)
        if scenes is not None and scenes.collect(store, source, table, processes, progress, notice):
            table = _table(store, ids, kind)
        return store, table


def _table(store: Store, ids: list[str], kind: FigureKind | None) -> VideoTable:
    with without_collections():
        table, _ = VideoTable.read(joined(ids, store.rows(kind), []), len(ids))
    return table


def _changed(source: VideoSource, ids: list[str], states: npt.NDArray[np.int64], notice: Notice) -> list[int]:
    """Ask for size and times of every file; return the places of those that differ from the known [N, 3] states."""
    changed, done = list[int](), 0
    for part, answer in by_parts(source.states, ids):
        found, known = np.asarray(answer).reshape(-1, 3), states[done : done + len(part)]
        changed += (np.flatnonzero((found != known).any(1) | (found[:, 0] < 0)) + done).tolist()
        done += len(part)
        notice(f"looking at files in {source}: {done} of {len(ids)}, {len(changed)} of them new or changed")
    return changed


def _gone(source: VideoSource, ids: Sequence[str], notice: Notice) -> list[str]:
    """Return the ids whose file does not exist any more. One that cannot be asked about today is not gone."""
    gone, done = list[str](), 0
    for part, states in by_parts(source.states, ids):
        done += len(part)
        gone += [id for id, size in zip(part, states[::3], strict=True) if size == GONE[0]]
        notice(f"looking for files that are gone from {source}: {done} of {len(ids)} that are not listed")
    return gone


@dataclass(frozen=True, slots=True)
class CorpusPart:
    """The corpus in the status."""

    videos: str = text("Where the videos are.")
    video_count: int = gauge("Videos of the catalogue.", "videos")
    unusable_count: int = gauge("Files that cannot be used.", "unusable_videos")


@dataclass(frozen=True)
class Catalogue:
    """A snapshot of a corpus. Make one with :func:`open_catalogue`; close it when done.

    Attributes:
        source: where the videos come from.
        rows: which rows of the pictures may be used.
        videos: the videos that can be used, by id.
        refusals: files, folders and lines of the list that give no video, by id.
        notes: what the user ought to be told of opening it, such as an index that cannot be kept. What is wrong with
            the videos is worded in :mod:`v2v_server.corpus_words`.
        digest: 32 hexadecimal digits that name this snapshot: equal digests, equal videos.
        prepared: how the folder was made if it is a prepared one (see :mod:`v2v_server.prepare`). Its videos
            are those of its source in number, order, id and frames, so that every position means the same frames;
            one without a sound prepared file is refused when it is opened, like a damaged one.
        scene_digest: names this snapshot together with the statistics of its videos; None without them.
        sidecars: the files beside the videos that arrays can be made from, by ending.
        lacking: why videos of a prepared folder have no file, by id.
        shorter: how videos are shorter than a list states.
        crashing: ids of the videos that crash the decoder that analyses scenes.
        left_out: reports files of other endings; "" if there are none.
    """

    source: VideoSource
    rows: Rows
    videos: Videos
    refusals: tuple[Refusal, ...]
    notes: tuple[str, ...]
    digest: str
    prepared: Header | None
    scene_digest: str | None
    sidecars: Mapping[str, Sidecars]
    lacking: Mapping[str, str]
    shorter: Sequence[str]
    crashing: Sequence[str]
    left_out: str
    _store: Store = field(repr=False, compare=False)
    _scenes: SceneCollection | None = field(repr=False, compare=False)
    _unknown: frozenset[str] = field(repr=False, compare=False)
    _slices: dict[tuple[str, int, int], bytes] = field(repr=False, compare=False, default_factory=dict)
    _long: dict[str, FrameIndex] = field(repr=False, compare=False, default_factory=dict)

    @property
    def folder(self) -> Path:
        """Return the folder that ids are relative to.

        Raises:
            CorpusError: there is no such folder on this host.
        """
        if self.source.folder is None:
            raise CorpusError(f"{self.source}: not a folder of this host; copy the videos to one first")
        return self.source.folder

    def path(self, id: str) -> Path:
        """Return where the video lies; of a member of an archive, what a FileRange is as a path.

        Raises:
            CorpusError: there is no such id in this catalogue, or no such folder on this host.
        """
        self._expect(id)
        self.folder  # noqa: B018 - raises where there is none
        with self.source.open_local(id, "") as path:
            return Path(os.fspath(path))

    @contextmanager
    def lend(self, video: VideoEntry) -> Iterator[Path]:
        """Lend the file of a video, or its copy on this host, until the end of the context.

        Raises:
            VideoUnreadable, VideoChanged: see :meth:`VideoSource.open_local`.
        """
        self._expect(video.id)
        with self.source.open_local(video.id, video.fingerprint) as path:
            yield Path(os.fspath(path))

    def check(self, id: str, fingerprint: str, sidecar: str = "") -> None:
        """Check that the video is as catalogued, or its sidecar of that ending, see :meth:`VideoSource.verify`.

        Raises:
            CorpusError: there is no such id in this catalogue.
            VideoError: the video is gone, another one by now, or (on a disk) cannot be read.
        """
        kept = self.state(id)
        state: FileState | str | None = self.sidecars[sidecar].states.get(id) if sidecar else None
        self.source.verify(sidecar_id(id, sidecar) if sidecar else id, fingerprint, state or kept)

    def check_state(self, id: str) -> None:
        """Check the size and times of a file on this host, after a worker has read another content.

        Raises:
            VideoChanged, VideoUnreadable: they are not the catalogued ones, or cannot be told.
        """
        known = self._expect(id)
        if self.source.is_local and self.source.state(id) != known:
            raise VideoChanged(id, None, CHANGED)

    def _expect(self, id: str) -> FileState | None:
        """Tell the source in which state a video was catalogued, and return the state."""
        state = self.state(id)
        self.source.expected = id, unmarked(self.source, id, state) if state else ()
        return state

    def state(self, id: str) -> FileState | None:
        """Return the state in which a video was catalogued; None if the index cannot tell.

        Raises:
            CorpusError: there is no such id in this catalogue.
        """
        fingerprint = self._fingerprint(id)
        with suppress(sqlite3.Error):
            return self._store.state(id, fingerprint)
        return None

    def frame_index(self, id: str) -> FrameIndex:
        """Read the frames of a video from the index on disk.

        Raises:
            CorpusError: no such id in this catalogue.
            IndexUnreadable: another process holds the index, or its storage fails.
            VideoChanged: another process has catalogued a changed file under this id since.
            ProtocolError: what the index says of this video is damaged.
        """
        return FrameIndex.from_bytes(self._stored_index(id))

    def frame_index_bytes(self, id: str, start: int, count: int) -> bytes:
        """Return, encoded, at least the part of :meth:`frame_index` that frames start .. start + count - 1 need.

        The part covers the pieces of the cache that these frames lie in. A small index is returned whole and undecoded:
        its reader checks whether it is damaged. The latest parts are kept, because siblings ask for the same one.

        Raises:
            CorpusError, IndexUnreadable, VideoChanged, ProtocolError, UsageError: see :meth:`frame_index` and
                :meth:`FrameIndex.slice`.
        """
        key = id, start, count
        if key not in self._slices:
            index = self._long.get(id)
            encoded = b"" if index is not None else self._stored_index(id)
            is_small = len(encoded) <= _SMALL_INDEX_BYTES and self.videos.shape(id)[0] <= _SMALL_INDEX_FRAMES
            if index is None and not is_small:
                index = self._keep_long(id, FrameIndex.from_bytes(encoded))
            if index is not None:
                index.position(start, count)
                first = start // PIECE_FRAMES * PIECE_FRAMES
                end = min(-(-(start + count) // PIECE_FRAMES) * PIECE_FRAMES, index.end)
                encoded = index.slice(first, end - first).to_bytes()
            while len(self._slices) >= _KEPT_SLICES:
                del self._slices[next(iter(self._slices))]
            self._slices[key] = encoded
        return self._slices[key]

    def _keep_long(self, id: str, index: FrameIndex) -> FrameIndex:
        """Keep a few large indexes decoded: decoding that of a day-long video blocks the loop for 0.1 s."""
        while self._long and len(index) + sum(map(len, self._long.values())) > _KEPT_LONG_FRAMES:
            del self._long[next(iter(self._long))]
        self._long[id] = index
        return index

    def _stored_index(self, id: str) -> bytes:
        if id in self.lacking:
            frames, height_px, width_px = self.videos.shape(id)
            return unseekable(frames, (1, 1), height_px, width_px).to_bytes()
        return self._stored(id, partial(self._store.frame_index, id))

    def _read(self, id: str, read: Callable[[str], bytes | None]) -> bytes | None:
        """Return what the index has for the fingerprint of the file that was catalogued; None: nothing."""
        try:
            return read(self._fingerprint(id))
        except sqlite3.Error as error:
            raise IndexUnreadable(f"the catalogue's index cannot be read: {error}") from error

    def _stored(self, id: str, read: Callable[[str], bytes | None]) -> bytes:
        if (data := self._read(id, read)) is None:
            reason = "has changed since this catalogue was opened; start again to serve it as it is now"
            raise VideoChanged(id, None, reason)
        return data

    def scene(self, id: str) -> Scene:
        """Read the statistics of a video from the index on disk.

        Raises:
            CorpusError: no such id in this catalogue, or it was opened without ``scene``.
            IndexUnreadable: another process holds the index, or its storage fails.
            VideoChanged: another process has catalogued a changed file under this id since.
        """
        self._fingerprint(id)
        if self._scenes is None:
            raise CorpusError("this catalogue was opened without statistics of its videos")
        if id in self._unknown:
            return Scene.unknown()
        return Scene.from_bytes(self._stored(id, partial(self._store.figures, id, kind=self._scenes.kind)))

    def sidecar_files(self, id: str, ending: str, fingerprint: str, start: int, count: int) -> bytes | str:
        """Return the table of a folder's files in ``lease.sidecars``; or why the sidecar cannot be used.

        Raises:
            CorpusError, IndexUnreadable: see :meth:`frame_index`.
        """
        data = self._read(id, partial(self._store.figures, id, kind=sidecar_kind(ending)))
        return files_for_lease(data, fingerprint, start, count)

    @property
    def facts(self) -> CorpusFacts:
        """What is known in memory: all that a server's dispatcher needs."""
        ids = self.videos.ids if not self.lacking else [id for id in self.videos.ids if id not in self.lacking]
        missing = {**self.kind.cannot()} | ({} if self.prepared is None else missing_arrays(self.source, ids))
        return CorpusFacts(self.videos, self.rows, self.digest, self.scene_digest, self.sidecars, missing)

    @property
    def kind(self) -> VideosKind:
        """Return what its videos are, with all flags at their defaults; prepared ones are what their sources were."""
        return kind_of(self.videos.ids[0])

    def part(self) -> CorpusPart:
        """Return what the status says of it."""
        return CorpusPart(str(self.source), len(self.videos), len(self.refusals))

    def fail_fast(self) -> None:
        """Report a locked index at once instead of waiting 30 s, because a server's loop must not block."""
        self._store.fail_fast()

    def mark_stale(self, id: str) -> None:
        """Probe a video again at the next start, although its size and times are those of the index.

        Does nothing where the index cannot be written now.
        """
        with suppress(sqlite3.Error):
            self._store.mark_stale(id)

    def close(self) -> None:
        """Close the index; ``frame_index`` and ``scene`` fail afterwards."""
        self._store.close()
        if self.source.copies is not None:
            self.source.copies.release()

    def _fingerprint(self, id: str) -> str:
        number = self.videos.find(id)
        if number is None:
            raise CorpusError(f"{id!r} is not in this catalogue ({len(self.videos)} videos below {self.source})")
        return self.videos.fingerprints[number]


def complete_lease(lease: Lease, catalogue: Catalogue, spec: StreamSpec) -> Lease:
    """Return a lease with what the index on disk holds of its clip.

    Args:
        lease: without ``frame_index`` and ``scene``.
        catalogue: where its video is catalogued.
        spec: the spec that the lease names.

    Raises:
        IndexUnreadable: the index cannot be read at the moment.
        V2VError: the index of this video is damaged, or belongs to another file.
    """
    video, start, recipe, part = lease.video, lease.start_frame, spec.recipe, b""
    run_in, scene, has_repeats = int(recipe.run_in_at(lease.frames_per_second)), None, "duplicates" in spec.kept_defects
    if spec.scene == "off":
        count = int(recipe.reach_at(lease.frames_per_second)) + 1
        if recipe.is_timed and (number := catalogue.videos.find(video)) is not None:
            count = min(count, int(catalogue.videos.frames[number]) - start)
    else:
        scene, count = catalogue.scene(video), int(recipe.sequence_at(lease.frames_per_second)) + 1
        if not has_repeats:
            count = int(scene.frames_from(start, count)[-1]) + 1 - start
    first = min((start, *frames_before(scene, start, run_in, has_repeats=has_repeats).tolist()))
    if scene is not None:
        known = 0 if run_in and first == start else first  # its worker sees that the shot has too few
        part = scene.slice(known, start + count - known).to_bytes()
    sidecars = dict(lease.sidecars)
    for ending in sidecar_endings(lease.arrays):
        mark = lease.sidecars.get(ending, "")
        if problem := catalogue.sidecars[ending].problems.get(video):
            sidecars[ending] = [mark, problem]
        elif mark and ending.endswith("/"):
            sidecars[ending] = [mark, catalogue.sidecar_files(video, ending, mark, start, count)]
    frames = catalogue.frame_index_bytes(video, first, start + count - first)
    state = catalogue.state(video)
    # A message has no number below 0, such as a time before 1970.
    known = unmarked(catalogue.source, video, state) if state is not None and min(state) >= 0 else ()
    notes = replace(lease.notes, state=known)
    return replace(lease, frame_index=frames, scene=part, sidecars=sidecars, notes=notes)


def open_catalogue(
    source: str | os.PathLike[str],
    *,
    list_file: str | os.PathLike[str] | None = None,
    rows: Rows | None = None,
    cache_dir: str | os.PathLike[str] | None = None,
    copies: str | os.PathLike[str] | None = None,
    copies_gib: float = COPIES_GIB,
    kind: VideosKind = VIDEOS,
    scene: bool = False,
    processes: int = 1,
    progress: VideoProgress = silent,
    notice: Notice = silent,
) -> Catalogue:
    """Open a corpus: probe what is new or changed, forget what is gone.

    Args:
        source: a folder (searched to all depths), one video, a list file whose paths are relative to its folder, or an
            address in object storage (``s3://bucket/prefix``).
        list_file: a list that restricts the folder ``source`` to the videos it names.
        rows: which rows may be used; all when None.
        cache_dir: where the index lies; None takes ``$V2V_CACHE_DIR``, else ``$XDG_CACHE_HOME/v2v``, else
            ``~/.cache/v2v``.
        copies: folder for copies of videos from object storage; None takes one where the index lies.
        copies_gib: largest size of that folder, GiB.
        kind: what a video is.
        scene: also analyse what the videos show, which decodes those not analysed yet; see
            :mod:`v2v_server.corpus.scenes`.
        processes: number of processes that probe; 0 probes in this one, which a file that crashes the decoder ends.
        progress: called after each probed file; starts again where the index turns out to be unusable.
        notice: called with a line of text as the search for files advances.

    Raises:
        CorpusError: the folder or list is missing, unreadable or malformed, or has no usable video.
        IndexUnreadable: the index cannot be read any more after the probes.
        UsageError: ``scene``, and the videos are of a kind without scenes.
    """
    if scene and not kind.has_scenes:
        raise UsageError(f"--scene auto leaves out defects of videos, which {kind.name} do not have: set it to off")
    opened = open_source(source, SourceOptions(list_file, copies, copies_gib, cache_dir, kind))
    corpus = list_corpus(opened, rows, notice)
    scenes = SceneCollection(corpus.rows) if scene else None
    path = index_path(opened.name, cache_dir)
    store, table, notes = refresh_index(opened, corpus.ids, path, scenes, processes, progress, notice, corpus.refused)
    try:
        with without_collections():
            catalogue = _snapshot(corpus, table, notes, store, scenes, processes, notice)
        opened.members, opened.tables = {}, {}  # from now on the index has their states
        return catalogue
    except BaseException as error:
        store.close()
        if isinstance(error, sqlite3.Error):
            raise IndexUnreadable(f"the catalogue's index {path} cannot be read: {error}; start again") from error
        raise


def _snapshot(
    corpus: Corpus,
    on_disk: VideoTable,
    notes: list[str],
    store: Store,
    scenes: SceneCollection | None,
    processes: int,
    notice: Notice,
) -> Catalogue:
    source, manifest, table = corpus.source, manifest_of(corpus.source), on_disk
    problems, absent = dict(corpus.refused), frozenset[str]()
    if manifest is not None:
        rows = ((*_as_source(manifest, on_disk.row(at)).columns, None) for at in range(len(on_disk)))
        table = replace(VideoTable.read(rows, len(on_disk))[0], summaries=on_disk.summaries)
        absent = frozenset(table.ids[at] for at in np.flatnonzero(table.codec == ABSENT).tolist())
    else:
        table.problem[table.codec == STORE_FORMAT] = "is one file of a lossless corpus: serve the whole folder"
    usable = table.problem == np.array(None)
    problems.update((table.ids[at], table.problem[at]) for at in np.flatnonzero(~usable).tolist())
    table = table.where(usable)
    thresholds, shorter = _listed(source.listed() or (), Videos(table, {}))
    videos = Videos(table, thresholds)
    if not videos and not len(on_disk):
        raise _no_video(source, problems, corpus.left_out)
    if not videos:
        raise CorpusError(f"{source}: none of {len(problems)} videos can be used{format_problems(problems)}")
    lacking = {} if manifest is None else {id: manifest.videos[id].problem or _NO_FILE for id in sorted(absent)}
    if lacking and len(lacking) == len(videos):
        raise CorpusError(f"{source}: none of {len(absent)} prepared files is there as its manifest says")
    digest = videos.digest(corpus.rows)
    scene_digest, unknown = None, set(absent)
    if scenes is not None:
        split, scene_digest = scenes.read(store, table, unknown, digest)
        videos = Videos(table, thresholds, split)
    marks = dict(zip(videos.ids, videos.fingerprints, strict=True)) if source.kind.has_sidecars else {}
    endings = sidecar_endings(tuple(ARRAYS))
    sidecars, said = collect_sidecars(source, store, marks, videos.shape, endings, processes, notice)
    notes = [*notes, *said]
    return Catalogue(
        source=source,
        rows=corpus.rows,
        videos=videos,
        refusals=tuple(Refusal(id, None, problems[id], RefusalKind.UNUSABLE) for id in sorted(problems)),
        notes=tuple(notes),
        digest=digest,
        prepared=None if manifest is None else manifest.header,
        scene_digest=scene_digest,
        sidecars=sidecars,
        lacking=lacking,
        shorter=shorter,
        crashing=sorted(unknown - absent),
        left_out=corpus.left_out,
        _store=store,
        _scenes=scenes,
        _unknown=frozenset(unknown),
    )


def _as_source(manifest: Manifest, record: IndexRow) -> IndexRow:
    """Return the record of a prepared file with the facts that have to agree with its source.

    This includes videos without a usable file, whose codec is ABSENT: the sequences of the others keep their places
    only if the source's frames are counted. A usable file may be damaged: each of its blocks is checked when it is
    read. The source itself will do in its place.
    """
    video = manifest.videos[record.id]
    is_there = record.problem is None and record.fingerprint == video.source_fingerprint
    return replace(
        record,
        fingerprint=video.source_fingerprint,
        frames=video.frames,
        height_px=video.height_px,
        width_px=video.width_px,
        frames_per_second=video.frames_per_second,
        codec=record.codec if is_there else ABSENT,
        remark=video.remark,
        problem=None,
    )


def _listed(listed: Sequence[ListEntry], videos: Videos) -> tuple[dict[int, Thresholds], list[str]]:
    """Return what a list states: thresholds by number of the video, and the videos that are shorter than it says."""
    thresholds: dict[int, Thresholds] = {}
    shorter = []
    for entry in sorted({entry.id: entry for entry in listed}.values(), key=lambda entry: entry.id):
        number = videos.find(entry.id)
        if number is None:
            continue
        if (stated := (entry.threshold_pos, entry.threshold_neg)) != NO_THRESHOLDS:
            thresholds[number] = stated
        frames = int(videos.frames[number])
        if entry.frames is not None and entry.frames > frames:
            shorter.append(f"{entry.id} has {frames} frames, not {entry.frames}")
    return thresholds, shorter

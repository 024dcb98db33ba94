"""The statistics of all videos of a corpus: from the index, from a prepared folder's manifest, or from an analysis.

An analysis decodes the beginning of a video once, in a process of its own. The index keeps the result for the file's
fingerprint and the rows that were analysed, and the pieces once more as a summary: a start reads only these.
"""

from __future__ import annotations

import hashlib
import sqlite3
from base64 import b64decode
from collections.abc import Generator, Iterator, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import xxhash

from v2v_protocol.errors import UsageError, VideoError, VideoUnreadable
from v2v_protocol.persisted import Persisted
from v2v_server.corpus.index import FigureKind, Figures, IndexRow, Store
from v2v_server.corpus.manifest import Manifest
from v2v_server.corpus.probe import LARGEST_PROBE_BYTES, LONGEST_SECONDS, VideoProgress, batches
from v2v_server.corpus.scenes.scene import ANALYSIS_VERSION, MOST_ANALYSED_FRAMES, PIECE, Scene
from v2v_server.corpus.sources.source import Notice, VideoSource
from v2v_server.corpus.videos import SplitVideos, VideoTable, encoded_pieces, joined
from v2v_server.system.compile_cache import compile_cache
from v2v_server.system.isolate import run_twice
from v2v_server.video.collect import ClipRequest, Cut
from v2v_server.video.frame_index import FrameIndex
from v2v_server.video.orientation import PixelRect
from v2v_server.video.rows import Rows

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
        progress: VideoProgress | None,
        notice: Notice | None,
    ) -> bool:
        """Analyse each usable video without a scene in the index, and store the scene unless the analysis fails.

        Returns:
            whether there were such videos.

        Raises:
            sqlite3.Error: the index cannot be written.
        """
        missing = np.flatnonzero((table.summaries.lengths == 0) & (table.problem == np.array(None))).tolist()
        if missing and notice is not None and store.has_other_versions(self.kind.name, _ENDING):
            notice(f"analysing {len(missing)} videos again: this release finds more in pictures than earlier ones")
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
    ) -> Generator[tuple[IndexRow | _Job, Scene], None, None]:
        left = []
        for place in missing:
            record = table.row(place)
            if (data := self._stated(source.manifest, record)) is None:
                left.append(place)
            else:
                yield record, Scene.from_bytes(data)

        def jobs() -> Iterator[_Job]:
            for record in map(table.row, left):
                index = store.frame_index(record.id, record.fingerprint) or b""
                yield _Job(record.id, record.fingerprint, record.frames, index, self._window(record))

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


def figures(video: IndexRow | _Job, scene: Scene) -> Figures:
    """Return what the index keeps of a scene; the summary is a hash of it and the encoded pieces."""
    data = scene.to_bytes()
    summary = xxhash.xxh3_64_digest(data) + encoded_pieces(scene.pieces, video.frames)
    return Figures(video.id, video.fingerprint, summary, data)


@dataclass(frozen=True, slots=True)
class _Job(Persisted):
    id: str
    fingerprint: str
    frames: int
    index: bytes
    window: PixelRect | None


def _analyse(source: VideoSource, job: _Job) -> Scene | None:
    """Return the scene of one video, from what decodes before the first error.

    It is None where the system, not the decoder, reports an error.
    """
    # Import lazily: processes that only open a catalogue need no OpenCV.
    from v2v_server.corpus.scenes.analysis import SceneAnalysis

    analysis = SceneAnalysis()
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

"""The statistics of every video of a corpus: from the index on disk, from a prepared folder's manifest, or from a look.

A look decodes the beginning of a video once, in a process of its own, and its result is kept under the file's
fingerprint and the rows it was taken of.
"""

from __future__ import annotations

import hashlib
from base64 import b64decode
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import closing, suppress
from dataclasses import dataclass
from functools import partial
from itertools import islice

from v2v_protocol.errors import UsageError, VideoError, VideoUnreadable
from v2v_server.corpus.index.columns import Records
from v2v_server.corpus.index.copy import NoCopy, copied, read_copy
from v2v_server.corpus.index.file import IndexRow, Store
from v2v_server.corpus.index.runs import CutVideos, Runs
from v2v_server.corpus.manifest import Manifest
from v2v_server.corpus.scene import LOOK_VERSION, MOST_FRAMES, Scene
from v2v_server.corpus.sources.source import VideoSource
from v2v_server.corpus.survey import LARGEST_MEMORY_BYTES, LONGEST_SECONDS
from v2v_server.store.clips import pictures_of
from v2v_server.system.compile_cache import compile_cache
from v2v_server.system.isolate import Died, run_isolated
from v2v_server.video.frame_index import FrameIndex
from v2v_server.video.orientation import Window
from v2v_server.video.rows import Rows

_WRITE_EVERY = 64


@dataclass(frozen=True, slots=True)
class Looking:
    """Which part of the pictures is looked at.

    Attributes:
        rows: of the corpus; all of a prepared one.
        manifest: of a prepared folder, whose statistics are those of its source's frames where it has them.
    """

    rows: Rows
    manifest: Manifest | None

    @property
    def key(self) -> str:
        """Tells looks of one file apart."""
        is_source = self.manifest is None or self.manifest.lossless
        made = "" if self.manifest is None or is_source else f"prepared {self.manifest.header.rows}, "
        return f"{made}{self.rows}, look {LOOK_VERSION}"

    def take_in(
        self,
        store: Store,
        source: VideoSource,
        records: Records,
        processes: int,
        progress: Callable[[int, int], None] | None,
    ) -> None:
        """Makes sure that the index has a look at each sound record, if it can be had.

        Raises:
            sqlite3.Error: the index cannot be written.
        """
        places = (records.ids.find(id) for id in store.not_looked_at(self.key))
        missing = [records[place] for place in places if place is not None]
        total = len(missing)
        batch: list[tuple[str, str, str, bytes]] = []
        with closing(self._found(store, source, missing, processes)) as found:
            for done, (record, scene) in enumerate(found, 1):
                batch.append((record.id, record.fingerprint, self.key, scene.to_bytes()))
                if progress is not None:
                    progress(done, total)
                if len(batch) == _WRITE_EVERY:
                    store.put_scenes(batch)
                    batch = []
        store.put_scenes(batch)

    def cuts(self, store: Store, records: Iterable[IndexRow], unseen: set[str], digest: str) -> tuple[CutVideos, str]:
        """The videos whose one run is not the whole of them, and a digest that names all that is known of them. Of a
        large index the answer is kept, for it takes a minute for a million.

        Args:
            records: of the videos of a snapshot, in its order.
            unseen: ids of videos of which nothing is known; receives those that the index has no look at.
            digest: of the snapshot.
        """
        with store.reading() as mark:
            state = f"{mark} {self.key} {digest}" if mark and not unseen else ""
            with suppress(NoCopy), closing(read_copy(store.path, state, "scenes")) as parts:
                (kept,) = parts
                unseen.update(kept["unseen"])
                return CutVideos.unpacked(kept["cut"]), kept["digest"]
            sha = hashlib.sha256(f"v2v catalogue with scenes 1\n{digest}\n".encode())
            cut = CutVideos.of(self._cut(store, records, unseen, sha.update))
            name = sha.hexdigest()[:32]
            answer = {"cut": cut.packed(), "digest": name, "unseen": sorted(unseen)}
            deque(copied(store.path, state, [answer], "scenes"), maxlen=0)
        return cut, name

    def _cut(
        self, store: Store, records: Iterable[IndexRow], unseen: set[str], sealed: Callable[[bytes], None]
    ) -> Iterator[tuple[int, Runs]]:
        """Number and runs of each that has cuts; ``sealed`` receives what is known of every video."""
        for number, record in enumerate(records):
            data = None if record.id in unseen else store.scene(record.id, record.fingerprint, self.key)
            if data is None:
                unseen.add(record.id)
            scene = Scene.unknown() if data is None else Scene.from_bytes(data)
            sealed(scene.to_bytes())
            if (runs := tuple(scene.runs(record.frames))) != ((0, record.frames),):
                yield number, runs

    def _found(
        self, store: Store, source: VideoSource, missing: list[IndexRow], processes: int
    ) -> Generator[tuple[IndexRow, Scene], None, None]:
        by_id = {record.id: record for record in missing}
        left = []
        for record in missing:
            told = self._told(record)
            if told is not None:
                yield record, told
            else:
                left.append(record)

        def jobs() -> Iterator[_ToLookAt]:
            for record in left:
                index = store.frame_index(record.id, record.fingerprint) or b""
                yield _ToLookAt(record.id, record.fingerprint, index, self._window(record))

        isolated = partial(
            run_isolated,
            partial(_look_at, source),
            deadline_seconds=lambda job: LONGEST_SECONDS,
            memory_bytes=2 * LARGEST_MEMORY_BYTES,
            writable=compile_cache() if source.is_local else None,
        )
        suspects = []
        for job, scene in isolated(jobs(), processes):
            if isinstance(scene, Died) and scene.overdue_seconds:
                continue  # the next start tries again
            if isinstance(scene, Died) or not scene:
                suspects.append(job)
            else:
                yield by_id[job.id], Scene.from_bytes(scene)
        # Once more, alone: it may have been killed from outside, or for want of memory, or its storage failed for a
        # moment. A second failure is not kept: of such a video nothing is known, and the next start tries again.
        for job, scene in isolated(suspects, 1):
            if not isinstance(scene, Died) and scene:
                yield by_id[job.id], Scene.from_bytes(scene)

    def _told(self, record: IndexRow) -> Scene | None:
        """What the manifest says."""
        if self.manifest is None or not self.manifest.videos[record.id].scene or not self.manifest.describes(record):
            return None
        return Scene.from_bytes(b64decode(self.manifest.videos[record.id].scene))

    def _window(self, record: IndexRow) -> Window | None:
        try:
            top, bottom = self.rows.bounds(record.height_px)
        except UsageError:
            return None  # no sequence is made of it either
        return top, 0, bottom - top, record.width_px


@dataclass(frozen=True, slots=True)
class _ToLookAt:
    id: str
    fingerprint: str
    index: bytes
    window: Window | None


def _look_at(source: VideoSource, job: _ToLookAt) -> bytes:
    """The encoded scene of one video: of what decodes before the first error. Empty where the system, rather than the
    decoder, reports an error."""
    # The catalogue is opened by processes that need none of what a look does.
    from v2v_server.corpus.look import Look

    seen = Look()
    if job.index and job.window is not None:
        try:
            with source.open_local(job.id, job.fingerprint) as path:
                pictures = pictures_of(path, FrameIndex.from_bytes(job.index), job.window)
                for picture in islice(pictures, MOST_FRAMES):
                    seen.add(picture)
        except VideoError as error:
            if isinstance(error, VideoUnreadable) or isinstance(error.__cause__, OSError):
                return b""
            return seen.scene().to_bytes()  # whoever is served what lies behind finds the same error
    return seen.scene().to_bytes()

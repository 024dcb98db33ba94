"""The catalogue's index on disk, brought up to date: what is new or changed is probed, what is gone is forgotten."""

from __future__ import annotations

import hashlib
import os
import sqlite3
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import closing, suppress
from itertools import islice, pairwise
from pathlib import Path

from v2v_server.corpus.changed import changed
from v2v_server.corpus.index.columns import CHUNK, Records, merged
from v2v_server.corpus.index.copy import NoCopy, Part, copied, read_copy
from v2v_server.corpus.index.file import SCHEMA_VERSION, IndexRow, Store
from v2v_server.corpus.index.parts import Shard
from v2v_server.corpus.scenes import Looking
from v2v_server.corpus.sources.asking import Notice, by_parts
from v2v_server.corpus.sources.source import GONE, VideoSource
from v2v_server.corpus.survey import survey
from v2v_server.system.process import cache_folder, without_collections

_WRITE_EVERY = 256
_WRITE_SECONDS = 10.0

Progress = Callable[[int, int], None]
"""(files probed so far, files to probe)."""


def index_path(
    name: str | os.PathLike[str], cache_dir: str | os.PathLike[str] | None, shard: Shard | None = None
) -> Path:
    """Return the index file of a source of this name, or of a shard of it; ``cache_dir`` as in
    :func:`v2v_server.corpus.catalogue.open_catalogue`.

    Raises:
        CorpusError: none was chosen, and this user has no home folder.
    """
    digest = hashlib.sha256(os.fsencode(name)).hexdigest()[:16]
    of = "" if shard is None else f"-{shard.number}-of-{shard.count}"
    return cache_folder(cache_dir) / f"catalogue-{digest}{of}.sqlite3"


def up_to_date(
    source: VideoSource,
    ids: Sequence[str],
    path: Path,
    looking: Looking | None,
    processes: int,
    progress: Progress | None,
    notice: Notice | None,
) -> tuple[Store, Records, list[str]]:
    """An open index that knows every id, its records, and notes for the user.

    The index is in memory, with a note, where the file cannot serve.

    Args:
        source: where the videos come from.
        ids: of the videos to know.
        path: of the index.
        looking: how to look at what the videos show; None does not.
        processes, progress, notice: as in :func:`v2v_server.corpus.catalogue.open_catalogue`.
    """
    try:
        store, records = _refreshed(path, source, ids, looking, processes, progress, notice)
    except (sqlite3.Error, OSError, UnicodeDecodeError) as error:
        note = (
            f"the catalogue's index {path} cannot be used ({error}); this start keeps it in memory, and the next one "
            "probes every video again. Make room or give write access, delete the file if it is damaged, or choose "
            "another place with V2V_CACHE_DIR"
        )
        return *_refreshed(None, source, ids, looking, processes, progress, notice), [note]
    if store.replaced_version is None:
        return store, records, []
    note = (
        f"the catalogue's index {path} was written by another release (version {store.replaced_version}, this one has "
        f"{SCHEMA_VERSION}): every video was probed again"
    )
    return store, records, [note]


def _refreshed(
    path: Path | None,
    source: VideoSource,
    ids: Sequence[str],
    looking: Looking | None,
    processes: int,
    progress: Progress | None,
    notice: Notice | None,
) -> tuple[Store, Records]:
    store = Store(path)
    try:
        with without_collections():
            records, unasked, mark = _known(store, ids)
        stale = [records.ids[at] for at in changed(source, records.ids, records.states, processes, notice)]
        del records.states[:]
        store.forget(_gone(source, unasked, notice))
        with closing(survey(source, stale, processes)) as found:
            for batch in _batches(found, len(stale), progress):
                store.put(batch)
                for record in batch:
                    place = records.ids.find(record.id)
                    assert place is not None, record.id
                    records.change(place, record)
        records.fingerprints.settle()
        if looking is not None:
            looking.take_in(store, source, records, processes, progress)
        _copy(store, mark)
        return store, records
    except BaseException:
        store.close()
        raise


def _known(store: Store, ids: Sequence[str]) -> tuple[Records, list[str], str]:
    """What the index has of these ids; other ids that it has; the mark of its state."""
    ids = sorted(ids)
    if any(one == next for one, next in pairwise(ids)):  # a list may name a video twice
        ids = sorted(set(ids))
    with store.reading() as mark:
        unasked = list[str]()
        with suppress(NoCopy), closing(read_copy(store.path, mark)) as parts:
            return merged(ids, parts, unasked), unasked, mark
        unasked = []
        return merged(ids, _parts(store, mark), unasked), unasked, mark


def _parts(store: Store, mark: str) -> Iterator[Part]:
    """All that the index has, of which a copy is left behind."""

    def parts() -> Iterator[Part]:
        with closing(store.rows()) as rows:
            while chunk := list(islice(rows, CHUNK)):
                part = Records()
                part.extend(chunk)
                yield part.packed()

    return copied(store.path, mark, parts())


def _copy(store: Store, mark: str) -> None:
    """Leaves a copy behind of what the index has now, if that is not what it had."""
    with suppress(sqlite3.Error, OSError, UnicodeDecodeError), store.reading() as now:
        if now != mark:
            deque(_parts(store, now), maxlen=0)


def _gone(source: VideoSource, ids: Iterable[str], notice: Notice | None) -> list[str]:
    """Return those of the ids of which there is no file any more. One whose state cannot be told today is not gone."""
    unlisted, gone, done = sorted(ids), list[str](), 0
    with closing(by_parts(source.states, unlisted)) as answered:
        for part, states in answered:
            done += len(part)
            gone += [id for id, size in zip(part, states[::3], strict=True) if size == GONE[0]]
            if notice is not None:
                notice(f"looking for files that are gone: {done} of {len(unlisted)} that this corpus does not name")
    return gone


def _batches(
    records: Iterator[IndexRow], total: int, progress: Progress | None, clock: Callable[[], float] = time.monotonic
) -> Iterator[list[IndexRow]]:
    """What a kill may cost is one of them."""
    batch: list[IndexRow] = []
    begun = clock()
    for done, record in enumerate(records, 1):
        batch.append(record)
        if progress is not None:
            progress(done, total)
        if len(batch) == _WRITE_EVERY or clock() - begun > _WRITE_SECONDS:
            yield batch
            batch, begun = [], clock()
    yield batch

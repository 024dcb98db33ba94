"""List the files of a corpus, and bring its index up to date: probe what is new or changed, forget what is gone."""

from __future__ import annotations

import hashlib
import os
import sqlite3
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path

import numpy as np
import numpy.typing as npt

from v2v_protocol.errors import CorpusError
from v2v_server.corpus.index.columns import VideoTable, joined
from v2v_server.corpus.index.file import SCHEMA_VERSION, FigureKind, Shard, Store
from v2v_server.corpus.probe import Progress, batches, probe_files
from v2v_server.corpus.scenes.collect import SceneCollection
from v2v_server.corpus.sources.asking import Notice, by_parts, is_said
from v2v_server.corpus.sources.names import VIDEO_SUFFIXES, left_out_note
from v2v_server.corpus.sources.source import GONE, VideoSource
from v2v_server.system.process import cache_folder, without_collections
from v2v_server.video.rows import Rows


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
    progress: Progress | None,
    notice: Notice | None,
) -> tuple[Store, VideoTable, list[str]]:
    """Return an open index that knows every id, its table, and notes for the user.

    The index is in memory, with a note, where the file cannot be used.

    Args:
        source: where the videos come from.
        ids: of the videos to know.
        path: of the index.
        scenes: how to analyse what the videos show; None does not.
        processes, progress, notice: as in :func:`v2v_server.corpus.catalogue.open_catalogue`.
    """
    ids = [id for id, _ in groupby(sorted(ids))]  # a list may name a video twice
    try:
        store, table = _refreshed(path, source, ids, scenes, processes, progress, notice)
    except (sqlite3.Error, OSError, UnicodeDecodeError) as error:
        note = (
            f"the catalogue's index {path} cannot be used ({error}); this start keeps it in memory, and the next one "
            "probes every video again. Make room or give write access, delete the file if it is damaged, or choose "
            "another place with V2V_CACHE_DIR"
        )
        if notice is not None and "locked" in str(error):  # the outcome of a wait that was said
            notice(f"the catalogue's index {path} cannot be used ({error}): probing every video again", is_urgent=True)
        return *_refreshed(None, source, ids, scenes, processes, progress, notice), [note]
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
    progress: Progress | None,
    notice: Notice | None,
) -> tuple[Store, VideoTable]:
    store = Store(path, notice)
    try:
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
    except BaseException:
        store.close()
        raise


def _table(store: Store, ids: list[str], kind: FigureKind | None) -> VideoTable:
    with without_collections():
        table, _ = VideoTable.read(joined(ids, store.rows(kind), []), len(ids))
    return table


def _changed(source: VideoSource, ids: list[str], states: npt.NDArray[np.int64], notice: Notice | None) -> list[int]:
    """Ask for size and times of every file; return the places of those that differ from the known [N, 3] states."""
    changed, done = list[int](), 0
    for part, answer in by_parts(source.states, ids):
        found, known = np.asarray(answer).reshape(-1, 3), states[done : done + len(part)]
        changed += (np.flatnonzero((found != known).any(1) | (found[:, 0] < 0)) + done).tolist()
        done += len(part)
        if notice is not None:
            notice(f"looking at files in {source}: {done} of {len(ids)}, {len(changed)} of them new or changed")
    return changed


def _gone(source: VideoSource, ids: Sequence[str], notice: Notice | None) -> list[str]:
    """Return the ids whose file does not exist any more. One that cannot be asked about today is not gone."""
    gone, done = list[str](), 0
    for part, states in by_parts(source.states, ids):
        done += len(part)
        gone += [id for id, size in zip(part, states[::3], strict=True) if size == GONE[0]]
        if notice is not None:
            notice(f"looking for files that are gone from {source}: {done} of {len(ids)} that are not listed")
    return gone


@dataclass(frozen=True)
class Corpus:
    """A listed source.

    Attributes:
        source: where the videos come from.
        rows: which rows of the pictures may be used.
        ids: of the files that may be videos.
        refused: files, folders and lines of the list that give no video, by id, with reasons.
        left_out: reports files of other endings; "" if there are none.
    """

    source: VideoSource
    rows: Rows
    ids: tuple[str, ...]
    refused: Mapping[str, str]
    left_out: str = ""


def list_corpus(source: VideoSource, rows: Rows | None, notice: Notice | None) -> Corpus:
    """List the files of a source.

    Args:
        source: where the videos come from.
        rows, notice: as in :func:`v2v_server.corpus.catalogue.open_catalogue`.

    Raises:
        CorpusError: the source cannot be listed, makes no sense, or has no video; or its folder of copies cannot be
            written to.
    """
    source.make()
    rows = source.rows(rows)
    refused: dict[str, str] = {}
    left_out = Counter[str]()
    ids = []
    for id in source.videos(refused, left_out):
        ids.append(id)
        if notice is not None and is_said(len(ids)):
            notice(f"looking for videos in {source}: {len(ids)} so far")
    note = left_out_note(left_out)
    if not ids:
        raise CorpusError(
            f"{source}: no video found; looked for {' '.join(sorted(VIDEO_SUFFIXES))}"
            f"{format_problems(refused)}{note and '. '}{note}"
        )
    return Corpus(source, rows, tuple(ids), refused, note)


def format_problems(problems: Mapping[str, str]) -> str:
    """Return the first few reasons, for an error message; "" without one."""
    if not problems:
        return ""
    shown = "; ".join(f"{id}: {problems[id]}" for id in sorted(problems)[:3])
    more = f"; and {len(problems) - 3} more" if len(problems) > 3 else ""
    return f" ({shown}{more})"

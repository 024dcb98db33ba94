"""Bring the index of a corpus up to date: probe what is new or changed, forget what is gone."""

from __future__ import annotations

import errno
import hashlib
import os
import sqlite3
import stat
from array import array
from collections.abc import Sequence
from contextlib import closing, suppress
from pathlib import Path

import numpy as np

from v2v_server.cloud.copies import Copies
from v2v_server.corpus.files import Notice, by_parts
from v2v_server.corpus.index.columns import VideoTable, joined
from v2v_server.corpus.index.file import SCHEMA_VERSION, Store
from v2v_server.corpus.index.parts import Shard
from v2v_server.corpus.probe import Progress, batches, probe_files
from v2v_server.corpus.scenes.collect import SceneCollection
from v2v_server.system.process import cache_folder, without_collections


def index_path(
    root: str | os.PathLike[str], cache_dir: str | os.PathLike[str] | None, shard: Shard | None = None
) -> Path:
    """Return the path of the index file of a corpus, or of a shard of it.

    Args:
        cache_dir: as in :func:`v2v_server.corpus.catalogue.open_catalogue`.

    Raises:
        CorpusError: none was chosen, and this user has no home folder.
    """
    name = hashlib.sha256(os.fsencode(root)).hexdigest()[:16]
    of = "" if shard is None else f"-{shard.number}-of-{shard.count}"
    return cache_folder(cache_dir) / f"catalogue-{name}{of}.sqlite3"


def refresh_index(
    root: Path | Copies,
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
        root: the folder, or the objects, that ids are relative to.
        ids: of the videos to know.
        path: of the index.
        scenes: how to analyse what the videos show; None does not.
        processes, progress, notice: as in :func:`v2v_server.corpus.catalogue.open_catalogue`.
    """
    ids = sorted(set(ids))  # a list may name a video twice
    try:
        store, table = _refreshed(path, root, ids, scenes, processes, progress, notice)
    except (sqlite3.Error, OSError, UnicodeDecodeError) as error:
        note = (
            f"the catalogue's index {path} cannot be used ({error}); this start keeps it in memory, and the next one "
            "probes every video again. Make room or give write access, delete the file if it is damaged, or choose "
            "another place with V2V_CACHE_DIR"
        )
        return *_refreshed(None, root, ids, scenes, processes, progress, notice), [note]
    if store.replaced_version is None:
        return store, table, []
    note = (
        f"the catalogue's index {path} was written by another release (version {store.replaced_version}, this one has "
        f"{SCHEMA_VERSION}): every video was probed again"
    )
    return store, table, [note]


def _refreshed(
    path: Path | None,
    root: Path | Copies,
    ids: list[str],
    scenes: SceneCollection | None,
    processes: int,
    progress: Progress | None,
    notice: Notice | None,
) -> tuple[Store, VideoTable]:
    store = Store(path)
    try:
        with without_collections():
            unasked = list[str]()
            table = VideoTable.of(joined(ids, store.rows(), unasked))
            stale = _changed(root, ids, table, notice)
        store.forget(_gone(root, unasked, notice))
        with closing(probe_files(root, [ids[at] for at in stale], processes)) as found:
            for batch in batches(found, len(stale), progress):
                store.put(batch)
        if stale:
            with without_collections():
                table = VideoTable.of(joined(ids, store.rows(), []))
        if scenes is not None:
            scenes.collect(store, root, table, processes, progress)
        _remove_earlier_caches(path)
        return store, table
    except BaseException:
        store.close()
        raise


def _changed(root: Path | Copies, ids: list[str], table: VideoTable, notice: Notice | None) -> list[int]:
    """Ask for size and times of every file; return the places of those that the table does not know as they are."""
    folder = os.path.join(root, "")
    listed = root.listed if isinstance(root, Copies) else None

    def states(ids: Sequence[str]) -> array[int]:
        found = array("q")
        for id in ids:
            if listed is not None:
                state = listed.get(id)
                found.extend((-1, 0, 0) if state is None else (state.size_bytes, state.mark, 0))
                continue
            try:
                status = os.stat(folder + id)
            except OSError:
                found.extend((-1, 0, 0))
            else:
                found.extend((status.st_size, status.st_mtime_ns, status.st_ctime_ns))
        return found

    changed, done = list[int](), 0
    for part, answer in by_parts(states, ids):
        found, known = np.asarray(answer).reshape(-1, 3), table.states[done : done + len(part)]
        changed += (np.flatnonzero((found != known).any(1) | (found[:, 0] < 0)) + done).tolist()
        done += len(part)
        if notice is not None:
            notice(f"looking at files: {done} of {len(ids)}, {len(changed)} of them new or changed")
    return changed


def _gone(root: Path | Copies, ids: Sequence[str], notice: Notice | None) -> list[str]:
    """Return the ids whose file does not exist any more. One that cannot be asked about today is not gone."""
    if isinstance(root, Copies):
        return [id for id in ids if id not in root.listed]

    def is_gone(id: str) -> bool:
        try:
            return not stat.S_ISREG(os.stat(os.path.join(root, id)).st_mode)
        except OSError as error:
            return error.errno in (errno.ENOENT, errno.ENOTDIR)

    gone, done = list[str](), 0
    for part, those in by_parts(lambda part: list(filter(is_gone, part)), ids):
        done += len(part)
        gone += those
        if notice is not None:
            notice(f"looking for files that are gone: {done} of {len(ids)} that this corpus does not name")
    return gone


def _remove_earlier_caches(index: Path | None) -> None:
    """Remove the files beside the index that releases before 0.2 made of it."""
    for suffix in (".columns", ".scenes"):
        if index is not None:
            with suppress(OSError):
                index.with_suffix(suffix).unlink(missing_ok=True)

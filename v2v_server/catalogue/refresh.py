"""The catalogue's index on disk, brought up to date: what is new or changed is probed, what is gone is forgotten."""

from __future__ import annotations

import errno
import hashlib
import os
import sqlite3
import stat
from array import array
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import closing
from itertools import chain, islice, pairwise
from operator import itemgetter
from pathlib import Path

from v2v_server.catalogue.columns import CHUNK, Records, joined
from v2v_server.catalogue.files import Notice, answers, is_said
from v2v_server.catalogue.index_file import IndexRow, Store
from v2v_server.catalogue.scenes import Looking
from v2v_server.catalogue.survey import survey
from v2v_server.cloud.copies import Copies
from v2v_server.system.process import cache_folder

_WRITE_EVERY = 256

Progress = Callable[[int, int], None]
"""(files probed so far, files to probe)."""


def index_path(root: str | os.PathLike[str], cache_dir: str | os.PathLike[str] | None) -> Path:
    """The index file of a corpus; ``cache_dir`` as in :func:`v2v_server.catalogue.catalogue.open_catalogue`.

    Raises:
        CorpusError: none was chosen, and this user has no home folder.
    """
    name = hashlib.sha256(os.fsencode(root)).hexdigest()[:16]
    return cache_folder(cache_dir) / f"catalogue-{name}.sqlite3"


def up_to_date(
    root: Path | Copies,
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
        root: the folder, or what lies in object storage, that ids are relative to.
        ids: of the videos to know.
        path: of the index.
        looking: how to look at what the videos show; None does not.
        processes, progress, notice: as in :func:`v2v_server.catalogue.catalogue.open_catalogue`.
    """
    try:
        return *_refreshed(path, root, ids, looking, processes, progress, notice), []
    except (sqlite3.Error, OSError) as error:
        note = (
            f"the catalogue's index {path} cannot be used ({error}); this start keeps it in memory, and the next one "
            "probes every video again. Make room or give write access, delete the file if it is damaged, or choose "
            "another place with V2V_CACHE_DIR"
        )
        return *_refreshed(None, root, ids, looking, processes, progress, notice), [note]


def _refreshed(
    path: Path | None,
    root: Path | Copies,
    ids: Sequence[str],
    looking: Looking | None,
    processes: int,
    progress: Progress | None,
    notice: Notice | None,
) -> tuple[Store, Records]:
    store = Store(path)
    try:
        records, states, unasked = _known(store, ids)
        stale = _stale(root, records.ids, states, notice)
        store.forget(_gone(root, unasked, notice))
        with closing(survey(root, stale, processes)) as found:
            for batch in _batches(found, len(stale), progress):
                store.put(batch)
                for record in batch:
                    place = records.ids.find(record.id)
                    assert place is not None, record.id
                    records.change(place, record)
        records.fingerprints.settle()
        if looking is not None:
            looking.take_in(store, root, {record.id: record for record in records}, processes, progress)
        return store, records
    except BaseException:
        store.close()
        raise


def _known(store: Store, ids: Sequence[str]) -> tuple[Records, array[int], list[str]]:
    """What the index has of these ids; (size, mtime, ctime) of each, one after the other; other ids that it has."""
    ids = sorted(ids)
    if any(one == next for one, next in pairwise(ids)):  # a list may name a video twice
        ids = sorted(set(ids))
    records, states, unasked = Records(), array("q"), list[str]()
    with closing(store.rows()) as rows:
        found = joined(ids, rows, unasked)
        while chunk := list(islice(found, CHUNK)):
            records.extend(chunk)
            states.extend(chain.from_iterable(map(itemgetter(1, 2, 3), chunk)))
    return records, states, unasked


def _stale(root: Path | Copies, ids: Sequence[str], states: array[int], notice: Notice | None) -> list[str]:
    """Those of the ids whose files are new or changed."""
    folder, listed = os.path.join(root, ""), root.listed if isinstance(root, Copies) else None

    def is_unchanged(place: int) -> bool:
        size, mtime, ctime = states[3 * place : 3 * place + 3]
        if size < 0:
            return False
        if listed is not None:
            state = listed.get(ids[place])
            return state is not None and (state.size_bytes, state.mark, 0) == (size, mtime, ctime)
        try:
            status = os.stat(folder + ids[place])
        except OSError:
            return False
        return (status.st_size, status.st_mtime_ns, status.st_ctime_ns) == (size, mtime, ctime)

    stale = []
    for place, unchanged in answers(is_unchanged, range(len(ids))):
        if not unchanged:
            stale.append(ids[place])
        if notice is not None and is_said(place + 1):
            notice(f"looking at files: {place + 1} of {len(ids)}, {len(stale)} of them new or changed")
    return stale


def _gone(root: Path | Copies, ids: Iterable[str], notice: Notice | None) -> list[str]:
    """Those of the ids of which there is no file any more. One that cannot be looked at today is not gone."""
    if isinstance(root, Copies):
        return [id for id in ids if id not in root.listed]

    def is_gone(id: str) -> bool:
        try:
            return not stat.S_ISREG(os.stat(os.path.join(root, id)).st_mode)
        except OSError as error:
            return error.errno in (errno.ENOENT, errno.ENOTDIR)

    unlisted, gone = sorted(ids), []
    for done, (id, is_none) in enumerate(answers(is_gone, unlisted), 1):
        if is_none:
            gone.append(id)
        if notice is not None:
            notice(f"looking for files that are gone: {done} of {len(unlisted)} that this corpus does not name")
    return gone


def _batches(records: Iterator[IndexRow], total: int, progress: Progress | None) -> Iterator[list[IndexRow]]:
    batch: list[IndexRow] = []
    for done, record in enumerate(records, 1):
        batch.append(record)
        if progress is not None:
            progress(done, total)
        if len(batch) == _WRITE_EVERY:
            yield batch
            batch = []
    yield batch

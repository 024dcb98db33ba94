"""The members of the archives of a corpus. Their tables are made in confined processes, and the index keeps them: an
archive is read again only when its state has changed.
"""

from __future__ import annotations

import os
import sqlite3
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from typing import cast

import msgpack

from v2v_protocol.errors import VideoError
from v2v_server.corpus.index import FigureKind, Figures, Store
from v2v_server.corpus.probe import LARGEST_PROBE_BYTES, LONGEST_SECONDS
from v2v_server.corpus.sources import archives
from v2v_server.corpus.sources.archives import DEFLATE_RATIO, ArchiveTable, HasArchives, member_id
from v2v_server.corpus.sources.listing import Notice
from v2v_server.corpus.sources.source import FileState, MemberPlace, VideoSource, archive_mark
from v2v_server.system.isolate import Died, run_lent

_Archive = tuple[str, FileState]
_Job = tuple[str, str]
"""An archive, and the path that it is read from."""
_KIND = FigureKind("archive", "1")


def list_members(
    source: VideoSource, store: Store, ids: Sequence[str], processes: int, notice: Notice, refused: dict[str, str]
) -> list[str]:
    """Return ids with videos instead of their archives; ``source.members`` and ``source.tables`` have both.

    Args:
        source: where the videos come from.
        store: the index.
        ids: of videos and archives.
        processes: number of processes that read tables; 0 reads in this one.
        notice: progress callback.
        refused: receives, by id, why an archive or a member is refused.
    """
    kind, listed = source.kind, source.listed()
    packed = [id for id in ids if id.endswith(kind.archive_endings)]
    found = [id for id in ids if not id.endswith(kind.archive_endings)]
    wanted = None if listed is None else {entry.id for entry in listed}
    for done, (archive, state, table) in enumerate(_tables(source, store, packed, processes), 1):
        notice(f"reading the tables of archives in {source}: {done} of {len(packed)}")
        if isinstance(table, str):
            refused[archive] = table
            continue
        source.tables[archive] = table
        mark, takes_all = archive_mark(archive, state), wanted is None or archive in wanted
        for name, (size, start) in zip(table.names, table.places.tolist(), strict=True):
            id = member_id(archive, name)
            if kind.id_of(id) and (takes_all or (wanted and id in wanted)):
                source.members[id] = MemberPlace(archive, size, start, mark).state
                found.append(id)
        refused.update((member_id(archive, name), reason) for name, reason in table.refused)
        for note in table.notes:
            notice(f"{archive}: {note}", is_urgent=True)
    if packed and wanted is not None:
        missing = wanted.difference(found, ids, refused)
        refused.update(dict.fromkeys(missing, "is neither a file nor in an archive of the list's folder"))
    return found


def _tables(
    source: VideoSource, store: Store, packed: Sequence[str], processes: int
) -> Iterator[tuple[str, FileState, ArchiveTable | str]]:
    """Yield each archive with its state and its table, or why there is none."""
    if not packed:
        return
    store.make_figures()
    flat, stale = iter(source.states(packed)), list[_Archive]()
    for archive, state in zip(packed, zip(flat, flat, flat, strict=True), strict=True):
        if (known := store.figures(archive, str(state), _KIND)) is None:
            stale.append((archive, state))
        else:
            yield archive, state, _decoded(source, archive, known, state)

    @contextmanager
    def lend(item: _Archive) -> Iterator[_Job]:
        with cast(HasArchives, source).lend_archive(*item) as path:
            yield item[0], path

    results = run_lent(
        partial(read_table, source), stale, lend, processes, deadline_seconds=lambda job: LONGEST_SECONDS,
        memory_bytes=LARGEST_PROBE_BYTES, writable=(),
    )  # fmt: skip
    for (archive, state), result in results:
        if isinstance(result, Died):
            why = f"reading its table took too much time or memory, or crashed ({result.how})"
        elif isinstance(result, Exception):
            why = _line(result)
        elif not (why := result[1]):
            with suppress(sqlite3.Error):  # an index that cannot be written costs the next start this time again
                store.put_figures(_KIND, [Figures(archive, str(state), b"", result[0])])
            yield archive, state, _decoded(source, archive, result[0], state)
        if why:
            yield archive, state, why


def _decoded(source: VideoSource, archive: str, data: bytes, state: FileState) -> ArchiveTable | str:
    is_inflated = archive.endswith(".zip") and not source.is_local
    try:
        problem, table = msgpack.unpackb(data)
        return str(problem) or ArchiveTable.from_bytes(table, state[0] * (DEFLATE_RATIO if is_inflated else 1))
    except (ValueError, TypeError) as error:
        return f"its table is damaged ({error})"


def _line(error: Exception) -> str:
    return (
        error.reason if isinstance(error, VideoError) else f"cannot be read: {getattr(error, 'strerror', '') or error}"
    )


def read_table(source: VideoSource, job: _Job) -> tuple[bytes, str]:
    """Return what the index keeps of an archive, packed: why it is refused, and its table; or why it was not read."""
    archive, path = job
    try:
        with open(os.open(path, os.O_NONBLOCK), "rb") as file:  # the writer of a pipe may have ended already
            os.set_blocking(file.fileno(), True)
            table = archives.read_table(file, archive, source.kind.id_of, not source.is_local)
        return msgpack.packb(("", table.to_bytes())), ""
    except ValueError as error:
        return msgpack.packb((str(error), b"")), ""
    except (VideoError, OSError) as error:
        return b"", _line(error)
    except Exception as error:  # noqa: BLE001 - one strange archive must not end the reading of all others
        return msgpack.packb((f"reading it failed ({type(error).__name__}: {error})", b"")), ""

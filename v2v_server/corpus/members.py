"""The members of the archives of a corpus. Their tables are made in confined processes, and the index keeps them: an
archive is read again only when its state has changed.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator, Sequence
from contextlib import suppress
from functools import partial
from typing import cast

import msgpack

from v2v_protocol.errors import VideoError
from v2v_server.corpus.index import FigureKind, Figures, Store
from v2v_server.corpus.probe import LARGEST_PROBE_BYTES, LONGEST_SECONDS
from v2v_server.corpus.sources.archives import ArchiveTable, HasArchives, archive_mark, member_id
from v2v_server.corpus.sources.listing import Notice
from v2v_server.corpus.sources.source import FileState, VideoSource, mark_of
from v2v_server.system.isolate import Died, run_isolated

_Job = tuple[str, FileState]
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
    archives = [id for id in ids if id.endswith(kind.archive_endings)]
    found = [id for id in ids if not id.endswith(kind.archive_endings)]
    wanted = None if listed is None else {entry.id for entry in listed}
    for done, (archive, state, table) in enumerate(_tables(source, store, archives, processes), 1):
        notice(f"reading the tables of archives in {source}: {done} of {len(archives)}")
        if isinstance(table, str):
            refused[archive] = table
            continue
        source.tables[archive] = table
        mark, takes_all = archive_mark(archive, state), wanted is None or archive in wanted
        for name, (size, start) in zip(table.names, table.places.tolist(), strict=True):
            id = member_id(archive, name)
            if kind.id_of(id) and (takes_all or (wanted and id in wanted)):
                source.members[id] = size, start, mark ^ mark_of(source, id)
                found.append(id)
        refused.update((member_id(archive, name), reason) for name, reason in table.refused)
        for note in table.notes:
            notice(f"{archive}: {note}", is_urgent=True)
    if archives and wanted is not None:
        missing = wanted.difference(found, ids, refused)
        refused.update(dict.fromkeys(missing, "is neither a file nor in an archive of the list's folder"))
    return found


def _tables(
    source: VideoSource, store: Store, archives: Sequence[str], processes: int
) -> Iterator[tuple[str, FileState, ArchiveTable | str]]:
    """Yield each archive with its state and its table, or why there is none."""
    if not archives:
        return
    store.make_figures()
    flat, stale = iter(source.states(archives)), list[_Job]()
    for archive, state in zip(archives, zip(flat, flat, flat, strict=True), strict=True):
        if (known := store.figures(archive, str(state), _KIND)) is None:
            stale.append((archive, state))
        else:
            yield archive, state, _decoded(known, state)
    results = run_isolated(
        partial(read_table, source), stale, processes, lambda job: LONGEST_SECONDS, LARGEST_PROBE_BYTES,
        writable=() if source.is_local else None,
    )  # fmt: skip
    for (archive, state), result in results:
        if isinstance(result, Died):
            yield archive, state, f"reading its table took too much time or memory, or crashed ({result.how})"
            continue
        data, passing = result
        if passing:
            yield archive, state, passing
            continue
        with suppress(sqlite3.Error):  # an index that cannot be written costs the next start this time again
            store.put_figures(_KIND, [Figures(archive, str(state), b"", data)])
        yield archive, state, _decoded(data, state)


def _decoded(data: bytes, state: FileState) -> ArchiveTable | str:
    try:
        problem, table = msgpack.unpackb(data)
        return str(problem) or ArchiveTable.from_bytes(table, state[0])
    except (ValueError, TypeError) as error:
        return f"its table is damaged ({error})"


def read_table(source: VideoSource, job: _Job) -> tuple[bytes, str]:
    """Return what the index keeps of an archive, packed: why it is refused, and its table; or why it was not read."""
    archive, state = job
    try:
        table = cast(HasArchives, source).read_table(archive)
        is_same = source.state(archive) == state
        return (msgpack.packb(("", table)), "") if is_same else (b"", "changes while it is read; start again")
    except ValueError as error:
        return msgpack.packb((str(error), b"")), ""
    except VideoError as error:
        return b"", error.reason
    except OSError as error:
        return b"", f"cannot be read: {error.strerror or error}"
    except Exception as error:  # noqa: BLE001 - one strange archive must not end the reading of all others
        return msgpack.packb((f"reading it failed ({type(error).__name__}: {error})", b"")), ""

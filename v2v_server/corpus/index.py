"""The index of a corpus on disk: the result of probing each file, so that the next start can skip it.

One SQLite file per corpus. A row is believed as long as the file's size and the times of its last modification and
change of status stay the same: the latter is set by the system whatever a program does to the former. Writes are
short transactions with a busy timeout, so several servers may share one index; since a row is a function of the file
alone, it does not matter which of them wrote it. An index may be made on many hosts: each probes a shard of the files,
and the shards are put together on one.
"""

from __future__ import annotations

import os
import re
import shutil
import sqlite3
import time
import weakref
from collections.abc import Generator, Iterable, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from threading import Timer
from typing import Any

import xxhash

from v2v_protocol.errors import CorpusError, UsageError, system_errors, undo_on_error
from v2v_protocol.write_aside import write_aside_and_rename
from v2v_server.corpus.sources.listing import Notice, silent
from v2v_server.corpus.videos import IndexRow
from v2v_server.system.process import make_private

SCHEMA_VERSION = 7
"""Raise it with every change of the table or of what probing finds: an index of another version is made again."""

_BUSY_SECONDS, _SAY_SECONDS = 30.0, 2.0
"""Time to wait for another process that holds the index, and until that is said."""
_TABLE = """
CREATE TABLE video (
    id TEXT PRIMARY KEY,
    size_bytes INTEGER NOT NULL,
    mtime_ns INTEGER NOT NULL,
    ctime_ns INTEGER NOT NULL,
    fingerprint TEXT NOT NULL,
    frames INTEGER NOT NULL,
    width_px INTEGER NOT NULL,
    height_px INTEGER NOT NULL,
    frames_per_second REAL,
    codec TEXT NOT NULL,
    interlaced INTEGER NOT NULL,
    remark TEXT NOT NULL,
    problem TEXT,
    frame_index BLOB
)"""

_FIGURES = """
CREATE TABLE IF NOT EXISTS figures (
    kind TEXT NOT NULL,
    version TEXT NOT NULL,
    id TEXT NOT NULL,
    fingerprint TEXT NOT NULL,
    summary BLOB NOT NULL,
    data BLOB NOT NULL,
    PRIMARY KEY (kind, version, id)
)"""
_SUMMARIES = "CREATE INDEX IF NOT EXISTS summaries ON figures (kind, version, id, fingerprint, summary)"
"""Summaries are read without the data beside them."""
_FIGURE_COLUMNS = "kind", "version", "id", "fingerprint", "summary", "data"
_NAME = re.compile(r"part-(\d+)-of-(\d+)\.sqlite3")


@dataclass(frozen=True, slots=True)
class FigureKind:
    """Figures of one kind.

    Attributes:
        name: what was measured, such as "scene".
        version: how it was measured, and on which part of the pictures. Figures of other versions do not count.
    """

    name: str
    version: str


@dataclass(frozen=True, slots=True)
class Figures:
    """Figures of a video.

    Attributes:
        id, fingerprint: of the video.
        summary: the figures that a start of the server reads of all videos, encoded.
        data: all figures, encoded.
    """

    id: str
    fingerprint: str
    summary: bytes
    data: bytes


_COLUMNS = IndexRow.__slots__[:-1]


def _insert(table: str, columns: Sequence[str]) -> str:
    return f"INSERT OR REPLACE INTO {table} ({', '.join(columns)}) VALUES ({', '.join('?' * len(columns))})"


class Store:
    """The open index of a catalogue; a *store* elsewhere is the lossless clip store (``v2v_server/store``).

    Args:
        path: the SQLite file, made if missing; None keeps the index in memory.
        notice: called with a line of text if another process holds the index.

    Attributes:
        path: that.
        replaced_version: version of the index that lay there and could not be used; None if there was none.

    Raises:
        sqlite3.Error, OSError: the file cannot be made, opened or read.

    Every method may also raise UnicodeDecodeError for a damaged file: SQLite's message then quotes what is not UTF-8.
    """

    def __init__(self, path: Path | None, notice: Notice = silent) -> None:
        if path is not None:
            path.parent.mkdir(parents=True, exist_ok=True)
            make_private(path)  # SQLite gives its other files the mode of this one
        self.path = path
        self._notice = notice
        self.replaced_version: int | None = None
        self._database = sqlite3.connect(
            ":memory:" if path is None else path, timeout=_BUSY_SECONDS, isolation_level=None, check_same_thread=False
        )
        weakref.finalize(self, self._database.close)  # commands that end with their catalogue open
        with undo_on_error(self._database.close):
            self._prepare()

    def _prepare(self) -> None:
        if self._version() == SCHEMA_VERSION:
            return
        self._patiently("BEGIN IMMEDIATE")
        with self._database:
            version = self._version()
            if version == SCHEMA_VERSION:  # another process was faster
                return
            self.replaced_version = version or None
            self._database.execute("DROP TABLE IF EXISTS video")
            self._database.execute(_TABLE)
            self._database.execute(f"PRAGMA user_version = {SCHEMA_VERSION}")

    def _version(self) -> int:
        return int(self._patiently("PRAGMA user_version").fetchone()[0])

    def _patiently(self, statement: str) -> sqlite3.Cursor:
        """Execute a statement that may have to wait for another process, and say so if it does."""
        began = time.monotonic()
        text = f"another process holds the catalogue's index {self.path}: waiting for at most {_BUSY_SECONDS:g} s"
        said = Timer(_SAY_SECONDS, self._notice, (text,), {"is_urgent": True})
        said.start()
        try:
            done = self._database.execute(statement)
        finally:
            said.cancel()
        if time.monotonic() - began > _SAY_SECONDS:
            self._notice(f"the catalogue's index {self.path} is free again", is_urgent=True)
        return done

    def rows(self, kind: FigureKind | None) -> Generator[tuple[Any, ...], None, None]:
        """Yield all records by id: the attributes of :class:`IndexRow` without the frame index, and a summary.

        Another program may have put any type into any column but the id.

        Args:
            kind: figures whose summary is read. It is None where a video has none for its present fingerprint.

        Raises:
            sqlite3.Error: the file is damaged.
        """
        names = ", ".join(f"video.{name}" for name in _COLUMNS)
        join = (
            "LEFT JOIN figures ON kind = ? AND version = ? AND figures.id = video.id "
            "AND figures.fingerprint = video.fingerprint"
        )
        summary, join, values = ("summary", join, (kind.name, kind.version)) if kind else ("NULL", "", ())
        query = f"SELECT {names}, {summary} FROM video {join} WHERE typeof(video.id) = 'text' ORDER BY video.id"
        with closing(self._database.execute(query, values)) as rows:
            yield from rows

    def frame_index(self, id: str, fingerprint: str) -> bytes | None:
        """Return the encoded frame index of a file; None if the index does not know this state of it.

        Raises:
            sqlite3.Error: the file is damaged.
        """
        query = "SELECT frame_index FROM video WHERE id = ? AND fingerprint = ?"
        return _blob(self._database.execute(query, (id, fingerprint)).fetchone())

    def state(self, id: str, fingerprint: str) -> tuple[int, int, int] | None:
        """Return the state of a file when it was probed; None if the index does not know this state of it.

        Raises:
            sqlite3.Error: the file is damaged.
        """
        row = self._database.execute(
            "SELECT size_bytes, mtime_ns, ctime_ns FROM video WHERE id = ? AND fingerprint = ?", (id, fingerprint)
        ).fetchone()
        return None if row is None else (row[0], row[1], row[2])

    def make_figures(self) -> None:
        """Make the table of figures if it is missing.

        Raises:
            sqlite3.Error: as for :meth:`put`.
        """
        self._database.execute(_FIGURES)
        self._database.execute(_SUMMARIES)

    def all_figures(self, kind: FigureKind) -> Generator[tuple[str, bytes, bytes], None, None]:
        """Yield (id, summary, encoded figures) by id, of each video with figures for its present fingerprint.

        Raises:
            sqlite3.Error: the file is damaged.
        """
        query = (
            "SELECT figures.id, summary, data FROM figures JOIN video USING (id, fingerprint) WHERE kind = ? "
            "AND version = ? AND typeof(summary) = 'blob' AND typeof(data) = 'blob' ORDER BY figures.id"
        )
        with closing(self._database.execute(query, (kind.name, kind.version))) as rows:
            yield from rows

    def figures(self, id: str, fingerprint: str, kind: FigureKind) -> bytes | None:
        """Return the encoded figures of a video; None if the index has none of this state of it.

        Raises:
            sqlite3.Error: the file is damaged.
        """
        query = "SELECT data FROM figures WHERE id = ? AND fingerprint = ? AND kind = ? AND version = ?"
        return _blob(self._database.execute(query, (id, fingerprint, kind.name, kind.version)).fetchone())

    def put_figures(self, kind: FigureKind, figures: Iterable[Figures]) -> None:
        """Add or replace figures, in one transaction.

        Raises:
            sqlite3.Error: as for :meth:`put`.
        """
        rows = [(kind.name, kind.version, each.id, each.fingerprint, each.summary, each.data) for each in figures]
        self._change(_insert("figures", _FIGURE_COLUMNS), rows)

    def has_other_versions(self, name: str, ending: str) -> bool:
        """Return whether there are figures of this name whose version does not end like this.

        Raises:
            sqlite3.Error: the file is damaged.
        """
        query = "SELECT 1 FROM figures WHERE kind = ? AND substr(version, -length(?2)) <> ?2 LIMIT 1"
        return self._database.execute(query, (name, ending)).fetchone() is not None

    def put(self, records: Iterable[IndexRow]) -> None:
        """Add or replace records, in one transaction.

        Raises:
            sqlite3.Error: the file is damaged, read-only, locked for too long, or the disk is full.
        """
        rows = [(*record.columns, record.frame_index) for record in records]
        self._change(_insert("video", IndexRow.__slots__), rows)

    def merge(self, path: Path) -> int:
        """Add or replace all that another index knows, in one transaction.

        Returns:
            the number of its records.

        Raises:
            ValueError: the file is no index of this version.
            sqlite3.Error: the file is damaged; or as for :meth:`put`.
        """
        # Immutable: the file may be on storage where SQLite's locks do not work.
        with closing(sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro&immutable=1", uri=True)) as other:
            (version,) = other.execute("PRAGMA user_version").fetchone()
            if version != SCHEMA_VERSION:
                raise ValueError(f"is an index of version {version}, this program reads {SCHEMA_VERSION}")
            self.make_figures()
            self._patiently("BEGIN IMMEDIATE")
            with self._database:
                for table, columns in ("video", IndexRow.__slots__), ("figures", _FIGURE_COLUMNS):
                    if other.execute(
                        "SELECT 1 FROM sqlite_master WHERE type = 'table' AND name = ?", (table,)
                    ).fetchone():
                        rows = other.execute(f"SELECT {', '.join(columns)} FROM {table}")
                        self._database.executemany(_insert(table, columns), rows)
            return int(other.execute("SELECT COUNT(*) FROM video").fetchone()[0])

    def forget(self, ids: Iterable[str]) -> None:
        """Drop records, in one transaction.

        Raises:
            sqlite3.Error: as for :meth:`put`.
        """
        self._change("DELETE FROM video WHERE id = ?", [(id,) for id in ids])

    def mark_stale(self, id: str) -> None:
        """Let the next start probe a file again.

        Raises:
            sqlite3.Error: as for :meth:`put`.
        """
        self._change("UPDATE video SET size_bytes = -1 WHERE id = ?", [(id,)])

    def fail_fast(self) -> None:
        """From now on an index that another process holds is an error at once."""
        self._database.execute("PRAGMA busy_timeout = 0")

    def _change(self, statement: str, rows: Sequence[tuple[object, ...]]) -> None:
        if not rows:
            return
        self._patiently("BEGIN IMMEDIATE")
        with self._database:
            self._database.executemany(statement, rows)

    def close(self) -> None:
        """Close the file."""
        self._database.close()


def _blob(row: tuple[Any] | None) -> bytes | None:
    """Return what a query for one blob found; None if that is no blob, since another program changed it."""
    return row[0] if row is not None and isinstance(row[0], bytes) else None


@dataclass(frozen=True, slots=True, order=True)
class Shard:
    """A share of a corpus's files. Ids alone decide it, so hosts need no coordination.

    Attributes:
        count: shards in all.
        number: of this one, 1 .. count.
    """

    count: int
    number: int

    @classmethod
    def parse(cls, text: str) -> Shard:
        """From ``3/16``.

        Raises:
            UsageError: there is no such shard.
        """
        found = re.fullmatch(r"(\d{1,5})/(\d{1,5})", text)
        if found is None or not 1 <= int(found[1]) <= int(found[2]):
            raise UsageError(f"--shard {text}: give NUMBER/COUNT from 1/COUNT to COUNT/COUNT, such as 3/16")
        return cls(int(found[2]), int(found[1]))

    def __str__(self) -> str:
        return f"{self.number}/{self.count}"

    @property
    def file_name(self) -> str:
        """Return the name of the file of its index in the folder of the parts."""
        return f"part-{self.number:0{len(str(self.count))}d}-of-{self.count}.sqlite3"

    def holds(self, id: str) -> bool:
        """Return whether the shard contains this file."""
        return xxhash.xxh3_64_intdigest(id.encode()) % self.count == self.number - 1


def make_folder(folder: Path) -> None:
    """Make a folder for parts and check that it is writable, before hours of work.

    Raises:
        CorpusError: it cannot.
    """
    probe = folder / f".part.{os.getpid()}"
    with system_errors(CorpusError, f"--out {folder}: cannot be written to"):
        folder.mkdir(parents=True, exist_ok=True)
        probe.touch()
        probe.unlink()


def write_part(index: Path, folder: Path, shard: Shard) -> Path:
    """Copy a shard's index into the folder, in one step.

    Raises:
        CorpusError: it cannot be written.
    """
    path = folder / shard.file_name
    with system_errors(CorpusError, f"{path}: cannot be written"), write_aside_and_rename(path) as partial:
        shutil.copyfile(index, partial)
    return path


def parts_in(folder: Path) -> list[Path]:
    """Find the parts in a folder, one of each shard.

    Raises:
        CorpusError: there are none, some are missing, or they are of more than one division.
    """
    with system_errors(CorpusError, f"--merge {folder}: cannot be read"):
        names = sorted(os.listdir(folder))
    found = {Shard(int(name[2]), int(name[1])): folder / name[0] for name in map(_NAME.fullmatch, names) if name}
    counts = {shard.count for shard in found}
    if not counts:
        raise CorpusError(f"--merge {folder}: holds no part; v2v-catalogue --shard 1/N --out {folder} writes the first")
    if len(counts) > 1:
        raise CorpusError(
            f"--merge {folder}: holds parts of splits into {' and '.join(map(str, sorted(counts)))}; "
            "keep those of one split"
        )
    (count,) = counts
    missing = [number for number in range(1, count + 1) if Shard(count, number) not in found]
    if missing:
        shown = ", ".join(f"{number}/{count}" for number in missing[:8]) + (", ..." if len(missing) > 8 else "")
        raise CorpusError(
            f"--merge {folder}: {len(missing)} of {count} parts are missing; run v2v-catalogue --shard for {shown}"
        )
    return [found[shard] for shard in sorted(found)]


def merge_parts(index: Path, parts: list[Path]) -> int:
    """Merge parts into an index, which may have records already. An interrupted merge can be repeated.

    Returns:
        how many records they have.

    Raises:
        CorpusError: a part cannot be read, or the index not be written.
    """
    try:
        store = Store(index)
    except (sqlite3.Error, OSError, UnicodeDecodeError) as error:
        raise CorpusError(f"the catalogue's index {index} cannot be opened: {error}") from error
    records = 0
    with closing(store):
        for part in parts:
            try:
                records += store.merge(part)
            except ValueError as error:
                raise CorpusError(f"{part}: {error}; make that shard again with this program") from error
            except sqlite3.Error as error:
                raise CorpusError(f"{part}: cannot be put into {index}: {error}") from error
    return records

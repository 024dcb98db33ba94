"""The index of a corpus on disk: what probing each file has found, so that the next start need not do it again.

One SQLite file per corpus. A row is believed as long as the file's size and the times of its last modification and
change of status stay the same: the latter is set by the system whatever a program does to the former. Writes are
short transactions with a busy timeout, so several servers may share one index; since a row is a function of the file
alone, it does not matter which of them wrote it.
"""

from __future__ import annotations

import os
import sqlite3
from collections.abc import Generator, Iterable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from v2v_server.system.private import make_private
from v2v_server.video.frame_index import LARGEST_FRAMES, LARGEST_SIDE_PX

SCHEMA_VERSION = 5
"""Raise it with every change of the table or of what probing finds: an index of another version is made again."""

MARKED_FROM = 10_000
"""Records from which on it is worth knowing that nothing has changed."""
_BUSY_SECONDS = 30.0
_HEADER_BYTES = 100  # of a SQLite file, see its format
_WAL = 2
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
    problem TEXT,
    frame_index BLOB
)"""

_SOUND = f"""
    typeof(id) = 'text' AND typeof(fingerprint) = 'text' AND typeof(codec) = 'text'
    AND typeof(size_bytes) = 'integer' AND typeof(mtime_ns) = 'integer' AND typeof(ctime_ns) = 'integer'
    AND typeof(interlaced) = 'integer' AND interlaced IN (0, 1)
    AND typeof(frames) = 'integer' AND typeof(width_px) = 'integer' AND typeof(height_px) = 'integer'
    AND (frames_per_second IS NULL OR typeof(frames_per_second) = 'real' AND frames_per_second BETWEEN 0 AND 1e9)
    AND CASE WHEN problem IS NULL THEN
        frames BETWEEN 1 AND {LARGEST_FRAMES} AND width_px BETWEEN 1 AND {LARGEST_SIDE_PX}
        AND height_px BETWEEN 1 AND {LARGEST_SIDE_PX} AND typeof(frame_index) IN ('blob', 'null')
    ELSE
        typeof(problem) = 'text' AND frames BETWEEN 0 AND {LARGEST_FRAMES}
        AND width_px BETWEEN 0 AND {LARGEST_SIDE_PX} AND height_px BETWEEN 0 AND {LARGEST_SIDE_PX}
    END"""
"""Records that :meth:`Store.put` can have written: SQLite takes any type in any column."""

_SCENES = """
CREATE TABLE IF NOT EXISTS scene (
    id TEXT NOT NULL,
    fingerprint TEXT NOT NULL,
    look TEXT NOT NULL,
    data BLOB NOT NULL,
    PRIMARY KEY (id, look)
)"""


@dataclass(frozen=True, slots=True)
class IndexRow:
    """What is known of one file.

    Attributes:
        id: relative POSIX path.
        size_bytes, mtime_ns, ctime_ns: of the file when it was probed; a size of -1, which no file has, lets it be
            probed again at the next start.
        fingerprint: see :mod:`v2v_server.video.fingerprint`.
        frames, width_px, height_px, frames_per_second, codec, interlaced: see
            :class:`v2v_server.video.probe.VideoFacts`; frames_per_second is None where unknown.
        problem: why the file cannot be used; None if it can.
        frame_index: ``FrameIndex.to_bytes()``; None with a problem, and where only the other columns were read.
    """

    id: str
    size_bytes: int
    mtime_ns: int = 0
    ctime_ns: int = 0
    fingerprint: str = ""
    frames: int = 0
    width_px: int = 0
    height_px: int = 0
    frames_per_second: float | None = None
    codec: str = ""
    interlaced: bool = False
    problem: str | None = None
    frame_index: bytes | None = None


_COLUMNS = ", ".join(name for name in IndexRow.__slots__ if name != "frame_index")


class Store:
    """An open index.

    Args:
        path: the SQLite file, made if missing; None keeps the index in memory.

    Attributes:
        path: that.
        replaced_version: version of the index that lay there and could not be used; None if there was none.

    Raises:
        sqlite3.Error, OSError: the file cannot be made, opened or read.

    Every method may also raise UnicodeDecodeError for a damaged file: SQLite's message then quotes what is not UTF-8.
    """

    def __init__(self, path: Path | None) -> None:
        if path is not None:
            path.parent.mkdir(parents=True, exist_ok=True)
            make_private(path)  # SQLite gives its other files the mode of this one
        self.path = path
        self.replaced_version: int | None = None
        self._database = sqlite3.connect(
            ":memory:" if path is None else path, timeout=_BUSY_SECONDS, isolation_level=None, check_same_thread=False
        )
        try:
            self._prepare()
        except BaseException:
            self._database.close()
            raise

    def _prepare(self) -> None:
        if self._version() == SCHEMA_VERSION:
            return
        self._database.execute("BEGIN IMMEDIATE")
        with self._database:
            version = self._version()
            if version == SCHEMA_VERSION:  # another process was faster
                return
            self.replaced_version = version or None
            self._database.execute("DROP TABLE IF EXISTS video")
            self._database.execute(_TABLE)
            self._database.execute(f"PRAGMA user_version = {SCHEMA_VERSION}")

    def _version(self) -> int:
        return int(self._database.execute("PRAGMA user_version").fetchone()[0])

    def rows(self) -> Generator[tuple[Any, ...], None, None]:
        """Yield all sound records by id, as the attributes of :class:`IndexRow` without their frame indices.

        Damaged ones are left out, so that their files are probed again.

        Raises:
            sqlite3.Error: the file is damaged.
        """
        query = f"SELECT {_COLUMNS} FROM video WHERE {_SOUND} ORDER BY id"
        with closing(self._database.execute(query)) as rows:
            yield from rows

    @contextmanager
    def reading(self) -> Iterator[str]:
        """Nobody writes meanwhile. Gives the mark of the state that the index is in: two that are equal are of equal
        contents. Empty where it has none: in memory, with a write-ahead log, and where it is small.

        Raises:
            sqlite3.Error, OSError: the file is damaged or cannot be read, or is held by another process for too long.
        """
        self._database.execute("BEGIN")
        try:
            query = f"SELECT 1 FROM video LIMIT 1 OFFSET {MARKED_FROM - 1}"
            is_large = self._database.execute(query).fetchone() is not None  # only this takes the lock
            yield self._mark() if is_large else ""
        finally:
            self._database.rollback()

    def _mark(self) -> str:
        if self.path is None:
            return ""
        with self.path.open("rb") as file:
            head, status = file.read(_HEADER_BYTES), os.fstat(file.fileno())
        if len(head) < _HEADER_BYTES or _WAL in head[18:20]:
            return ""
        changes = int.from_bytes(head[24:28], "big")  # counts transactions that wrote
        return f"{SCHEMA_VERSION} {status.st_ino} {status.st_size} {status.st_mtime_ns} {changes}"

    def frame_index(self, id: str, fingerprint: str) -> bytes | None:
        """The encoded frame index of a file; None if the index does not know that state of it.

        Raises:
            sqlite3.Error: the file is damaged.
        """
        query = "SELECT frame_index FROM video WHERE id = ? AND fingerprint = ?"
        return _blob(self._database.execute(query, (id, fingerprint)).fetchone())

    def state(self, id: str) -> tuple[int, int, int] | None:
        """Return the state of a file when it was probed; None if it is not known.

        Raises:
            sqlite3.Error: the file is damaged.
        """
        row = self._database.execute("SELECT size_bytes, mtime_ns, ctime_ns FROM video WHERE id = ?", (id,)).fetchone()
        return None if row is None else (row[0], row[1], row[2])

    def not_looked_at(self, look: str) -> list[str]:
        """The sound files whose scene is not known as they are.

        Args:
            look: how and at which rows, see :class:`v2v_server.corpus.scenes.Looking`.

        Raises:
            sqlite3.Error: the file is damaged or cannot be written.
        """
        self._database.execute(_SCENES)
        query = (
            "SELECT video.id FROM video LEFT JOIN scene ON scene.id = video.id AND scene.look = ? "
            "AND scene.fingerprint = video.fingerprint WHERE scene.id IS NULL AND video.problem IS NULL "
            "ORDER BY video.id"
        )
        return [id for (id,) in self._database.execute(query, (look,))]

    def scene(self, id: str, fingerprint: str, look: str) -> bytes | None:
        """The encoded scene of a file; None if the index has none of that state of it.

        Raises:
            sqlite3.Error: the file is damaged.
        """
        query = "SELECT data FROM scene WHERE id = ? AND fingerprint = ? AND look = ?"
        return _blob(self._database.execute(query, (id, fingerprint, look)).fetchone())

    def put_scenes(self, scenes: Iterable[tuple[str, str, str, bytes]]) -> None:
        """Add or replace (id, fingerprint, look, encoded scene), in one transaction.

        Raises:
            sqlite3.Error: as for :meth:`put`.
        """
        self._change("INSERT OR REPLACE INTO scene (id, fingerprint, look, data) VALUES (?, ?, ?, ?)", list(scenes))

    def put(self, records: Iterable[IndexRow]) -> None:
        """Add or replace records, in one transaction.

        Raises:
            sqlite3.Error: the file is damaged, read-only, locked for too long, or the disk is full.
        """
        rows = [tuple(getattr(record, name) for name in IndexRow.__slots__) for record in records]
        places = ", ".join("?" * len(IndexRow.__slots__))
        self._change(f"INSERT OR REPLACE INTO video ({_COLUMNS}, frame_index) VALUES ({places})", rows)

    def take_in(self, path: Path) -> int:
        """Adds or replaces all that another index knows, in one transaction.

        Returns:
            how many records it has.

        Raises:
            ValueError: it is an index of another version, or none.
            sqlite3.Error: it is damaged; or as for :meth:`put`.
        """
        # Immutable: it may lie where SQLite's locks do not work.
        with closing(sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro&immutable=1", uri=True)) as other:
            (version,) = other.execute("PRAGMA user_version").fetchone()
            if version != SCHEMA_VERSION:
                raise ValueError(f"is an index of version {version}, this program reads {SCHEMA_VERSION}")
            self._database.execute(_SCENES)
            self._database.execute("BEGIN IMMEDIATE")
            with self._database:
                for table, columns in ("video", f"{_COLUMNS}, frame_index"), ("scene", "id, fingerprint, look, data"):
                    if other.execute("SELECT 1 FROM sqlite_master WHERE name = ?", (table,)).fetchone() is None:
                        continue
                    places = ", ".join("?" * (columns.count(",") + 1))
                    rows = other.execute(f"SELECT {columns} FROM {table}")
                    self._database.executemany(f"INSERT OR REPLACE INTO {table} ({columns}) VALUES ({places})", rows)
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
        self._database.execute("BEGIN IMMEDIATE")
        with self._database:
            self._database.executemany(statement, rows)

    def close(self) -> None:
        """Close the file."""
        self._database.close()


def _blob(row: tuple[Any] | None) -> bytes | None:
    """Return what a query for one blob found; None if that is no blob, since another program changed it."""
    return row[0] if row is not None and isinstance(row[0], bytes) else None

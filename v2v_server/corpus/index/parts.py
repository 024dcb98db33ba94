"""An index made on many hosts: each probes some of the files, and the parts are put together on one."""

from __future__ import annotations

import os
import re
import shutil
import sqlite3
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import xxhash

from v2v_protocol.errors import CorpusError, UsageError
from v2v_protocol.write_aside import write_aside_and_rename
from v2v_server.corpus.index.file import Store

_NAME = re.compile(r"part-(\d+)-of-(\d+)\.sqlite3")


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
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise CorpusError(f"--out {folder}: cannot be written to: {error.strerror or error}") from error


def write_part(index: Path, folder: Path, shard: Shard) -> Path:
    """Copy a shard's index into the folder, in one step.

    Raises:
        CorpusError: it cannot be written.
    """
    path = folder / shard.file_name
    try:
        with write_aside_and_rename(path) as partial:
            shutil.copyfile(index, partial)
    except OSError as error:
        raise CorpusError(f"{path}: cannot be written: {error.strerror or error}") from error
    return path


def parts_in(folder: Path) -> list[Path]:
    """Find the parts in a folder, one of each shard.

    Raises:
        CorpusError: there are none, some are missing, or they are of more than one division.
    """
    try:
        names = sorted(os.listdir(folder))
    except OSError as error:
        raise CorpusError(f"--merge {folder}: cannot be read: {error.strerror or error}") from error
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

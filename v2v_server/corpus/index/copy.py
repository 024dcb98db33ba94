"""The columns of an index in a plain file beside it: a start reads a million records in a tenth of the time that SQLite
takes for them.

The file begins with the mark of the state of the index that it is a copy of (:meth:`Store.mark`), and holds parts, each
with its length and a checksum; the last one is empty. A copy of another state, or a damaged one, is not used: the index
is read instead, and a new copy written on the way. Small indexes have none.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Generator, Iterable, Mapping
from contextlib import suppress
from io import FileIO
from pathlib import Path
from typing import Any, BinaryIO

import msgpack
import xxhash

from v2v_server.system.private import open_private

Part = Mapping[str, Any]
"""Some of the records in columns, see :meth:`v2v_server.corpus.index.columns.Records.packed`."""

_HEAD = struct.Struct("<QQ")  # length and checksum of what follows
_MAGIC = b"v2v index copy 2\n"


class NoCopy(Exception):
    """There is no copy of that state of the index that can be read."""


def copy_path(index: Path, kind: str = "columns") -> Path:
    """Where the copy of an index lies, or what else was made of it."""
    return index.with_suffix(f".{kind}")


def read_copy(index: Path | None, mark: str, kind: str = "columns") -> Generator[Part, None, None]:
    """The parts of an index's copy, in the order of their records.

    Args:
        index: the file; None where it is in memory.
        mark: of its state; empty where it has none.
        kind: what was made of it.

    Raises:
        NoCopy: at any part: what came before it is worth nothing then.
    """
    if index is None or not mark:
        raise NoCopy
    try:
        with copy_path(index, kind).open("rb") as file:
            if file.read(len(_MAGIC)) != _MAGIC or _body(file) != mark.encode():
                raise NoCopy
            while body := _body(file):
                yield msgpack.unpackb(body)
    except OSError as error:
        raise NoCopy from error


def _body(file: BinaryIO) -> bytes:
    head = file.read(_HEAD.size)
    if len(head) < _HEAD.size:
        raise NoCopy
    size, checksum = _HEAD.unpack(head)
    left = os.fstat(file.fileno()).st_size - file.tell()
    body = file.read(size) if size <= left else b""
    if len(body) != size or xxhash.xxh3_64_intdigest(body) != checksum:
        raise NoCopy
    return body


def copied(index: Path | None, mark: str, parts: Iterable[Part], kind: str = "columns") -> Generator[Part, None, None]:
    """Passes parts of an index on, and leaves a copy of them all behind. One that cannot be written costs time at the
    next start, nothing else."""
    if index is None or not mark:
        yield from parts
        return
    path = copy_path(index, kind)
    partial = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        file = open(open_private(partial, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), "wb", buffering=0)  # noqa: SIM115
    except OSError:
        yield from parts
        return
    with suppress(OSError):
        try:
            with file:
                is_whole = _put(file, _MAGIC) and _put(file, _sealed(mark.encode()))
                for part in parts:
                    is_whole = is_whole and _put(file, _sealed(msgpack.packb(part)))
                    yield part
                is_whole = is_whole and _put(file, _sealed(b""))
            if is_whole:
                partial.replace(path)
        finally:
            partial.unlink(missing_ok=True)


def _sealed(body: bytes) -> bytes:
    return _HEAD.pack(len(body), xxhash.xxh3_64_intdigest(body)) + body


def _put(file: FileIO, data: bytes) -> bool:
    """Whether it was written to the end."""
    try:
        return file.write(data) == len(data)
    except OSError:
        return False

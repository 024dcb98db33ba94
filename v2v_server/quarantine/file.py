"""Read and write the quarantine of a corpus.

Several servers and a person may write to the quarantine of one corpus at once. So only the file assigns numbers, under
an advisory lock, and only lines that are on disk count. The lines that a process has in memory are always the first
lines of the file.
"""

from __future__ import annotations

import errno
import json
import os
from dataclasses import replace
from pathlib import Path

from v2v_protocol.errors import CorpusError, ProtocolError
from v2v_protocol.persisted import parse_json
from v2v_server.corpus.refresh import index_path
from v2v_server.quarantine.snapshots import Quarantine, QuarantineEntry
from v2v_server.system.locks import lock
from v2v_server.system.private import open_private

_LOCK_SECONDS = 2.0
"""Longest wait for the lock. Writers hold it for a moment, a process that was stopped for longer."""


def quarantine_path(root: str | os.PathLike[str], cache_dir: str | os.PathLike[str] | None) -> Path:
    """Return the path of a corpus's quarantine file, beside the catalogue's index."""
    index = index_path(root, cache_dir)
    return index.with_name(index.name.replace("catalogue-", "quarantine-")).with_suffix(".jsonl")


def read_quarantine(file: Path) -> Quarantine:
    """Read a quarantine from a file of JSON lines; it is empty if there is no such file.

    A truncated last line (it is being written, or the host lost power while writing) is ignored.

    Raises:
        CorpusError: the file cannot be read, or any other line is damaged.
    """
    try:
        return _parse(file, file.read_bytes())
    except FileNotFoundError:
        return Quarantine()
    except OSError as error:
        raise CorpusError(f"quarantine file {file} cannot be read: {error.strerror}; give read access") from error


def write_entry(
    file: Path, entry: QuarantineEntry, known: Quarantine, wait_seconds: float = _LOCK_SECONDS
) -> list[QuarantineEntry]:
    """Write an entry under the next number. It is on disk before any sample is made under the new snapshot.

    Args:
        file: the quarantine file; created if it is missing.
        entry: the entry; its number is ignored.
        known: the lines that the caller has read or written so far.
        wait_seconds: how long to try to lock the file.

    Returns:
        every line that ``known`` lacks: those of other processes first, then this one.

    Raises:
        BlockingIOError: another process has locked the file.
        OSError: the file cannot be written.
        CorpusError: the file is damaged, or is not the file that ``known`` came from.
    """
    file.parent.mkdir(parents=True, exist_ok=True)
    descriptor = open_private(file, os.O_RDWR | os.O_APPEND | os.O_CREAT)
    with open(descriptor, "a+b", buffering=0) as out:
        lock(descriptor, wait_seconds, file)  # until the file is closed
        out.seek(0)
        whole = out.readall()
        lines = _parse(file, whole).lines
        if lines[: known.latest] != known.lines:
            raise CorpusError(
                f"quarantine file {file} was replaced: it has {len(lines)} lines, which do not start with the "
                f"{known.latest} lines read before; restart the programs that use it"
            )
        numbered = replace(entry, snapshot=len(lines) + 1)
        line = json.dumps(numbered.to_dict()).encode() + b"\n"
        kept = whole.rfind(b"\n") + 1
        out.truncate(kept)
        try:
            if out.write(line) != len(line):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(file))
            os.fsync(out.fileno())
        except OSError:
            out.truncate(kept)
            raise
    if not whole:
        _sync_folder(file.parent)
    return [*lines[known.latest :], numbered]


def _sync_folder(folder: Path) -> None:
    """Flush the folder, so that the name of a new file is on disk too."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _parse(file: Path, whole: bytes) -> Quarantine:
    quarantine = Quarantine()
    for number, line in enumerate(whole.split(b"\n")[:-1], 1):
        try:
            quarantine.extend([QuarantineEntry.from_dict(parse_json(line))])
        except (ValueError, ProtocolError, CorpusError) as error:
            raise CorpusError(
                f"quarantine file {file}, line {number} is damaged ({error}); correct or delete the line"
            ) from error
    return quarantine

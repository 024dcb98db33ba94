"""Keep sequences and videos that crash or hang workers, in numbered snapshots, so that every stream can be made again.

A decode error depends only on the file's bytes: every worker meets it again, so it need not be remembered. A crash or a
hang may not happen again. It is written down, because otherwise the same stream could not be made a second time:

    snapshot 0      empty
    snapshot n + 1  snapshot n and one more entry, or empty (after a clearing)

An entry says that decoding a video brought a worker down, or that the work that one spec asks for took too long; the
latter counts under that spec only. An entry refuses one sequence of a video; a second entry for the same file refuses
the whole video. A file that has changed since (another fingerprint) is another file. The number of the snapshot that a
sample was made under is part of its provenance, and every snapshot stays available.

Several servers and a person may write to the file of one corpus at once. So only the file assigns numbers, under an
advisory lock, and only lines that are on disk count. The lines that a process has in memory are always the first lines
of the file.
"""

from __future__ import annotations

import errno
import json
import os
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

from v2v_protocol.errors import CorpusError, ProtocolError
from v2v_protocol.persisted import Persisted, parse_json
from v2v_protocol.write_aside import flush
from v2v_server.corpus.catalogue import index_path
from v2v_server.system.log import gauge, short, text
from v2v_server.system.process import locked, open_private

VERDICTS_PER_VIDEO = 2
_MOST_VERDICTS = 20
_LOCK_SECONDS = 2.0
"""Longest wait for the lock. Writers hold it for a moment, a process that was stopped for longer."""


@dataclass(frozen=True, slots=True)
class QuarantineEntry(Persisted):
    """One line of the quarantine.

    Attributes:
        snapshot: the first snapshot that holds it; 0 until it is written.
        path: catalogue id of the video; empty in a line that clears the quarantine.
        fingerprint: of the file.
        frame: first frame of the sequence.
        reason: what happened.
        time: when, ISO 8601, UTC.
        spec: digest of the only spec under which it refuses the sequence; empty: under every spec.
    """

    snapshot: int
    path: str
    fingerprint: str
    frame: int
    reason: str
    time: str
    spec: str = ""

    def __str__(self) -> str:
        if not self.path:
            return f"snapshot {self.snapshot} ({self.time}): cleared"
        only = f" (under spec {self.spec:.12} only)" if self.spec else ""
        return f"snapshot {self.snapshot} ({self.time}): {self.path} from frame {self.frame}: {self.reason}{only}"


@dataclass(frozen=True, slots=True)
class QuarantinePart:
    """The quarantine in the status."""

    quarantine_snapshot: int = gauge("Number of the newest quarantine snapshot.")
    quarantined: int = gauge("Quarantine entries in force.", "quarantined_sequences")


@dataclass(frozen=True, slots=True)
class VerdictPart:
    """One of the last quarantine entries in force, newest first."""

    snapshot: int = text("Snapshot that it began.")
    time: str = text("Time, ISO 8601, UTC.")
    video: str = text("Catalogue id of the video.")
    frame: int = text("First frame of the sequence.")
    reason: str = text("What happened.")


def clearing(time: str) -> QuarantineEntry:
    """Return the line that makes the next snapshot empty; older snapshots stay available."""
    return QuarantineEntry(0, "", "", 0, "cleared", time)


class Quarantine:
    """All snapshots, stored as the list of entries that led to them. Pure.

    Args:
        entries: the lines so far, oldest first.

    Raises:
        CorpusError: their numbers are not 1, 2, 3 ...
    """

    def __init__(self, entries: Iterable[QuarantineEntry] = ()) -> None:
        self._entries: list[QuarantineEntry] = []
        self._of_file: dict[tuple[str, str], list[QuarantineEntry]] = {}
        self._clearings: list[int] = []
        self.extend(entries)

    @property
    def latest(self) -> int:
        """Return the number of the newest snapshot."""
        return len(self._entries)

    @property
    def lines(self) -> tuple[QuarantineEntry, ...]:
        """Return all entries and clearings, oldest first."""
        return tuple(self._entries)

    def entries(self, snapshot: int) -> list[QuarantineEntry]:
        """Return the entries of a snapshot, oldest first.

        Raises:
            CorpusError: there is no such snapshot.
        """
        return self._entries[self._cleared(snapshot) : snapshot]

    def part(self) -> QuarantinePart:
        """Return what the status says of it."""
        return QuarantinePart(self.latest, len(self.entries(self.latest)))

    def verdict_parts(self) -> list[VerdictPart]:
        """Return the last few entries in force, newest first, for the status."""
        return [
            VerdictPart(each.snapshot, each.time, short(each.path), each.frame, short(each.reason))
            for each in reversed(self.entries(self.latest)[-_MOST_VERDICTS:])
        ]

    def refusal(self, snapshot: int, path: str, fingerprint: str, frame: int, spec: str = "") -> str | None:
        """Return why a sequence is refused under a snapshot; None if it is not.

        Args:
            snapshot: number of the snapshot.
            path, fingerprint: catalogue id and fingerprint of the video.
            frame: first frame of the sequence.
            spec: digest of the spec that the sequence is requested under.

        Raises:
            CorpusError: there is no such snapshot.
        """
        cleared = self._cleared(snapshot)
        of_file = (v for v in self._of_file.get((path, fingerprint), ()) if v.spec in ("", spec))
        against = [v for v in of_file if cleared < v.snapshot <= snapshot]
        if len(against) >= VERDICTS_PER_VIDEO:
            return f"video in quarantine snapshot {snapshot} ({len(against)} verdicts): {against[-1].reason}"
        for entry in against:
            if entry.frame == frame:
                return f"sequence in quarantine snapshot {snapshot}: {entry.reason}"
        return None

    def extend(self, entries: Iterable[QuarantineEntry]) -> None:
        """Append lines that have been written since.

        Raises:
            CorpusError: their numbers do not continue the existing ones.
        """
        for entry in entries:
            if entry.snapshot != self.latest + 1:
                raise CorpusError(f"quarantine: line {self.latest + 1} has snapshot number {entry.snapshot}")
            self._entries.append(entry)
            if entry.path:
                self._of_file.setdefault((entry.path, entry.fingerprint), []).append(entry)
            else:
                self._clearings.append(entry.snapshot)

    def _cleared(self, snapshot: int) -> int:
        """Return the number of the last empty snapshot up to this one."""
        if not 0 <= snapshot <= self.latest:
            raise CorpusError(f"quarantine snapshot {snapshot}: there are 0 .. {self.latest}")
        return max((number for number in self._clearings if number <= snapshot), default=0)


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
    with (
        locked(file.with_suffix(".lock"), wait_seconds),
        open(open_private(file, os.O_RDWR | os.O_APPEND | os.O_CREAT), "a+b", buffering=0) as out,
    ):
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
        flush(file.parent)  # with the name of the new file
    return [*lines[known.latest :], numbered]


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

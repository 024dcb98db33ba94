"""The quarantine: sequences and videos that crash or hang workers, in numbered snapshots.

A decode error is a function of the file's bytes: whoever decodes it meets it again, so nothing need be remembered. A
crash or a hang is not. Its verdict is written down, because without it nobody could make the same stream again:

    snapshot 0      empty
    snapshot n + 1  snapshot n and one verdict more, or nothing (after a clearing)

A verdict says that decoding a video brought a worker down, or that what one spec asks of it took too long; the latter
counts under that spec only. It refuses one sequence of a video; a second verdict on the same file refuses the whole
video. A file that has changed since (another fingerprint) is another file. The number of the snapshot that a sample was
made under is part of its provenance, and every snapshot can be asked for again.

Several servers and a person may write to the quarantine of one corpus at once, so only the file gives numbers, under an
advisory lock, and only lines that are on disk count. What a process has in memory is always a beginning of the file.
"""

from __future__ import annotations

import errno
import fcntl
import json
import os
import time
from collections.abc import Iterable
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from v2v_protocol.errors import CorpusError
from v2v_protocol.safe_json import parse_json
from v2v_server.catalogue.refresh import index_path
from v2v_server.system.private import open_private

VERDICTS_PER_VIDEO = 2
_LOCK_SECONDS = 2.0


@dataclass(frozen=True, slots=True)
class Verdict:
    """One line of the quarantine.

    Attributes:
        snapshot: the first snapshot it is in; 0 until it is written down.
        path: catalogue id of the video; empty in a line that clears everything.
        fingerprint: of the file.
        frame: first frame of the sequence.
        reason: what happened.
        time: when, ISO 8601, UTC.
        spec: digest of the only spec under which it refuses; empty: under any.
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


def clearing(time: str) -> Verdict:
    """The line that makes the next snapshot an empty one; the old ones can still be asked for."""
    return Verdict(0, "", "", 0, "cleared", time)


class Quarantine:
    """All snapshots, as the list of verdicts they grew by.

    Args:
        verdicts: the lines so far, oldest first.

    Raises:
        CorpusError: their numbers are not 1, 2, 3 ...
    """

    def __init__(self, verdicts: Iterable[Verdict] = ()) -> None:
        self._verdicts: list[Verdict] = []
        self._of_file: dict[tuple[str, str], list[Verdict]] = {}
        self._clearings: list[int] = []
        self.extend(verdicts)

    @property
    def latest(self) -> int:
        """Number of the newest snapshot."""
        return len(self._verdicts)

    @property
    def lines(self) -> tuple[Verdict, ...]:
        """Every verdict and clearing there ever was, oldest first."""
        return tuple(self._verdicts)

    def verdicts(self, snapshot: int) -> list[Verdict]:
        """What snapshot number ``snapshot`` holds, oldest first.

        Raises:
            CorpusError: there is no such snapshot.
        """
        return self._verdicts[self._cleared(snapshot) : snapshot]

    def refusal(self, snapshot: int, path: str, fingerprint: str, frame: int, spec: str = "") -> str | None:
        """Why a sequence is refused under a snapshot; None when it is not.

        Args:
            snapshot: its number.
            path, fingerprint: of the video.
            frame: first frame of the sequence.
            spec: digest of the spec it is asked under.

        Raises:
            CorpusError: there is no such snapshot.
        """
        cleared = self._cleared(snapshot)
        of_file = (v for v in self._of_file.get((path, fingerprint), ()) if v.spec in ("", spec))
        against = [v for v in of_file if cleared < v.snapshot <= snapshot]
        if len(against) >= VERDICTS_PER_VIDEO:
            return f"video in quarantine snapshot {snapshot} ({len(against)} verdicts): {against[-1].reason}"
        for verdict in against:
            if verdict.frame == frame:
                return f"sequence in quarantine snapshot {snapshot}: {verdict.reason}"
        return None

    def extend(self, verdicts: Iterable[Verdict]) -> None:
        """Takes up what was written down since.

        Raises:
            CorpusError: their numbers do not go on where ours end.
        """
        for verdict in verdicts:
            if verdict.snapshot != self.latest + 1:
                raise CorpusError(f"quarantine: line {self.latest + 1} has snapshot number {verdict.snapshot}")
            self._verdicts.append(verdict)
            if verdict.path:
                self._of_file.setdefault((verdict.path, verdict.fingerprint), []).append(verdict)
            else:
                self._clearings.append(verdict.snapshot)

    def _cleared(self, snapshot: int) -> int:
        """Number of the last empty snapshot up to this one."""
        if not 0 <= snapshot <= self.latest:
            raise CorpusError(f"quarantine snapshot {snapshot}: there are 0 .. {self.latest}")
        return max((number for number in self._clearings if number <= snapshot), default=0)


def quarantine_path(root: str | os.PathLike[str], cache_dir: str | os.PathLike[str] | None) -> Path:
    """The file of a corpus's quarantine: beside the catalogue's index."""
    index = index_path(root, cache_dir)
    return index.with_name(index.name.replace("catalogue-", "quarantine-")).with_suffix(".jsonl")


def read_quarantine(file: Path) -> Quarantine:
    """The quarantine in a file of JSON lines; empty when there is no such file.

    A last line that was cut off (it is being written, or the host lost power meanwhile) is left out.

    Raises:
        CorpusError: the file cannot be read, or any other line is damaged.
    """
    try:
        return _parse(file, file.read_bytes())
    except FileNotFoundError:
        return Quarantine()
    except OSError as error:
        raise CorpusError(f"quarantine file {file} cannot be read: {error.strerror}; give read access") from error


def write_verdict(
    file: Path, verdict: Verdict, known: Quarantine, wait_seconds: float = _LOCK_SECONDS
) -> list[Verdict]:
    """Gives a verdict the next number and has it on disk before anybody is served under the new snapshot.

    Args:
        file: of the quarantine; made when it is missing.
        verdict: to be written; its number is not looked at.
        known: what the caller has read or written so far.
        wait_seconds: how long to try to lock the file.

    Returns:
        every line that ``known`` lacks, to extend it by: others' first, then this one.

    Raises:
        BlockingIOError: another process has locked it.
        OSError: it cannot be written.
        CorpusError: the file is damaged, or another one than ``known`` came from.
    """
    file.parent.mkdir(parents=True, exist_ok=True)
    descriptor = open_private(file, os.O_RDWR | os.O_APPEND | os.O_CREAT)
    with open(descriptor, "a+b", buffering=0) as out:
        _lock(descriptor, file, wait_seconds)  # until the file is closed
        out.seek(0)
        whole = out.readall()
        lines = _parse(file, whole).lines
        if lines[: known.latest] != known.lines:
            raise CorpusError(
                f"quarantine file {file} is not the one that was read: it has {len(lines)} lines, and not the "
                f"{known.latest} known here at its beginning; start again whatever uses it"
            )
        numbered = replace(verdict, snapshot=len(lines) + 1)
        line = json.dumps(asdict(numbered)).encode() + b"\n"
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


def _lock(descriptor: int, file: Path, wait_seconds: float) -> None:
    """Lock the file. Writers hold the lock for a moment, a process that was stopped for longer.

    Raises:
        BlockingIOError: another process has locked it.
    """
    until = time.monotonic() + wait_seconds
    while True:
        try:
            return fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            if time.monotonic() >= until:
                raise BlockingIOError(errno.EAGAIN, "another process keeps it locked; end that process", file) from None
            time.sleep(0.01)


def _sync_folder(folder: Path) -> None:
    """Has the name of a new file on disk too."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _parse(file: Path, whole: bytes) -> Quarantine:
    quarantine = Quarantine()
    for number, line in enumerate(whole.split(b"\n")[:-1], 1):
        try:
            quarantine.extend([_verdict(parse_json(line))])
        except (ValueError, TypeError, CorpusError) as error:
            raise CorpusError(
                f"quarantine file {file}, line {number} is damaged ({error}); mend or delete it"
            ) from error
    return quarantine


def _verdict(fields: dict[str, object]) -> Verdict:
    verdict = Verdict(**fields)  # type: ignore[arg-type]
    for name, value in asdict(verdict).items():
        expected = int if name in ("snapshot", "frame") else str
        if type(value) is not expected:
            raise TypeError(f"{name} = {value!r}: expected {expected.__name__}")
    return verdict

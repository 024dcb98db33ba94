"""The quarantine: sequences and videos that crash or hang workers, in numbered snapshots.

A decode error is a function of the file's bytes: whoever decodes it meets it again, so nothing need be remembered. A
crash or a hang is not. Its verdict is written down, because without it nobody could make the same stream again:

    snapshot 0      empty
    snapshot n + 1  snapshot n and one verdict more, or nothing (after a clearing)

A verdict refuses one sequence of a video; a second verdict on the same file refuses the whole video. A file that has
changed since (another fingerprint) is another file. The number of the snapshot that a sample was made under is part of
its provenance, and every snapshot can be asked for again.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path

from v2v_protocol.errors import CorpusError

VERDICTS_PER_VIDEO = 2


@dataclass(frozen=True, slots=True)
class Verdict:
    """One line of the quarantine.

    Attributes:
        snapshot: the first snapshot it is in.
        path: catalogue id of the video; empty in a line that clears everything.
        fingerprint: of the file.
        frame: first frame of the sequence.
        reason: what happened.
        time: when, ISO 8601, UTC.
    """

    snapshot: int
    path: str
    fingerprint: str
    frame: int
    reason: str
    time: str

    def __str__(self) -> str:
        if not self.path:
            return f"snapshot {self.snapshot} ({self.time}): cleared"
        return f"snapshot {self.snapshot} ({self.time}): {self.path} from frame {self.frame}: {self.reason}"


class Quarantine:
    """All snapshots, as the list of verdicts they grew by.

    Args:
        verdicts: the lines so far, oldest first.

    Raises:
        CorpusError: their numbers are not 1, 2, 3 ...
    """

    def __init__(self, verdicts: Iterable[Verdict] = ()) -> None:
        self._verdicts = list(verdicts)
        for number, verdict in enumerate(self._verdicts, 1):
            if verdict.snapshot != number:
                raise CorpusError(f"quarantine: line {number} has snapshot number {verdict.snapshot}")

    @property
    def latest(self) -> int:
        """Number of the newest snapshot."""
        return len(self._verdicts)

    def verdicts(self, snapshot: int) -> list[Verdict]:
        """What snapshot number ``snapshot`` holds, oldest first.

        Raises:
            CorpusError: there is no such snapshot.
        """
        if not 0 <= snapshot <= self.latest:
            raise CorpusError(f"quarantine snapshot {snapshot}: there are 0 .. {self.latest}")
        held: list[Verdict] = []
        for verdict in self._verdicts[:snapshot]:
            held = [*held, verdict] if verdict.path else []
        return held

    def refusal(self, snapshot: int, path: str, fingerprint: str, frame: int) -> str | None:
        """Why a sequence is refused under a snapshot; None when it is not.

        Raises:
            CorpusError: there is no such snapshot.
        """
        against = [v for v in self.verdicts(snapshot) if v.path == path and v.fingerprint == fingerprint]
        if len(against) >= VERDICTS_PER_VIDEO:
            return f"video in quarantine snapshot {snapshot} ({len(against)} verdicts): {against[-1].reason}"
        for verdict in against:
            if verdict.frame == frame:
                return f"sequence in quarantine snapshot {snapshot}: {verdict.reason}"
        return None

    def add(self, path: str, fingerprint: str, frame: int, reason: str, time: str) -> Verdict:
        """A new snapshot with one verdict more; returns the line to write down."""
        return self._append(Verdict(self.latest + 1, path, fingerprint, frame, reason, time))

    def clear(self, time: str) -> Verdict:
        """A new, empty snapshot; the old ones can still be asked for. Returns the line to write down."""
        return self._append(Verdict(self.latest + 1, "", "", 0, "cleared", time))

    def _append(self, verdict: Verdict) -> Verdict:
        self._verdicts.append(verdict)
        return verdict


def read_quarantine(file: Path) -> Quarantine:
    """The quarantine in a file of JSON lines; empty when there is no such file.

    A last line that was cut off (the host lost power while it was written) is left out.

    Raises:
        CorpusError: the file cannot be read, or any other line is damaged.
    """
    try:
        lines = file.read_text(encoding="utf-8").splitlines(keepends=True)
    except FileNotFoundError:
        return Quarantine()
    except (OSError, UnicodeDecodeError) as error:
        raise CorpusError(f"quarantine file {file} cannot be read: {error}; mend or delete it") from error
    verdicts = []
    for number, line in enumerate(lines, 1):
        if number == len(lines) and not line.endswith("\n"):
            break
        try:
            verdicts.append(Verdict(**json.loads(line)))
        except (ValueError, TypeError) as error:
            raise CorpusError(
                f"quarantine file {file}, line {number} is damaged ({error}); mend or delete it"
            ) from error
    return Quarantine(verdicts)


def write_verdict(file: Path, verdict: Verdict) -> None:
    """Appends one line and has it on disk before anybody is served under the new snapshot.

    Raises:
        OSError: it cannot be written.
    """
    file.parent.mkdir(parents=True, exist_ok=True)
    whole = file.read_bytes() if file.exists() else b""
    kept = whole[: whole.rfind(b"\n") + 1]
    with open(file, "r+b" if whole else "wb") as out:
        out.seek(len(kept))
        out.write(json.dumps(asdict(verdict)).encode() + b"\n")
        out.truncate()
        out.flush()
        os.fsync(out.fileno())

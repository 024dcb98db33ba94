"""The log of a consumer that is killed and resumed, and its order compared with the schedule.

A consumer appends one JSON object a line to its log:

    {"kind": "life", "committed": n, "at": t}               a start, from a state after n batches
    {"kind": "batch", "number": n, "epoch": e, "at": t,     batch number n, counted over all lives, was yielded
     "wait": s, "samples": [...]}

A batch is logged after it was yielded, and its ``resume_state`` is saved only after that (atomically, with n + 1; not
after every batch). So a state never covers a batch that is not in the log, and a state cannot hide a loss. Batches that
were logged but not saved are repeated: the next life says from which number it continues, and all earlier lines from
that number on are void. The other batches, the *committed* ones, must be exactly the schedule. The bytes of void lines
are checked like all others.

The schedule of a single rank is (e, 0), (e, 1) ... (e, b floor(N / b) - 1), (e + 1, 0) ...
"""

from __future__ import annotations

import hashlib
import json
import os
from bisect import bisect_right
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from v2v_client.loadtest import ScheduleCheck
from v2v_protocol.errors import UsageError
from v2v_protocol.sample import Provenance, Refusal


@dataclass(frozen=True, slots=True)
class Sighting:
    """One sample as a consumer received it.

    Attributes:
        index: global index.
        digest: see :func:`digest`.
        video, start_frame, candidate, refusals, quarantine: of its provenance.
    """

    index: int
    digest: str
    video: str
    start_frame: int
    candidate: int
    refusals: tuple[Refusal, ...] = ()
    quarantine: int = 0


@dataclass(frozen=True, slots=True)
class BatchLine:
    """A batch was yielded.

    Attributes:
        number: of the batch, counted over all lives of the consumer.
        epoch: of the samples.
        at: time, seconds of the host's monotonic clock, which all processes share.
        wait: seconds that the consumer waited for it.
        samples: in the order of the batch.
    """

    number: int
    epoch: int
    at: float
    wait: float
    samples: tuple[Sighting, ...]


@dataclass(frozen=True, slots=True)
class LifeLine:
    """The consumer started.

    Attributes:
        committed: batches that the state it starts from covers.
        at: time, as of a batch.
    """

    committed: int
    at: float


Line = BatchLine | LifeLine


def digest(arrays: Mapping[str, npt.NDArray[Any]], provenance: Provenance) -> str:
    """Return the SHA-256 of all bytes of a sample and of its provenance, except for where its pixels were read."""
    told = provenance.to_dict()
    told["decoder"] = told["decoder"].partition(", from the ")[0]
    sha = hashlib.sha256(json.dumps(told, sort_keys=True).encode())
    for name in sorted(arrays):
        sha.update(name.encode())
        sha.update(np.ascontiguousarray(arrays[name]).data)
    return sha.hexdigest()


def sighting(arrays: Mapping[str, npt.NDArray[Any]], provenance: Provenance) -> Sighting:
    """Return what a log keeps of a sample."""
    return Sighting(
        index=provenance.id.index,
        digest=digest(arrays, provenance),
        video=provenance.video,
        start_frame=provenance.start_frame,
        candidate=provenance.candidate,
        refusals=provenance.refusals,
        quarantine=provenance.quarantine,
    )


class LogWriter:
    """Append to a log, one write a line, so that a SIGKILL tears at most the last line.

    A torn last line of an earlier life is cut off: no state covers it.
    """

    def __init__(self, path: Path) -> None:
        self._descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_APPEND, 0o644)
        content = path.read_bytes()
        os.ftruncate(self._descriptor, content.rfind(b"\n") + 1)

    def append(self, line: Line) -> None:
        """Write one line."""
        kind = "life" if isinstance(line, LifeLine) else "batch"
        os.write(self._descriptor, json.dumps({"kind": kind, **asdict(line)}).encode() + b"\n")

    def close(self) -> None:
        """Close the file."""
        os.close(self._descriptor)


def read_log(path: Path) -> Iterator[Line]:
    """Yield the lines of a log, except for a torn last one.

    Raises:
        UsageError: another line cannot be read.
    """
    with path.open("rb") as file:
        for number, text in enumerate(file, 1):
            if not text.endswith(b"\n"):
                return
            try:
                yield _line(json.loads(text))
            except (ValueError, KeyError, TypeError) as error:
                raise UsageError(f"{path}: line {number} cannot be read: {error}") from error


def _line(values: dict[str, Any]) -> Line:
    if values.pop("kind") == "life":
        return LifeLine(**values)
    samples = tuple(
        Sighting(**sample | {"refusals": tuple(Refusal(**item) for item in sample["refusals"])})
        for sample in values.pop("samples")
    )
    return BatchLine(**values, samples=samples)


@dataclass(slots=True)
class OrderVerdict:
    """One consumer's log compared with the schedule.

    Attributes:
        samples: in committed batches.
        repeated: in void batches, which are delivered again, as they must.
        lost: samples missing before the furthest one that was delivered.
        duplicated: committed samples delivered more than once.
        foreign: committed samples outside every epoch.
        out_of_order: committed samples that do not follow their predecessor.
        broken_lives: lives that do not continue where their state says.
        lives: starts of the consumer.
    """

    samples: int = 0
    repeated: int = 0
    lost: int = 0
    duplicated: int = 0
    foreign: int = 0
    out_of_order: int = 0
    broken_lives: int = 0
    lives: int = 0

    @property
    def faultless(self) -> bool:
        """Return whether each sample came once, in order."""
        return not (self.lost or self.duplicated or self.foreign or self.out_of_order or self.broken_lives)


def check_order(lines: Iterable[Line], *, sequences: int, batch_size: int, first_epoch: int = 0) -> OrderVerdict:
    """Compare a log with the schedule.

    Args:
        lines: the log.
        sequences: N, sequences of an epoch, computed from the corpus and the spec alone.
        batch_size: b.
        first_epoch: of the first life.
    """
    verdict = OrderVerdict()
    committed: list[BatchLine] = []
    for line in lines:
        if isinstance(line, LifeLine):
            verdict.lives += 1
            if line.committed > len(committed):
                verdict.broken_lives += 1
            for void in committed[line.committed :]:
                verdict.repeated += len(void.samples)
            del committed[line.committed :]
            continue
        if line.number != len(committed):
            verdict.broken_lives += 1
        committed.append(line)
    check = ScheduleCheck(sequences, batch_size, first_epoch)
    for batch in committed:
        verdict.samples += len(batch.samples)
        check.observe(batch.epoch, (sample.index for sample in batch.samples))
    verdict.lost, verdict.duplicated = check.lost, check.duplicated
    verdict.foreign, verdict.out_of_order = check.foreign, check.out_of_order
    return verdict


@dataclass(slots=True)
class Sightings:
    """All samples of all consumers and lives, by identity.

    Attributes:
        samples: number of sightings.
        contradictions: sightings whose bytes differ from an earlier one of the same identity and candidate.
        digests: first digest seen, by (stream, epoch, sighting without digest).
    """

    samples: int = 0
    contradictions: int = 0
    digests: dict[tuple[str, int, Sighting], str] = field(default_factory=dict)

    def add(self, stream: str, batch: BatchLine) -> None:
        """Add a logged batch of a stream (a name for spec and seed)."""
        for sample in batch.samples:
            self.samples += 1
            key = (stream, batch.epoch, replace(sample, digest=""))
            if self.digests.setdefault(key, sample.digest) != sample.digest:
                self.contradictions += 1


@dataclass(frozen=True, slots=True)
class Kill:
    """A process that was ended, or stopped for good, on purpose.

    Attributes:
        kind: process and signal, for example "server-kill".
        at: when the signal was sent.
        consumer: number of the killed consumer; None for a process of the server's side.
        ready_at: for a server, when the next one was ready; else the time of the kill.
    """

    kind: str
    at: float
    consumer: int | None
    ready_at: float


def recovery_seconds(kill: Kill, batches_at: Sequence[Sequence[float]]) -> float | None:
    """Return the time from a kill until the killed consumer, or else every consumer, has its next batch.

    After a kill of the server only batches after ``ready_at`` count, because consumers still hold some.

    Args:
        kill: the kill.
        batches_at: for each consumer, when its batches were yielded, ascending.

    Returns:
        seconds; None when one of these consumers never got another batch.
    """
    recovered = kill.at
    for number in range(len(batches_at)) if kill.consumer is None else (kill.consumer,):
        times = batches_at[number]
        place = bisect_right(times, kill.ready_at)
        if place == len(times):
            return None
        recovered = max(recovered, times[place])
    return recovered - kill.at

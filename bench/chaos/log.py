"""What the consumers of the chaos test write down, and what must be true of it. Pure but for reading and writing files.

A consumer appends to its log, one JSON object a line:

    {"kind": "life", "life": k, "committed": n, "at": t}    it started for the k-th time, from a state after n batches
    {"kind": "batch", "number": n, "epoch": e, "at": t,     batch number n (counted over all lives) was yielded
     "wait": s, "samples": [...]}

**Order.** A batch is logged after it was yielded, and only then its ``resume_state`` is saved (atomically, together
with n + 1; not after every batch). So a state never covers a batch that is not in the log, and nothing that was lost
can hide behind a state. What was logged but not yet covered by a state when the consumer died comes again: the next
life says from which number it goes on, and every earlier line from that number on is void. The rest, the *committed*
batches, must be the schedule, exactly: that is what exactly once relative to the committed state means, and it needs no
tolerance. The void lines are checked byte for byte like all others.

The schedule of a rank of one is (e, 0), (e, 1) ... (e, b floor(N / b) - 1), (e + 1, 0) ...
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

from v2v_client.tools.schedule_check import ScheduleCheck
from v2v_protocol.errors import UsageError
from v2v_protocol.refusal import Refusal
from v2v_protocol.sample import Provenance


@dataclass(frozen=True, slots=True)
class Sighting:
    """One sample as a consumer got it.

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
        at: when, seconds of the host's monotonic clock, which all its processes share.
        wait: how long the consumer had waited for it, seconds.
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
        life: how many lives it had before.
        committed: batches that the state it starts from covers.
        at: when.
    """

    life: int
    committed: int
    at: float


Line = BatchLine | LifeLine


def digest(arrays: Mapping[str, npt.NDArray[Any]], provenance: Provenance) -> str:
    """SHA-256 of all bytes of a sample, and of its provenance but for where its pixels were read."""
    told = provenance.to_dict()
    told["decoder"] = told["decoder"].partition(", from the ")[0]
    sha = hashlib.sha256(json.dumps(told, sort_keys=True).encode())
    for name in sorted(arrays):
        sha.update(name.encode())
        sha.update(np.ascontiguousarray(arrays[name]).data)
    return sha.hexdigest()


def sighting(arrays: Mapping[str, npt.NDArray[Any]], provenance: Provenance) -> Sighting:
    """What to log of a sample."""
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
    """Appends to a log; every line is one write, so that a SIGKILL tears at most the last one.

    Args:
        path: the log. A torn last line of an earlier life is cut off: no state covers it.
    """

    def __init__(self, path: Path) -> None:
        self._descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_APPEND, 0o644)
        content = path.read_bytes()
        os.ftruncate(self._descriptor, content.rfind(b"\n") + 1)

    def append(self, line: Line) -> None:
        """Writes one line."""
        kind = "life" if isinstance(line, LifeLine) else "batch"
        os.write(self._descriptor, json.dumps({"kind": kind, **asdict(line)}).encode() + b"\n")

    def close(self) -> None:
        """Closes the file."""
        os.close(self._descriptor)


def read_log(path: Path) -> Iterator[Line]:
    """The lines of a log; a torn last one is left out.

    Raises:
        UsageError: a line in its midst that is none.
    """
    with path.open("rb") as file:
        for number, text in enumerate(file, 1):
            if not text.endswith(b"\n"):
                return
            try:
                yield _line(json.loads(text))
            except (ValueError, KeyError, TypeError) as error:
                raise UsageError(f"{path}: line {number} is no line of a chaos log: {error}") from error


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
    """What the schedule says of one consumer's log.

    Attributes:
        samples: in committed batches.
        repeated: in void batches: they came again, as they must.
        lost: samples that should have come before the furthest one that did.
        duplicated: committed samples that came again.
        foreign: committed samples that are in no epoch.
        out_of_order: committed samples that did not follow their predecessor.
        broken_lives: lives that did not go on where their state says.
        lives: how often the consumer was started.
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
        """Each sample once, in order."""
        return not (self.lost or self.duplicated or self.foreign or self.out_of_order or self.broken_lives)


def check_order(lines: Iterable[Line], *, sequences: int, batch_size: int, first_epoch: int = 0) -> OrderVerdict:
    """Compares a log with the schedule.

    Args:
        lines: the log.
        sequences: N, sequences of an epoch, computed from the corpus and the spec alone.
        batch_size: b.
        first_epoch: where the first life began.
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
    """All that was ever seen, by identity, over all consumers and lives.

    Attributes:
        samples: sightings in all.
        contradictions: sightings whose bytes differ from an earlier one of the same identity and candidate.
        digests: by (stream, epoch, sighting without digest), the digest seen first.
    """

    samples: int = 0
    contradictions: int = 0
    digests: dict[tuple[str, int, Sighting], str] = field(default_factory=dict)

    def add(self, stream: str, batch: BatchLine) -> None:
        """
        Args:
            stream: names spec and seed.
            batch: as logged.
        """
        for sample in batch.samples:
            self.samples += 1
            key = (stream, batch.epoch, replace(sample, digest=""))
            if self.digests.setdefault(key, sample.digest) != sample.digest:
                self.contradictions += 1


@dataclass(frozen=True, slots=True)
class Kill:
    """A process that was ended, or stopped for good, on purpose.

    Attributes:
        kind: who and how, "server-kill".
        at: when the signal was sent.
        consumer: the number of the consumer that was killed; None when it was a process of the server's side.
        ready_at: for the server, when the next one said it was ready; else the time of the kill.
    """

    kind: str
    at: float
    consumer: int | None
    ready_at: float


def recovery_seconds(kill: Kill, batches_at: Sequence[Sequence[float]]) -> float | None:
    """The time from a kill until everybody concerned was delivered to again.

    Concerned is the consumer that was killed, else all consumers; delivered to is a consumer when its next batch is
    yielded. After the server was killed only batches that came once the next one was ready count, because consumers
    still have some in hand.

    Args:
        kill: the kill.
        batches_at: for each consumer, when its batches were yielded, ascending.

    Returns:
        seconds; None when somebody concerned never got another batch.
    """
    concerned = range(len(batches_at)) if kill.consumer is None else (kill.consumer,)
    recovered = kill.at
    for number in concerned:
        times = batches_at[number]
        place = bisect_right(times, kill.ready_at)
        if place == len(times):
            return None
        recovered = max(recovered, times[place])
    return recovered - kill.at

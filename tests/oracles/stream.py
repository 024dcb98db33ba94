"""The oracle of a stream: what a consumer must receive, from corpus and spec alone, and its log compared with that.

    order      the committed batches are the schedule, see :mod:`tests.oracles.stream_log`
    place      every sample shows the video and first frame that the schedule gives for its candidate
    repeats    every sample seen twice (again after a kill, or by two consumers) is the same
    bytes      a random choice of samples, and every substituted one, is made again here

A worker that ends by SIGSEGV is blamed on the sample in work, by design, and the sample is made from its next
candidate. Such a sample counts as ``substituted``; it is made again from the candidate and the refusals that its
provenance states, and must be the same.
"""

from __future__ import annotations

import random
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from tests.oracles.stream_log import BatchLine, Line, OrderVerdict, Sighting, Sightings, check_order, sighting
from v2v_protocol.errors import VideoError
from v2v_protocol.sample import DEFAULT_ARRAYS
from v2v_protocol.spec import StreamSpec
from v2v_server.broker.leases import Request
from v2v_server.corpus.catalogue import Catalogue
from v2v_server.schedule import MOST_CANDIDATES, Schedule, SequenceTable, VideoSequence
from v2v_server.worker.job import SampleJob
from v2v_server.worker.making.make import make_sample
from v2v_server.worker.making.read import decode_for, open_sidecars
from v2v_tools.remake import lease_for, remake


@dataclass(frozen=True, slots=True)
class Profile:
    """What one consumer asks for, and how fast it is.

    Attributes:
        spec: fields of its stream's spec.
        seed, batch_size: of its stream.
        think_seconds: pause after each batch.
        save_every: batches between two saved states, as a trainer has steps between two checkpoints.
        arrays: of its samples.
    """

    spec: Mapping[str, Any]
    seed: int
    batch_size: int
    think_seconds: float = 0.0
    save_every: int = 1
    arrays: tuple[str, ...] = DEFAULT_ARRAYS

    @property
    def stream_spec(self) -> StreamSpec:
        """Return the resolved spec, which must not depend on the server's defaults."""
        return StreamSpec.from_dict(self.spec)

    @property
    def stream(self) -> str:
        """Return a name of the stream: equal names mean equal bytes."""
        return f"{self.stream_spec.digest}:{self.seed}"


@dataclass(frozen=True, slots=True)
class Seen:
    """One sample of one consumer."""

    asked: Profile
    epoch: int
    sample: Sighting


class StreamOracle:
    """What a consumer must receive, from corpus and spec alone."""

    def __init__(self, catalogue: Catalogue, asked: Profile) -> None:
        self._catalogue = catalogue
        self._asked = asked
        self._spec = asked.stream_spec
        self._schedule = Schedule(SequenceTable(catalogue.videos, catalogue.rows, self._spec), self._spec)
        self.sequences = self._schedule.count

    def sequence(self, epoch: int, index: int, candidate: int) -> VideoSequence:
        """Return the sequence of a sample's candidate."""
        return self._schedule.candidate(self._asked.seed, epoch, index, candidate)

    def in_place(self, epoch: int, sample: Sighting) -> bool:
        """Return whether the sample shows what the schedule gives for its candidate."""
        if not 0 <= sample.index < self.sequences or len(sample.refusals) != sample.candidate:
            return False
        if not 0 <= sample.candidate < MOST_CANDIDATES:
            return False
        sequence = self.sequence(epoch, sample.index, sample.candidate)
        return (sequence.video.id, sequence.start_frame) == (sample.video, sample.start_frame)

    def candidate(self, epoch: int, index: int) -> int:
        """Return the sample's candidate in a run without faults."""
        made = remake(self._catalogue, self._spec, seed=self._asked.seed, epoch=epoch, index=index)
        return made.provenance.candidate

    def again(self, epoch: int, sample: Sighting) -> Sighting:
        """Make the sample here, from the candidate and the refusals that were seen.

        Raises:
            VideoError: the candidate cannot be decoded.
        """
        lease = lease_for(
            Request(b"", epoch, sample.index, sample.candidate, sample.refusals, snapshot=sample.quarantine),
            sequence=self.sequence(epoch, sample.index, sample.candidate),
            catalogue=self._catalogue,
            spec=self._spec,
            seed=self._asked.seed,
            arrays=self._asked.arrays,
        )
        job, source = SampleJob.of(lease), self._catalogue.source
        with open_sidecars(job.clip, source) as sidecars:
            made = make_sample(job, decode_for(job.clip, lease.indices, source)[0], sidecars=sidecars)
        return sighting(made.arrays, made.provenance)


@dataclass(slots=True)
class Verdict:
    """The result of a check.

    Attributes:
        order: of each consumer.
        sightings: samples logged, void ones included.
        misplaced: samples of another video or frame than the schedule says.
        contradictions: samples that differ from an earlier sighting of the same.
        remade: samples made again here.
        wrong_bytes: those that differ.
        substituted: samples of a later candidate than in a run without faults.
    """

    order: list[OrderVerdict]
    sightings: int
    misplaced: int
    contradictions: int
    remade: int
    wrong_bytes: int
    substituted: int

    @property
    def mismatched(self) -> int:
        """Return the number of samples with wrong bytes."""
        return self.misplaced + self.contradictions + self.wrong_bytes

    def to_dict(self) -> dict[str, Any]:
        """Return the counts, summed over the consumers."""
        names = ("samples", "repeated", "lost", "duplicated", "foreign", "out_of_order", "broken_lives", "lives")
        summed = {name: sum(getattr(order, name) for order in self.order) for name in names}
        fields = ("sightings", "mismatched", "misplaced", "contradictions", "remade", "wrong_bytes", "substituted")
        return summed | {name: getattr(self, name) for name in fields}


def check(catalogue: Catalogue, logs: Sequence[tuple[Profile, Iterable[Line]]], *, remakes: int, seed: int) -> Verdict:
    """Check the logs of all consumers.

    Args:
        catalogue: the corpus.
        logs: profile and log of each consumer.
        remakes: samples to make again, besides the substituted ones.
        seed: of the choice.
    """
    sightings = Sightings()
    order, misplaced = [], 0
    candidates: list[Seen] = []
    late: list[Seen] = []
    oracles: dict[str, StreamOracle] = {}
    for asked, log in logs:
        lines = list(log)
        oracle = oracles.setdefault(asked.stream, StreamOracle(catalogue, asked))
        order.append(check_order(lines, sequences=oracle.sequences, batch_size=asked.batch_size))
        for line in lines:
            if isinstance(line, BatchLine):
                sightings.add(asked.stream, line)
                right = [sample for sample in line.samples if oracle.in_place(line.epoch, sample)]
                misplaced += len(line.samples) - len(right)
                candidates += [Seen(asked, line.epoch, sample) for sample in right]
                late += [Seen(asked, line.epoch, sample) for sample in right if sample.candidate]
    chosen = random.Random(seed).sample(candidates, min(remakes, len(candidates)))
    wrong_bytes = substituted = 0
    for seen in (*chosen, *late):
        try:
            again = oracles[seen.asked.stream].again(seen.epoch, seen.sample)
            wrong_bytes += seen.sample != again
        except VideoError:
            wrong_bytes += 1
    for seen in late:
        substituted += seen.sample.candidate > oracles[seen.asked.stream].candidate(seen.epoch, seen.sample.index)
    return Verdict(
        order=order,
        sightings=sightings.samples,
        misplaced=misplaced,
        contradictions=sightings.contradictions,
        remade=len(chosen) + len(late),
        wrong_bytes=wrong_bytes,
        substituted=substituted,
    )

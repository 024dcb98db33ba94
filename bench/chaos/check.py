"""The checker of the chaos test: a process of its own that reads the consumers' logs and compares them with the
schedule and with samples made in this process.

    python -m bench.chaos.check --videos DIR --cache-dir DIR --remakes 300 FOLDER...

prints one JSON object. FOLDER i is that of consumer i. What is compared:

    order      the committed batches are the schedule, see :mod:`bench.chaos.log`
    place      every sample shows the video and first frame that the schedule gives for its candidate
    repeats    every sample that was seen twice (again after a kill, or by two consumers) is the same
    bytes      a random choice of samples, and every substituted one, is made again here

A worker that is ended by SEGV is blamed on the sample in work, by design, and the sample is then made from its next
candidate. Such a sample counts as ``substituted``; it is made again from the candidate and with the refusals that its
provenance states, and has to be the same.
"""

from __future__ import annotations

import argparse
import json
import random
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bench.chaos.consumer import Profile, log_path, profile
from bench.chaos.log import BatchLine, Line, OrderVerdict, Sighting, Sightings, check_order, read_log, sighting
from v2v_protocol.errors import V2VError, VideoError
from v2v_server.broker.leases import Request
from v2v_server.broker.terms import lease_for
from v2v_server.catalogue.catalogue import Catalogue, open_catalogue
from v2v_server.offline.remake import remake
from v2v_server.schedule.epoch import MOST_CANDIDATES, Schedule
from v2v_server.schedule.sequences import SequenceTable, VideoSequence
from v2v_server.worker.produce import decode_for, make_sample


@dataclass(frozen=True, slots=True)
class Seen:
    """One sample of one consumer."""

    asked: Profile
    epoch: int
    sample: Sighting


class StreamOracle:
    """What a consumer must get, from corpus and spec alone.

    Args:
        catalogue: the corpus.
        asked: what the consumer asked for.
    """

    def __init__(self, catalogue: Catalogue, asked: Profile) -> None:
        self._catalogue = catalogue
        self._asked = asked
        self._spec = asked.stream_spec
        self._schedule = Schedule.of(SequenceTable(catalogue.videos, catalogue.rows, self._spec), self._spec)
        self.sequences = self._schedule.count

    def sequence(self, epoch: int, index: int, candidate: int) -> VideoSequence:
        """What a candidate of a sample is made from."""
        return self._schedule.candidate(self._asked.seed, epoch, index, candidate)

    def in_place(self, epoch: int, sample: Sighting) -> bool:
        """Whether the sample shows what the schedule gives for its candidate."""
        if not 0 <= sample.index < self.sequences or len(sample.refusals) != sample.candidate:
            return False
        if not 0 <= sample.candidate < MOST_CANDIDATES:
            return False
        sequence = self.sequence(epoch, sample.index, sample.candidate)
        return (sequence.video.id, sequence.start_frame) == (sample.video, sample.start_frame)

    def candidate(self, epoch: int, index: int) -> int:
        """The candidate that the sample is made from when no worker is ever blamed."""
        made = remake(self._catalogue, self._spec, seed=self._asked.seed, epoch=epoch, index=index)
        return made.provenance.candidate

    def again(self, epoch: int, sample: Sighting) -> Sighting:
        """The sample made here, from the candidate and with the refusals that were seen.

        Raises:
            VideoError: the candidate cannot give it.
        """
        lease = lease_for(
            Request(b"", epoch, sample.index, sample.candidate, sample.refusals, snapshot=sample.quarantine),
            sequence=self.sequence(epoch, sample.index, sample.candidate),
            catalogue=self._catalogue,
            spec=self._spec,
            seed=self._asked.seed,
            arrays=("voxels", "frames"),
        )
        made = make_sample(lease, decode_for(lease, lease.indices, self._catalogue.folder)[0])
        return sighting(made.arrays, made.provenance)


@dataclass(slots=True)
class Verdict:
    """All that was found.

    Attributes:
        order: of each consumer.
        sightings: samples logged, void ones included.
        misplaced: samples that show another video or frame than the schedule says.
        contradictions: samples that differ from an earlier sighting of the same.
        remade: samples made again here.
        wrong_bytes: those of them that were not the same.
        substituted: samples that came from a later candidate than they would undisturbed.
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
        """Everything whose bytes are not what they must be."""
        return self.misplaced + self.contradictions + self.wrong_bytes

    def to_dict(self) -> dict[str, Any]:
        """The counts, summed over the consumers."""
        names = ("samples", "repeated", "lost", "duplicated", "foreign", "out_of_order", "broken_lives", "lives")
        summed = {name: sum(getattr(order, name) for order in self.order) for name in names}
        fields = ("sightings", "mismatched", "misplaced", "contradictions", "remade", "wrong_bytes", "substituted")
        return summed | {name: getattr(self, name) for name in fields}


def check(catalogue: Catalogue, logs: Sequence[tuple[Profile, Iterable[Line]]], *, remakes: int, seed: int) -> Verdict:
    """Checks the logs of all consumers.

    Args:
        catalogue: the corpus, taken in by this process.
        logs: what each consumer asked for, and its log.
        remakes: how many samples to make again, besides those that were substituted.
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


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line. Returns the exit status: 0 checked (whatever was found), 2 it could not be."""
    first = (__doc__ or "").split("\n\n")[0]
    parser = argparse.ArgumentParser(prog="python -m bench.chaos.check", description=first)
    parser.add_argument("folders", nargs="+", type=Path, metavar="FOLDER", help="of each consumer")
    parser.add_argument("--videos", required=True, type=Path)
    parser.add_argument("--cache-dir", type=Path, help="of the catalogue index")
    parser.add_argument("--remakes", type=int, default=300, help="samples to make again (default 300)")
    parser.add_argument("--seed", type=int, default=0, help="of the choice of samples")
    asked = parser.parse_args(arguments)
    try:
        catalogue = open_catalogue(asked.videos, cache_dir=asked.cache_dir)
        try:
            logs = [(profile(number), read_log(log_path(folder))) for number, folder in enumerate(asked.folders)]
            verdict = check(catalogue, logs, remakes=asked.remakes, seed=asked.seed)
        finally:
            catalogue.close()
    except (V2VError, OSError) as error:
        print(f"chaos_check: {type(error).__name__}: {error}", file=sys.stderr)
        return 2
    print(json.dumps(verdict.to_dict()))
    return 0


if __name__ == "__main__":
    sys.exit(main())

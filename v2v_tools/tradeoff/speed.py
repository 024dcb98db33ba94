"""Processor seconds of a server worker for a sample, all settings in turns.

A place is a sequence of the corpus with four views (``samples_per_decode`` 4, next to each other). A setting of K
samples per decode makes views 0 and 2, or 0 and 1 then 2 and 3, or all four at once: the same cameras for every K,
as far as possible.
"""

from __future__ import annotations

import dataclasses
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from v2v_protocol.errors import UsageError
from v2v_protocol.messages import Lease
from v2v_protocol.sample import DEFAULT_ARRAYS, Sample
from v2v_protocol.spec import StreamSpec
from v2v_server.broker.leases import Request
from v2v_server.corpus.catalogue import Catalogue
from v2v_server.corpus.sources.folder import Folder
from v2v_server.schedule import Schedule, SequenceTable
from v2v_server.worker.produce import decode_for, make_sample
from v2v_tools.remake import lease_for

VIEWS = 4
_GROUPS = {1: ((0,), (2,)), 2: ((0, 1), (2, 3)), 4: ((0, 1, 2, 3),)}


@dataclass(frozen=True, slots=True)
class TimedWork:
    """What is timed for one setting.

    Attributes:
        do: the work for one place, 0 .. places - 1.
        places: their number; the same for all that are measured together.
        samples: made by one call.
    """

    do: Callable[[int], object]
    places: int
    samples: int = 1


def making(root: Path, leases: Sequence[Lease], samples_per_decode: int = 1) -> TimedWork:
    """Return the work of a server worker.

    Args:
        root: folder of the videos.
        leases: one for each place, of its four views (:func:`leases_of`).
        samples_per_decode: 1, 2 or 4.
    """
    groups = _GROUPS[samples_per_decode]

    def do(place: int) -> None:
        lease = leases[place]
        for views in groups:
            make(lease, [lease.indices[view] for view in views], root)

    return TimedWork(do, len(leases), sum(map(len, groups)))


@dataclass(frozen=True, slots=True)
class Speed:
    """Processor seconds of a sample.

    Attributes:
        fastest: mean over the places of each one's fastest round: what the code costs.
        median: over the rounds; other load on the machine shows in it.
        rounds: their number.
    """

    fastest: float
    median: float
    rounds: int


def leases_of(catalogue: Catalogue, spec: StreamSpec, places: int) -> tuple[Lease, ...]:
    """Return the leases of at most ``places`` places, spread over the corpus in its order; seed 0, epoch 0."""
    spec = dataclasses.replace(spec, samples_per_decode=VIEWS, sibling_spacing=1, shuffle=False)
    table = SequenceTable(catalogue.videos, catalogue.rows, spec)
    schedule = Schedule(table, spec)
    count = min(places, table.count)
    made = []
    for place in (number * table.count // count for number in range(count)):
        index, *siblings = range(place * VIEWS, (place + 1) * VIEWS)
        made.append(
            lease_for(
                Request(b"", 0, index), sequence=schedule.candidate(0, 0, index, 0),
                catalogue=catalogue, spec=spec, seed=0, arrays=DEFAULT_ARRAYS, siblings=tuple(siblings),
            )
        )  # fmt: skip
    return tuple(made)


def make(lease: Lease, indices: Sequence[int], root: Path) -> list[Sample]:
    """Make the samples of some of a lease's indices, from one decode."""
    decoded = decode_for(lease, indices, Folder(root))
    return [
        make_sample(dataclasses.replace(lease, indices=(index,)), one)
        for index, one in zip(indices, decoded, strict=True)
    ]


def measure(works: Mapping[str, TimedWork], *, until: float) -> dict[str, Speed]:
    """Do all works in turns, place by place, every other round in reverse order; one round at least.

    Args:
        works: by name, all with the same number of places.
        until: reading of ``time.monotonic``; a round that would not end by then does not begin.

    Raises:
        UsageError: no works, or different numbers of places.
    """
    places = {work.places for work in works.values()}
    if len(places) != 1:
        raise UsageError(f"works of {sorted(places)} places: give one number of places")
    seconds: dict[str, list[list[float]]] = {name: [] for name in works}
    for work in works.values():
        work.do(0)  # files into memory, code compiled
    rounds, longest = 0, 0.0
    while not rounds or time.monotonic() + longest < until:
        started = time.monotonic()
        for taken in seconds.values():
            taken.append([])
        order = list(works) if rounds % 2 == 0 else list(works)[::-1]
        for place in range(max(places)):
            for name in order:
                begun = time.process_time()
                works[name].do(place)
                seconds[name][-1].append((time.process_time() - begun) / works[name].samples)
        rounds += 1
        longest = max(longest, time.monotonic() - started)
    return {
        name: Speed(
            statistics.mean(min(of_place) for of_place in zip(*taken, strict=True)),
            statistics.median(map(statistics.mean, taken)),
            rounds,
        )
        for name, taken in seconds.items()
    }

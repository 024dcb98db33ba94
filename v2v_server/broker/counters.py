"""Count what the server does. The dispatcher counts; all other parts only read."""

from __future__ import annotations

from dataclasses import dataclass, field

from v2v_protocol.messages import Result

_LONGEST_TROUBLE = 120
_MOST_SECONDS = 86_400.0


@dataclass(slots=True)
class WorkDone:
    """Totals of the time that samples took, as reported by the workers.

    Attributes:
        samples: number of samples.
        cpu_seconds: processor time.
        decode_seconds, simulate_seconds, handover_seconds: wall-clock time for decoding clips, for building the arrays,
            and for delivering them to their consumers.
    """

    samples: int = 0
    cpu_seconds: float = 0.0
    decode_seconds: float = 0.0
    simulate_seconds: float = 0.0
    handover_seconds: float = 0.0

    def add(self, result: Result, cpu_seconds: float) -> None:
        """Add one sample."""
        self.samples += 1
        self.cpu_seconds += bounded_seconds(cpu_seconds)
        self.decode_seconds += bounded_seconds(result.decode_seconds)
        self.simulate_seconds += bounded_seconds(result.simulate_seconds)
        self.handover_seconds += bounded_seconds(result.handover_seconds)

    @property
    def busy_seconds(self) -> float:
        """Wall-clock time of all three parts."""
        return self.decode_seconds + self.simulate_seconds + self.handover_seconds


def bounded_seconds(said: float) -> float:
    """Clip a duration that a worker reported to a plausible range: 0 to one day, seconds."""
    return min(max(said, 0.0), _MOST_SECONDS)


@dataclass(slots=True)
class Counters:
    """Totals since the start.

    Attributes:
        samples: samples sent to consumers.
        batches: the same in batches of each consumer's own size (a fraction while one is filling).
        decodes: clips decoded for those samples; fewer than samples if siblings share one.
        cache_hits, cache_misses: of those clips, if workers have a cache.
        cache_trouble: why a worker's cache stores nothing more, as last reported; empty if it does.
        bytes: size of the arrays of those samples.
        in_slots: samples written to memory shared with their consumer; the others travelled in messages.
        work: time that the workers took for them.
        queued_seconds: total time that the server's own workers waited for a core.
        waited_seconds: total time that consumers have waited for samples, as they report.
        refused_candidates: videos passed over because they could not be used.
        unavailable: samples without a usable candidate.
        returned_leases: leases taken back from workers that died, hung or left.
        second_leases: samples given to a second worker because the first was slow.
        late_results: results of leases that had been taken back.
        workers_lost: workers that died or were given up.
        missing_videos: leases whose worker could not read a video that the server's host has.
        malformed: malformed messages received.
    """

    samples: int = 0
    batches: float = 0.0
    decodes: int = 0
    cache_hits: int = 0
    cache_misses: int = 0
    cache_trouble: str = ""
    bytes: int = 0
    in_slots: int = 0
    work: WorkDone = field(default_factory=WorkDone)
    queued_seconds: float = 0.0
    waited_seconds: float = 0.0
    refused_candidates: int = 0
    unavailable: int = 0
    returned_leases: int = 0
    second_leases: int = 0
    late_results: int = 0
    workers_lost: int = 0
    missing_videos: int = 0
    malformed: int = 0

    def count_cache(self, said: str) -> None:
        """Count the cache field of a sample's header."""
        kind, _, trouble = said.partition(": ")
        self.cache_hits += kind == "hit"
        self.cache_misses += kind == "miss"
        if kind == "miss":
            self.cache_trouble = "".join(filter(str.isprintable, trouble))[:_LONGEST_TROUBLE]

    @property
    def faults(self) -> int:
        """Number of faults that the service survived."""
        return self.refused_candidates + self.unavailable + self.workers_lost + self.missing_videos + self.malformed

"""What the server counts about itself. Every number has one owner: the dispatcher counts, everything else reads."""

from __future__ import annotations

from dataclasses import dataclass, field

from v2v_protocol.messages import Result

_LONGEST_TROUBLE = 120
_MOST_SECONDS = 86_400.0


@dataclass(slots=True)
class WorkDone:
    """What samples took, as their workers say.

    Attributes:
        samples: how many.
        cpu_seconds: processor time.
        decode_seconds, simulate_seconds, handover_seconds: by the clock: what went into clips, into arrays made of
            them, and into getting those to their consumers.
    """

    samples: int = 0
    cpu_seconds: float = 0.0
    decode_seconds: float = 0.0
    simulate_seconds: float = 0.0
    handover_seconds: float = 0.0

    def add(self, result: Result, cpu_seconds: float) -> None:
        """One sample more."""
        self.samples += 1
        self.cpu_seconds += bounded_seconds(cpu_seconds)
        self.decode_seconds += bounded_seconds(result.decode_seconds)
        self.simulate_seconds += bounded_seconds(result.simulate_seconds)
        self.handover_seconds += bounded_seconds(result.handover_seconds)

    @property
    def busy_seconds(self) -> float:
        """By the clock, all of it."""
        return self.decode_seconds + self.simulate_seconds + self.handover_seconds


def bounded_seconds(said: float) -> float:
    """What a worker says that something took, within reason."""
    return min(max(said, 0.0), _MOST_SECONDS)


@dataclass(slots=True)
class Counters:
    """Totals since the start.

    Attributes:
        samples: samples handed to consumers.
        batches: the same in batches of each consumer's own size (a fraction while one is filling).
        decodes: clips decoded for those samples; fewer than samples where siblings share one.
        cache_hits, cache_misses: of those clips, where workers have a cache.
        cache_trouble: why a worker's cache keeps no more, when last heard of; empty where it does.
        bytes: of the arrays of those samples.
        in_slots: samples put into memory shared with their consumer; the others travelled in messages.
        work: what the workers took for them.
        waited_seconds: for how long consumers have waited for samples in all, as they say.
        refused_candidates: videos passed over because they could not give what they promised.
        unavailable: samples that no candidate could give.
        returned_leases: leases taken back from workers that died, hung or left.
        second_leases: samples given to a second worker because the first was slow.
        late_results: answers to leases that had been taken back.
        workers_lost: workers that died or were given up.
        missing_videos: leases whose worker could not have a video that the server's host has.
        malformed: messages that were none.
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
        """Count what a sample's header says of the cache."""
        kind, _, trouble = said.partition(": ")
        self.cache_hits += kind == "hit"
        self.cache_misses += kind == "miss"
        if kind == "miss":
            self.cache_trouble = "".join(filter(str.isprintable, trouble))[:_LONGEST_TROUBLE]

    @property
    def faults(self) -> int:
        """Everything that went wrong and was survived."""
        return self.refused_candidates + self.unavailable + self.workers_lost + self.missing_videos + self.malformed

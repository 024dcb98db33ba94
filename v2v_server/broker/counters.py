"""What the server counts about itself. Every number has one owner: the dispatcher counts, everything else reads."""

from __future__ import annotations

from dataclasses import dataclass

_LONGEST_TROUBLE = 120


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
        worker_cpu_seconds: processor time the workers took for them.
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
    worker_cpu_seconds: float = 0.0
    refused_candidates: int = 0
    unavailable: int = 0
    returned_leases: int = 0
    second_leases: int = 0
    late_results: int = 0
    workers_lost: int = 0
    missing_videos: int = 0
    malformed: int = 0

    def count_cache(self, said: str) -> None:
        """Counts what a sample's header says of the cache."""
        kind, _, trouble = said.partition(": ")
        self.cache_hits += kind == "hit"
        self.cache_misses += kind == "miss"
        if kind == "miss":
            self.cache_trouble = "".join(filter(str.isprintable, trouble))[:_LONGEST_TROUBLE]

    @property
    def faults(self) -> int:
        """Everything that went wrong and was survived."""
        return self.refused_candidates + self.unavailable + self.workers_lost + self.missing_videos + self.malformed

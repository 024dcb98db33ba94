"""What the server counts about itself. Every number has one owner: the dispatcher counts, everything else reads."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(slots=True)
class Counters:
    """Totals since the start.

    Attributes:
        samples: samples handed to consumers.
        batches: the same in batches of each consumer's own size (a fraction while one is filling).
        decodes: clips decoded for those samples; fewer than samples where siblings share one.
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

    @property
    def faults(self) -> int:
        """Everything that went wrong and was survived."""
        return self.refused_candidates + self.unavailable + self.workers_lost + self.missing_videos + self.malformed

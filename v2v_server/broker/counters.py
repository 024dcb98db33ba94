"""Count what the server does. The dispatcher counts; all other parts only read."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from v2v_protocol.messages import Result
from v2v_server.system.status_fields import counter, meanings

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
class Counters(WorkDone):
    """Totals since the start. The status leaves out fields without a meaning text."""

    samples: int = counter("Samples sent to consumers.", is_routine=True)
    batches: float = counter("Batches sent to consumers, in each consumer's own batch size.", is_routine=True)
    decodes: int = counter("Clips decoded for the samples sent; siblings share one.", is_routine=True)
    bytes: int = counter("Bytes of the arrays of the samples sent.", "sample_bytes", unit="bytes", is_routine=True)
    in_slots: int = counter(
        "Samples delivered in memory shared with their consumer.", "shared_memory_samples", is_routine=True
    )
    shared: int = counter("Samples that were made for another consumer already.", "shared_samples", is_routine=True)
    cpu_seconds: float = counter(
        "Processor time that samples took in workers.", "worker_cpu_seconds", unit="s", is_routine=True
    )
    decode_seconds: float = counter(
        "Wall-clock time of workers, decoding.", "worker_seconds", unit="s", part="decode", is_routine=True
    )
    simulate_seconds: float = counter(
        "Wall-clock time of workers, simulating.", "worker_seconds", unit="s", part="simulate", is_routine=True
    )
    handover_seconds: float = counter(
        "Wall-clock time of workers, delivering.", "worker_seconds", unit="s", part="handover", is_routine=True
    )
    queued_seconds: float = counter(
        "Time that the server's own workers waited for a core.", "worker_queued_seconds", unit="s", is_routine=True
    )
    waited_seconds: float = counter(
        "Time that consumers waited for samples, as they report.", "consumer_waiting_seconds", unit="s", is_routine=True
    )
    refused_candidates: int = counter("Candidates skipped because their video could not be used.", is_fault=True)
    unavailable: int = counter("Samples without a usable candidate.", "unavailable_samples", is_fault=True)
    returned_leases: int = counter("Leases taken back from workers that died, hung or left.")
    second_leases: int = counter("Samples given to a second worker because the first was slow.", is_routine=True)
    late_results: int = counter(
        "Results of leases that had been taken back, or whose consumer had left.", is_routine=True
    )
    workers_lost: int = counter("Workers that died or were given up.", "lost_workers", is_fault=True)
    missing_videos: int = counter(
        "Leases whose worker could not read a video that the server's host has.", is_fault=True
    )
    malformed: int = counter("Malformed messages received.", "malformed_messages", is_fault=True)
    cache_hits: int = 0
    cache_misses: int = 0
    cache_trouble: str = ""

    def count_sent(self, batch_size: int, sizes: Sequence[int], *, in_slot: bool) -> None:
        """Count a sample that is sent.

        Args:
            batch_size: of its consumer.
            sizes: bytes of each array.
            in_slot: whether its arrays are not in the message.
        """
        self.batches += 1 / batch_size
        self.bytes += sum(sizes)
        self.in_slots += in_slot

    def count_cache(self, said: str) -> None:
        """Count the cache field of a sample's header."""
        kind, _, trouble = said.partition(": ")
        self.cache_hits += kind == "hit"
        self.cache_misses += kind == "miss"
        if kind == "miss":
            self.cache_trouble = "".join(filter(str.isprintable, trouble))[:_LONGEST_TROUBLE]

    @property
    def faults(self) -> int:
        """Return the number of faults that the service survived."""
        return sum(getattr(self, name) for name, meaning in meanings(Counters).items() if meaning.is_fault)


@dataclass(frozen=True, slots=True)
class FaultTotal:
    """Sum of the counters that are faults."""

    faults: int = counter("Faults that the service survived, in total.", is_routine=True)

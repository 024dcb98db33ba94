"""The parts of the status, as JSON has them. :data:`PARTS` says where each one is; all views walk their fields.

A field may be added at any time. Raise :data:`STATUS_VERSION` if you change or remove one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

from v2v_server.broker.state import Counters, FaultTotal, RefusalPart
from v2v_server.corpus.catalogue import CorpusPart
from v2v_server.quarantine import QuarantinePart, VerdictPart
from v2v_server.status.bottleneck import Bottleneck, Shares
from v2v_server.store.quota import CachePart
from v2v_server.system.status_fields import Meaning, counter, gauge, meanings, states, text

STATUS_VERSION = 1
StatusFields: TypeAlias = Mapping[str, Any]
"""A whole status as plain values, fit for JSON."""


@dataclass(frozen=True, slots=True)
class ServerPart:
    """The server."""

    version: int = text("Version of this form of the status.")
    time: str = text("Time of the status, ISO 8601, UTC.")
    program: str = text("Version of the program.")
    protocol: int = text("Version of the protocol.")
    host: str = text("Host of the server.")
    uptime_seconds: float = gauge("Time since the server was ready to accept consumers.", None, unit="s")
    is_ready: bool = gauge("Whether workers are connected, or none are to be started.", "ready")
    address: str = text("Where consumers connect.")
    worker_address: str = text("Where workers connect.")
    spec: Mapping[str, Any] = text("The complete default spec of consumers, with the recipe.")


@dataclass(frozen=True, slots=True)
class LoadPart:
    """What is requested, what is made, and by how many."""

    specs: Mapping[str, Mapping[str, Any]] = text("What consumers requested, by digest; the first few.")
    samples_per_second: float = gauge("Samples sent, over the last ten seconds.", unit="/s")
    batches_per_second: float = gauge("Batches sent, over the last ten seconds.", unit="/s")
    bytes_per_second: float = gauge("Bytes of arrays sent, over the last ten seconds.", unit="bytes/s")
    decodes_per_second: float = gauge("Clips decoded, over the last ten seconds.", unit="/s")
    shared_share: float = gauge(
        "Share of the samples sent over the last ten seconds that were made for another consumer already.",
        "shared_ratio",
        unit="0 to 1",
    )
    queue: int = gauge("Requested samples that are not leased to a worker.", "queued_samples")
    queued_share: float = gauge(
        "Share of connected consumers with requests that are not leased to a worker.", "waiting_share", unit="0 to 1"
    )
    worker_count: int = gauge("Workers that have said hello.")
    worker_processes: int = gauge("Worker processes that the server runs itself.", None)
    workers_wanted: Sequence[int] = text("Lowest and highest number of the server's own workers.")
    consumer_count: int = gauge("Consumers that are connected.")


@dataclass(frozen=True, slots=True, kw_only=True)
class WorkerPart:
    """One worker."""

    name: str = text("Name that it gives itself.")
    host: str = text("Host that it names.")
    state: str = states(
        "Workers that have said hello.",
        "workers",
        "working",
        "idle",  # it holds no lease
        "resting",  # its host cannot read a video, see unreadable
        "lost",  # it hangs or is silent, and its process is being ended
    )
    clip: str = text("Catalogue id of the video in work; empty if it works on nothing that a consumer waits for.")
    frame: int | None = text("First frame of the clip in work.")
    clip_seconds: float = gauge("Time since it began the clip.", unit="s")
    leases: int = gauge("Leases that it holds.")
    samples: int = counter("Samples that the worker made.", is_routine=True)
    busy_share: float = gauge(
        "Share of the last ten seconds in which the worker made samples.", "busy_ratio", unit="0 to 1"
    )
    cpu_share: float = gauge("Processor time, over the last ten seconds.", unit="cores")
    memory_gib: float = gauge("Resident memory of the worker's process; 0: not known.", "memory_bytes", unit="GiB")
    silent_seconds: float = gauge("Time since it was last heard.", unit="s")
    restarts: int | None = gauge("Processes that ended in its place before; None: it is not the server's own.")
    unreadable: str = text("What its host could not read last; empty if it can read all.")


@dataclass(frozen=True, slots=True, kw_only=True)
class ConsumerPart:
    """One consumer: a session."""

    id: str = text("Names the consumer until the server ends. It is not its routing id.")
    name: str = text('Name that it gives itself: "rank 0 of 2".')
    host: str = text("Host that it names.")
    state: str = states(
        "Consumers.",
        "consumers",
        "stalled",  # it waits for samples most of its time
        "taking",
        "idle",  # it has requested nothing
        "gone",  # its connection has ended; it may return for ten seconds
    )
    epoch: int = gauge("Epoch that the consumer is in.", None, merge=max)
    position: int = gauge("Index after the highest one of the epoch that was answered.")
    sequences: int = gauge("Sequences of one epoch, of all ranks together.")
    epoch_share: float = gauge(
        "Share of the epoch that the consumer has received.", "epoch_ratio", unit="0 to 1", merge=min
    )
    eta_seconds: float | None = gauge("Time until the end of the epoch at the rate of the last ten seconds.", unit="s")
    batch_size: int = gauge("Samples of one of its batches.")
    credit: int = gauge("Largest number of samples that the consumer may have outstanding.", "credit_samples")
    in_flight: int = gauge("Samples requested by the consumer and leased to workers.", "in_flight_samples")
    waiting: int = gauge("Samples requested by the consumer and not leased to a worker.", "queued_samples")
    served: int = counter("Samples sent to the consumer.", "samples", is_routine=True)
    samples_per_second: float = gauge("Samples sent to it, over the last ten seconds.", unit="/s")
    batches_per_second: float = gauge("Batches sent to it, over the last ten seconds.", unit="/s")
    waiting_share: float = gauge(
        "Share of the last ten seconds in which the consumer waited for batches.",
        "waiting_ratio",
        unit="0 to 1",
        merge=max,
    )
    waited_seconds: float = gauge("Time that it waited for batches, in all of its sessions.", unit="s")
    silent_seconds: float = gauge("Time since it was last heard.", unit="s")
    spec: str = text("Digest of the spec that it requested.")
    seed: int = text("Seed of its stream.")
    quarantine: int = text("Number of the quarantine snapshot that its samples are made under.")


PARTS: Mapping[str, tuple[type, ...]] = {
    "": (ServerPart, CorpusPart, LoadPart, QuarantinePart),
    "totals": (Counters, FaultTotal),
    "waiting": (Bottleneck,),
    "waiting.shares": (Shares,),
    "cache": (CachePart,),
    "workers": (WorkerPart,),
    "consumers": (ConsumerPart,),
    "refusals": (RefusalPart,),
    "verdicts": (VerdictPart,),
}
"""Where each part is in the status. "cache" may be null; the last four are lists."""


def meanings_at(place: str) -> dict[str, Meaning]:
    """Return the meaning of each field at a place of :data:`PARTS`."""
    return {name: meaning for part in PARTS[place] for name, meaning in meanings(part).items()}


def rows_at(status: StatusFields, place: str) -> list[StatusFields]:
    """Return the values at a place of :data:`PARTS`: one row, or those of a list, or none."""
    found: Any = status
    for key in filter(None, place.split(".")):
        found = found[key]
    return [] if found is None else list(found) if isinstance(found, list | tuple) else [found]


def events(status: StatusFields) -> list[str]:
    """Name the unusual events since the start, those that happened: "2 refused candidates"."""
    named = meanings_at("totals").items()
    return [
        f"{status['totals'][name]} {meaning.words or name.replace('_', ' ')}"
        for name, meaning in named
        if meaning.is_event and status["totals"].get(name)
    ]

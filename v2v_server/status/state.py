"""The state of the service: one model, which the terminal, the page and the metrics read. Pure; times are passed in.

What a field means is said here, and nowhere else. A field may be added without a word;
whoever changes or removes one raises :data:`STATE_VERSION`.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

from v2v_protocol.wire import LARGEST_HEADER_BYTES
from v2v_server.status.bottleneck import Waiting

STATE_VERSION = 1


@dataclass(frozen=True, slots=True)
class WorkerState:
    """One worker.

    Attributes:
        name, host: as it calls itself.
        state: "working"; "idle": it has nothing to do; "resting": its host cannot read a video, see ``unreadable``;
            "lost": it hangs or is silent, and its process is being ended.
        clip: what it is at: catalogue id of the video; empty where it is at nothing that anybody waits for.
        frame: first frame of the clip; None without one.
        clip_seconds: for so long.
        leases: clips that it holds.
        samples: made so far.
        busy_share: of the last ten seconds, in which it made samples, 0 to 1.
        cpu_share: processor time of the last ten seconds, in cores.
        memory_gib: of its process; 0: not known.
        silent_seconds: since it was heard.
        restarts: processes that ended in its place before; None: it is none of this server's own.
        unreadable: what its host could not read last; empty where it can.
    """

    name: str
    host: str
    state: str
    clip: str
    frame: int | None
    clip_seconds: float
    leases: int
    samples: int
    busy_share: float
    cpu_share: float
    memory_gib: float
    silent_seconds: float
    restarts: int | None
    unreadable: str


@dataclass(frozen=True, slots=True)
class ConsumerState:
    """One consumer: a session.

    Attributes:
        id: hexadecimal digits that name the session until the server ends. Not its routing id.
        name, host: as it calls itself: "rank 0 of 2".
        state: "stalled": it waits for samples a tenth of the time or more; "taking"; "idle": it has asked for nothing;
            "gone": its connection has ended, and it may come back for ten seconds.
        epoch: that it is in.
        position: index after the highest of the epoch that was answered, 0 to ``sequences``.
        sequences: of one epoch, of all ranks together.
        eta_seconds: until the end of the epoch at the rate of the last ten seconds; None: not known.
        batch_size: of its batches.
        credit: most samples it may have asked for and not been answered.
        in_flight: that it has asked for and workers have.
        waiting: that it has asked for and nobody works on.
        served: samples sent so far.
        samples_per_second, batches_per_second: over the last ten seconds.
        waiting_share: of the last ten seconds, in which it waited for batches, as it says, 0 to 1.
        waited_seconds: the same since its session began.
        silent_seconds: since it was heard.
        spec: digest of what it asks for, see ``ServiceState.specs``.
        seed: of its stream.
        quarantine: number of the snapshot that its samples are made under.
    """

    id: str
    name: str
    host: str
    state: str
    epoch: int
    position: int
    sequences: int
    eta_seconds: float | None
    batch_size: int
    credit: int
    in_flight: int
    waiting: int
    served: int
    samples_per_second: float
    batches_per_second: float
    waiting_share: float
    waited_seconds: float
    silent_seconds: float
    spec: str
    seed: int
    quarantine: int


@dataclass(frozen=True, slots=True)
class RefusalState:
    """One of the last candidates that was passed over: when (ISO 8601, UTC), which video, from which frame, why; kind
    is "failed", "quarantined" or another :class:`v2v_protocol.refusal.RefusalKind`."""

    time: str
    video: str
    frame: int | None
    reason: str
    kind: str


@dataclass(frozen=True, slots=True)
class QuarantineState:
    """One of the last verdicts of the quarantine that is in force."""

    snapshot: int
    time: str
    video: str
    frame: int
    reason: str


@dataclass(frozen=True, slots=True)
class CacheState:
    """The cache of what was decoded.

    Attributes:
        folder: on this host; empty where only workers of other hosts have one.
        held_gib, most_gib: how much lies there and may.
        hits, misses: clips that were read from one, and that had to be decoded.
        trouble: why one keeps no more, when last heard of; empty where it does.
    """

    folder: str
    held_gib: float
    most_gib: float
    hits: int
    misses: int
    trouble: str


@dataclass(frozen=True, slots=True)
class Totals:
    """Since the start; see :class:`v2v_server.broker.counters.Counters`. ``faults`` is everything that went wrong and
    was survived."""

    samples: int
    batches: float
    decodes: int
    bytes: int
    in_slots: int
    cpu_seconds: float
    decode_seconds: float
    simulate_seconds: float
    handover_seconds: float
    waited_seconds: float
    refused_candidates: int
    unavailable: int
    returned_leases: int
    second_leases: int
    late_results: int
    workers_lost: int
    missing_videos: int
    malformed: int
    faults: int


@dataclass(frozen=True, slots=True)
class ServiceState:
    """The whole service.

    Attributes:
        version: :data:`STATE_VERSION`.
        time: of the state, ISO 8601, UTC.
        program, protocol: versions.
        host: of the server.
        uptime_seconds: since the server could be asked for anything.
        is_ready: workers are there, or none are to be started.
        address, worker_address: where consumers and workers connect.
        videos: the folder.
        video_count: of the catalogue.
        unusable_count: files of it that cannot be used at all.
        spec: the resolved default for consumers, with the recipe.
        specs: what consumers ask for, by digest; the first few.
        waiting: who waits for whom, in one sentence, and the shares behind it.
        samples_per_second, batches_per_second, bytes_per_second, decodes_per_second: over the last ten seconds.
        queue: asked samples that nobody works on.
        queued_share: consumers with such samples, of all that are connected, 0 to 1, now.
        worker_count: that have said hello.
        worker_processes: that the server runs itself; more than ``worker_count`` while some start.
        workers_wanted: least and most of its own.
        consumer_count: that are connected.
        totals: since the start.
        cache: None where there is none.
        workers, consumers: the first thousand of each.
        refusals: the last few, newest first.
        quarantine_snapshot: number of the newest.
        quarantined: verdicts in it.
        verdicts: its last few, newest first.
    """

    version: int
    time: str
    program: str
    protocol: int
    host: str
    uptime_seconds: float
    is_ready: bool
    address: str
    worker_address: str
    videos: str
    video_count: int
    unusable_count: int
    spec: Mapping[str, Any]
    specs: Mapping[str, Mapping[str, Any]]
    waiting: Waiting
    samples_per_second: float
    batches_per_second: float
    bytes_per_second: float
    decodes_per_second: float
    queue: int
    queued_share: float
    worker_count: int
    worker_processes: int
    workers_wanted: tuple[int, int]
    consumer_count: int
    totals: Totals
    cache: CacheState | None
    workers: tuple[WorkerState, ...]
    consumers: tuple[ConsumerState, ...]
    refusals: tuple[RefusalState, ...]
    quarantine_snapshot: int
    quarantined: int
    verdicts: tuple[QuarantineState, ...]

    def to_dict(self) -> dict[str, Any]:
        """Plain values, fit for JSON."""
        values = _plain(self)
        values["waiting"] = _plain(self.waiting) | {"shares": _plain(self.waiting.shares)}
        values["totals"] = _plain(self.totals)
        values["cache"] = None if self.cache is None else _plain(self.cache)
        for many in ("workers", "consumers", "refusals", "verdicts"):
            values[many] = [_plain(each) for each in values[many]]
        return values

    def to_json(self, most_bytes: int = LARGEST_HEADER_BYTES - 1024) -> bytes:
        """The same as JSON, UTF-8. Where that would be too much for a message, fewer workers and consumers are told one
        by one."""
        values = self.to_dict()
        while len(encoded := json.dumps(values, ensure_ascii=False).encode(errors="replace")) > most_bytes:
            shown = max(len(values["workers"]), len(values["consumers"])) // 2
            values["workers"], values["consumers"] = values["workers"][:shown], values["consumers"][:shown]
        return encoded


def _plain(item: Any) -> dict[str, Any]:
    """A dataclass's fields; ``dataclasses.asdict`` looks into all of them, for 35 ms with two thousand peers."""
    kind: Any = type(item)
    return {name: getattr(item, name) for name in _names(kind)}


@cache
def _names(kind: Any) -> tuple[str, ...]:
    return tuple(field.name for field in dataclasses.fields(kind))

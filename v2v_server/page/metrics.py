"""Format the state as Prometheus metrics, named by its convention (base units, ``_total`` for counters).

Consumers and workers have labels. A consumer's label is its display name, not the number of its connection, which
changes in each epoch; consumers with the same name are added up.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from prometheus_client import CollectorRegistry
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.exposition import choose_encoder

GIB = 1 << 30
_COUNTERS = {
    "v2v_samples": ("samples", "Samples sent to consumers."),
    "v2v_batches": ("batches", "Batches sent to consumers, in each consumer's own batch size."),
    "v2v_decodes": ("decodes", "Clips decoded for the samples sent."),
    "v2v_sample_bytes": ("bytes", "Bytes of the arrays of the samples sent."),
    "v2v_shared_memory_samples": ("in_slots", "Samples written to memory shared with their consumer."),
    "v2v_worker_cpu_seconds": ("cpu_seconds", "Processor time that samples took in workers."),
    "v2v_consumer_waiting_seconds": ("waited_seconds", "Time that consumers waited for samples, as they report."),
    "v2v_refused_candidates": ("refused_candidates", "Candidates skipped because their video could not be used."),
    "v2v_unavailable_samples": ("unavailable", "Samples without a usable candidate."),
    "v2v_returned_leases": ("returned_leases", "Leases taken back from workers that died, hung or left."),
    "v2v_second_leases": ("second_leases", "Samples given to a second worker because the first was slow."),
    "v2v_late_results": ("late_results", "Results of leases that had been taken back."),
    "v2v_lost_workers": ("workers_lost", "Workers that died or were given up."),
    "v2v_missing_videos": ("missing_videos", "Leases whose worker could not read a video that the server's host has."),
    "v2v_malformed_messages": ("malformed", "Malformed messages received."),
    "v2v_faults": ("faults", "Faults that the service survived, in total."),
}
_GAUGES = {
    "v2v_uptime_seconds": ("uptime_seconds", "Time since the server was ready to accept consumers."),
    "v2v_queued_samples": ("queue", "Requested samples that are not leased to a worker."),
    "v2v_waiting_share": (
        "queued_share",
        "Share of connected consumers with requests that are not leased to a worker, 0 to 1.",
    ),
    "v2v_worker_processes": ("worker_processes", "Worker processes that the server runs itself."),
    "v2v_videos": ("video_count", "Videos of the catalogue."),
    "v2v_unusable_videos": ("unusable_count", "Files that cannot be used."),
    "v2v_quarantined_sequences": ("quarantined", "Quarantine entries in force."),
}
_SHARES = ("consumers", "idle", "broker", "decode", "simulate", "handover", "queued")
PARTS = ("nobody", "start", "workers", "consumers", "cores", "decode", "simulate", "handover", "broker", "way", "even")
_WORKER_STATES = ("working", "idle", "resting", "lost")
_CONSUMER_STATES = ("stalled", "taking", "idle", "gone")
_OF_CONSUMERS = {
    "v2v_consumer_waiting_ratio": (
        "Share of the last ten seconds in which the consumer waited for batches, 0 to 1.",
        "waiting_share",
    ),
    "v2v_consumer_epoch": ("Epoch that the consumer is in.", "epoch"),
    "v2v_consumer_in_flight_samples": ("Samples requested by the consumer and leased to workers.", "in_flight"),
    "v2v_consumer_queued_samples": ("Samples requested by the consumer and not leased to a worker.", "waiting"),
    "v2v_consumer_credit_samples": ("Largest number of samples that the consumer may have outstanding.", "credit"),
}
_LARGEST_OF_ALIKE = ("v2v_consumer_waiting_ratio", "v2v_consumer_epoch")
_State = Mapping[str, Any]


class StateCollector:
    """Collector of the metrics of one state.

    Args:
        state: ``v2v_server.status.state.ServiceState.to_dict()``; None if the server does not answer.
    """

    def __init__(self, state: _State | None) -> None:
        self._state = state

    def collect(self) -> Iterator[Metric]:
        """Yield every metric."""
        state = self._state
        yield GaugeMetricFamily("v2v_up", "Whether the server answers.", value=float(state is not None))
        if state is None:
            return
        yield GaugeMetricFamily("v2v_ready", "Whether it is ready.", value=float(state["is_ready"]))
        info = GaugeMetricFamily("v2v_info", "Versions.", labels=("program", "protocol"))
        info.add_metric((state["program"], str(state["protocol"])), 1.0)
        yield info
        for name, (key, text) in _COUNTERS.items():
            yield CounterMetricFamily(name, text, value=state["totals"][key])
        work = CounterMetricFamily("v2v_worker_seconds", "Wall-clock time of workers, by activity.", labels=("part",))
        for part in ("decode", "simulate", "handover"):
            work.add_metric((part,), state["totals"][f"{part}_seconds"])
        yield work
        for name, (key, text) in _GAUGES.items():
            yield GaugeMetricFamily(name, text, value=state[key])
        yield from _of_waiting(state["waiting"])
        yield from _of_cache(state["cache"])
        yield _by_state("v2v_workers", "Workers that have said hello.", state["workers"], _WORKER_STATES)
        yield _by_state("v2v_consumers", "Consumers.", state["consumers"], _CONSUMER_STATES)
        yield from _of_workers(state["workers"])
        yield from _of_consumers(state["consumers"])


def exposition(state: _State | None, accept: str = "") -> tuple[bytes, str]:
    """Return the metrics of a state, and their content type.

    Args:
        state: see :class:`StateCollector`.
        accept: the request's Accept header.
    """
    registry = CollectorRegistry(auto_describe=False)
    registry.register(StateCollector(state))
    encode, content_type = choose_encoder(accept)
    return encode(registry), content_type


def _of_waiting(waiting: _State) -> Iterator[Metric]:
    shares = GaugeMetricFamily(
        "v2v_time_ratio",
        "Share of the last ten seconds by part: waiting consumers, idle workers, broker, workers. 0 to 1.",
        labels=("part",),
    )
    for part in _SHARES:
        shares.add_metric((part,), waiting["shares"][part])
    yield shares
    slow = GaugeMetricFamily("v2v_slow_part", "1 for the part that is the bottleneck.", labels=("part",))
    for part in PARTS:
        slow.add_metric((part,), float(part == waiting["part"]))
    yield slow


def _of_cache(cache: _State | None) -> Iterator[Metric]:
    if cache is None:
        return
    yield CounterMetricFamily("v2v_cache_hits", "Clips read from the cache.", value=cache["hits"])
    yield CounterMetricFamily("v2v_cache_misses", "Clips that were not in the cache.", value=cache["misses"])
    if cache["folder"]:
        yield GaugeMetricFamily("v2v_cache_bytes", "Bytes stored in the cache.", value=cache["held_gib"] * GIB)
        yield GaugeMetricFamily(
            "v2v_cache_limit_bytes", "Size limit of the cache, bytes.", value=cache["most_gib"] * GIB
        )


def _by_state(name: str, text: str, peers: list[_State], states: tuple[str, ...]) -> Metric:
    metric = GaugeMetricFamily(name, text, labels=("state",))
    for state in states:
        metric.add_metric((state,), sum(peer["state"] == state for peer in peers))
    return metric


def _of_workers(workers: list[_State]) -> Iterator[Metric]:
    labels = ("worker", "host")
    samples = CounterMetricFamily("v2v_worker_samples", "Samples that the worker made.", labels=labels)
    busy = GaugeMetricFamily(
        "v2v_worker_busy_ratio",
        "Share of the last ten seconds in which the worker made samples, 0 to 1.",
        labels=labels,
    )
    memory = GaugeMetricFamily("v2v_worker_memory_bytes", "Resident memory of the worker's process.", labels=labels)
    for worker in workers:
        label = worker["name"], worker["host"]
        samples.add_metric(label, worker["samples"])
        busy.add_metric(label, worker["busy_share"])
        memory.add_metric(label, worker["memory_gib"] * GIB)
    yield from (samples, busy, memory)


def _of_consumers(consumers: list[_State]) -> Iterator[Metric]:
    alike: dict[tuple[str, str], list[_State]] = {}
    for consumer in consumers:
        if consumer["state"] != "gone":
            alike.setdefault((consumer["name"], consumer["host"]), []).append(consumer)
    labels = ("consumer", "host")
    samples = CounterMetricFamily("v2v_consumer_samples", "Samples sent to the consumer.", labels=labels)
    progress = GaugeMetricFamily(
        "v2v_consumer_epoch_ratio", "Share of the epoch that the consumer has received, 0 to 1.", labels=labels
    )
    for label, group in alike.items():
        samples.add_metric(label, sum(each["served"] for each in group))
        progress.add_metric(label, min(each["position"] / max(1, each["sequences"]) for each in group))
    yield from (samples, progress)
    for name, (text, key) in _OF_CONSUMERS.items():
        metric = GaugeMetricFamily(name, text, labels=labels)
        together = max if name in _LARGEST_OF_ALIKE else sum
        for label, group in alike.items():
            metric.add_metric(label, together(each[key] for each in group))
        yield metric

"""Format the status as Prometheus metrics, named by its convention (base units, ``_total`` for counters).

Every field with a metric is walked (:mod:`v2v_server.system.status_fields`). Consumers and workers have labels. A
consumer's label is its display name, which stays the same in each epoch; consumers with the same name are merged.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from prometheus_client import CollectorRegistry
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.exposition import choose_encoder

from v2v_server.status.parts import PARTS, Status, meanings_at, rows_at
from v2v_server.system.status_fields import GIB, Meaning

_PREFIXES = {"workers": "v2v_worker_", "consumers": "v2v_consumer_", "cache": "v2v_cache_"}
_LABELS = {"workers": {"worker": "name", "host": "host"}, "consumers": {"consumer": "name", "host": "host"}}
_HELP = {
    "v2v_worker_seconds": "Wall-clock time of workers, by activity.",
    "v2v_time_ratio": "Shares of time over the last ten seconds: consumers waited, broker busy, workers at each part.",
}
"""Texts of metrics that several fields share, each under its own label."""


class StatusCollector:
    """Collector of the metrics of one status.

    Args:
        status: the status; None if the server does not answer.
    """

    def __init__(self, status: Status | None) -> None:
        self._status = status

    def collect(self) -> Iterator[Metric]:
        """Yield every metric."""
        yield GaugeMetricFamily("v2v_up", "Whether the server answers.", value=float(self._status is not None))
        if self._status is None:
            return
        info = GaugeMetricFamily("v2v_info", "Versions.", labels=("program", "protocol"))
        info.add_metric((self._status["program"], str(self._status["protocol"])), 1.0)
        yield info
        families: dict[str, Any] = {}
        for place in PARTS:
            rows = rows_at(self._status, place)
            for key, meaning in meanings_at(place).items():
                if meaning.kind != "text" and meaning.metric != "":
                    _add(families, place, key, meaning, rows)
        yield from families.values()


def exposition(status: Status | None, accept: str = "") -> tuple[bytes, str]:
    """Return the metrics of a status, and their content type.

    Args:
        status: see :class:`StatusCollector`.
        accept: the request's Accept header.
    """
    registry = CollectorRegistry(auto_describe=False)
    registry.register(StatusCollector(status))
    encode, content_type = choose_encoder(accept)
    return encode(registry), content_type


def _add(families: dict[str, Any], place: str, key: str, meaning: Meaning, rows: list[Status]) -> None:
    """Add the samples of one field to the family of its metric."""
    name = _PREFIXES.get(place, "v2v_") + (key if meaning.metric is None else meaning.metric)
    labels = _LABELS.get(place, {})
    names = (*labels, "part") if meaning.part else tuple(labels)
    samples: dict[tuple[str, ...], float] = {}
    if meaning.kind == "states":
        name, names = f"v2v_{meaning.metric}", (key,)
        samples = {(state,): sum(row[key] == state for row in rows) for state in meaning.states}
    else:
        for label, values in _merged(key, labels, rows).items():
            samples[(*label, meaning.part) if meaning.part else label] = meaning.merge(values)
    kind = CounterMetricFamily if meaning.kind == "counter" else GaugeMetricFamily
    family = families.setdefault(name, kind(name, _HELP.get(name, meaning.help), labels=names))
    for label, value in samples.items():
        family.add_metric(label, value * (GIB if meaning.unit == "GiB" else 1))


def _merged(key: str, labels: Mapping[str, str], rows: list[Status]) -> dict[tuple[str, ...], list[Any]]:
    """Return the known values of a field by the labels of their rows."""
    found: dict[tuple[str, ...], list[Any]] = {}
    for row in rows:
        if row[key] is not None and row.get("state") != "gone":
            found.setdefault(tuple(row[of] for of in labels.values()), []).append(row[key])
    return found

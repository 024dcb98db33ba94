"""Format the status as lines of text: rates and counts while the server runs, and a summary when it ends. Pure."""

from __future__ import annotations

from v2v_protocol.progress import format_duration
from v2v_server.status.parts import Status, events
from v2v_server.system.status_fields import GIB


def figures(status: Status) -> str:
    """Return rates and counts in one line."""
    totals, decodes = status["totals"], status["totals"]["decodes"]
    processes = max(status["worker_processes"], status["worker_count"])
    parts = [
        f"{status['batches_per_second']:.2f} batches/s",
        f"{status['samples_per_second']:.1f} samples/s",
        f"{totals['samples'] / decodes:.1f} samples per decode" if 0 < decodes < totals["samples"] else "",
        # Left out where all samples come in messages: consumers on other hosts, or in another container.
        f"{totals['in_slots'] / totals['samples']:.0%} by shared memory" if totals["in_slots"] else "",
        format_cache(status),
        f"workers {status['worker_count']}/{processes}",
        f"consumers {status['consumer_count']}",
        f"queue {status['queue']}",
        f"faults {totals['faults']}",
        f"total {totals['samples']} samples",
        *events(status),
    ]
    return "  ".join(filter(None, parts))


def format_cache(status: Status) -> str:
    """Return how well the cache serves; empty if there is none, or it was not used yet."""
    cache = status["cache"]
    if cache is None or not (read := cache["hits"] + cache["misses"]):
        return ""
    held = f", {cache['held_gib']:.2f} of {cache['most_gib']:g} GiB" if cache["folder"] else ""
    return f"cache {cache['hits'] / read:.0%} hits{held}" + (f" ({cache['trouble']})" if cache["trouble"] else "")


def format_shutdown_summary(status: Status) -> list[str]:
    """Return lines on all that a server did.

    Args:
        status: its last.
    """
    totals, seconds = status["totals"], status["uptime_seconds"]
    rate = totals["samples"] / seconds if seconds > 0.0 else 0.0
    clips = f", from {totals['decodes']} decoded clips" if totals["decodes"] < totals["samples"] else ""
    happened = events(status)
    lines = [
        f"in total {totals['samples']} samples ({totals['batches']:.1f} batches, {totals['bytes'] / GIB:.2f} GiB"
        f"{clips}) in {format_duration(seconds)}: {rate:.2f} samples/s",
        f"faults {totals['faults']}" + (f"; {', '.join(happened)}" if happened else ""),
    ]
    busy = totals["decode_seconds"] + totals["simulate_seconds"] + totals["handover_seconds"]
    if busy > 0.0:
        lines.append(
            f"workers spent {format_duration(busy)} on them: decoding {totals['decode_seconds'] / busy:.0%}, "
            f"simulating {totals['simulate_seconds'] / busy:.0%}, delivering {totals['handover_seconds'] / busy:.0%}; "
            f"consumers waited {format_duration(totals['waited_seconds'])}"
        )
    return lines

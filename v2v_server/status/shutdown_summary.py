"""What a server says when it ends: what it did, what went wrong, and how fast it was. Pure."""

from __future__ import annotations

from v2v_server.status.state import ServiceState, Totals
from v2v_server.store.cache import GIB

_FAULTS = {
    "refused_candidates": "candidates refused",
    "unavailable": "samples unavailable",
    "workers_lost": "workers lost",
    "missing_videos": "videos missing on workers' hosts",
    "malformed": "messages that were none",
}


def format_shutdown_summary(state: ServiceState) -> list[str]:
    """Lines on all that a server did, for people.

    Args:
        state: its last.
    """
    totals, seconds = state.totals, state.uptime_seconds
    rate = totals.samples / seconds if seconds > 0.0 else 0.0
    clips = f", from {totals.decodes} decoded clips" if totals.decodes < totals.samples else ""
    lines = [
        f"in all {totals.samples} samples ({totals.batches:.1f} batches, {totals.bytes / GIB:.2f} GiB{clips}) in "
        f"{format_duration(seconds)}: {rate:.2f} samples/s",
        f"faults {totals.faults}{_faults(totals)}",
    ]
    busy = totals.decode_seconds + totals.simulate_seconds + totals.handover_seconds
    if busy > 0.0:
        lines.append(
            f"workers spent {format_duration(busy)} on them: decoding {totals.decode_seconds / busy:.0%}, simulating "
            f"{totals.simulate_seconds / busy:.0%}, handing over {totals.handover_seconds / busy:.0%}; consumers "
            f"waited {format_duration(totals.waited_seconds)}"
        )
    return lines


def _faults(totals: Totals) -> str:
    named = [f"{count} {text}" for name, text in _FAULTS.items() if (count := getattr(totals, name))]
    return f": {', '.join(named)}" if named else ""


def format_duration(seconds: float) -> str:
    """A time as people read it."""
    if seconds < 120.0:
        return f"{seconds:.1f} s"
    minutes = round(seconds / 60.0)
    return f"{minutes} min" if minutes < 120 else f"{minutes // 60} h {minutes % 60} min"

"""Which settings are worth having: the Pareto front, and the best one for a wish."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from v2v_protocol.errors import UsageError

Costs = tuple[float, ...]
"""Lower is better in each."""


def dominates(one: Costs, other: Costs) -> bool:
    """Whether ``one`` is nowhere worse, and somewhere better."""
    return all(a <= b for a, b in zip(one, other, strict=True)) and one != other


def dominators(costs: Mapping[str, Costs]) -> dict[str, str | None]:
    """For each name one that dominates it and is itself on the front (the first such), or None on the front."""
    front = [name for name in costs if not any(dominates(other, costs[name]) for other in costs.values())]
    return {
        name: next((better for better in front if dominates(costs[better], own)), None) for name, own in costs.items()
    }


def best(
    records: Sequence[Mapping[str, Any]], *, error_key: str, target_rate: float | None, max_error: float | None
) -> Mapping[str, Any]:
    """The setting to take.

    Args:
        records: of the settings; each has "samples_per_core_second", "samples_per_decode" and ``error_key``.
        error_key: name of the error that counts.
        target_rate: the least wrong of those that make so many samples a core second; of equals the one with the fewest
            samples per decode, then the fastest.
        max_error: with ``target_rate`` None, the fastest of those that are no more wrong than this; of equals the one
            with the fewest samples per decode.

    Raises:
        UsageError: no setting does; the message says how far the nearest is.
    """
    if target_rate is not None:
        fit = [record for record in records if record["samples_per_core_second"] >= target_rate]
        if not fit:
            most = max(record["samples_per_core_second"] for record in records)
            raise UsageError(
                f"--target-rate {target_rate:g}: the fastest setting makes {most:.3g} samples a core second"
            )
        return min(fit, key=lambda r: (r[error_key], r["samples_per_decode"], -r["samples_per_core_second"]))
    limit = 0.0 if max_error is None else max_error
    fit = [record for record in records if record[error_key] <= limit]
    if not fit:
        raise UsageError(f"--max-error {limit:g}: the least wrong setting has {min(r[error_key] for r in records):.3g}")
    return min(fit, key=lambda r: (-r["samples_per_core_second"], r["samples_per_decode"]))

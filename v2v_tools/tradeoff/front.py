"""The Pareto front of settings, and the best setting for a wish."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from v2v_protocol.errors import UsageError

Costs = tuple[float, ...]
"""Lower is better in each."""


def dominates(one: Costs, other: Costs) -> bool:
    """Return whether ``one`` is nowhere worse and somewhere better."""
    return all(a <= b for a, b in zip(one, other, strict=True)) and one != other


def dominators(costs: Mapping[str, Costs]) -> dict[str, str | None]:
    """Return, for each name, the first one on the front that dominates it, or None on the front."""
    front = [name for name in costs if not any(dominates(other, costs[name]) for other in costs.values())]
    return {
        name: next((better for better in front if dominates(costs[better], own)), None) for name, own in costs.items()
    }


def best(
    records: Sequence[Mapping[str, Any]], *, error_key: str, target_rate: float | None, max_error: float | None
) -> Mapping[str, Any]:
    """Return the setting to take.

    Args:
        records: of the settings; each has "samples_per_core_second", "samples_per_decode" and ``error_key``.
        error_key: name of the error that counts.
        target_rate: samples a core second. Take the smallest error at this rate or above; of equals the fewest samples
            per decode, then the fastest.
        max_error: without ``target_rate``, the largest error. Take the fastest within it; of equals the fewest samples
            per decode.

    Raises:
        UsageError: no setting fulfils the wish; the message names the nearest.
    """
    if target_rate is not None:
        fit = [record for record in records if record["samples_per_core_second"] >= target_rate]
        if not fit:
            most = max(record["samples_per_core_second"] for record in records)
            raise UsageError(
                f"--target-rate {target_rate:g}: the fastest setting makes {most:.3g} samples a core second"
            )
        return min(fit, key=lambda r: (r[error_key] or 0.0, r["samples_per_decode"], -r["samples_per_core_second"]))
    errors = [record[error_key] or 0.0 for record in records]  # None: no events
    fit = [record for record, error in zip(records, errors, strict=True) if max_error is None or error <= max_error]
    if not fit:
        raise UsageError(f"--max-error {max_error:g}: the smallest error of a setting is {min(errors):.3g}")
    return min(fit, key=lambda r: (-r["samples_per_core_second"], r["samples_per_decode"]))

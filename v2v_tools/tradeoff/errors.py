"""Error measures between two voxel arrays of the same scene, and how alike two samples are.

    voxel error    sum |V - R| / sum |R|            R: the exact reference
    count error    (sum |V| - sum |R|) / sum |R|
    bins changed   share of bins with V != R

Sums go over all clips together, so that a clip weighs as much as it has events.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import numpy.typing as npt

from v2v_protocol.errors import UsageError

Voxels = npt.NDArray[Any]


@dataclass(frozen=True, slots=True)
class Tally:
    """The sums behind the measures; tallies can be added.

    Attributes:
        difference: sum of |V - R|.
        events, reference_events: sums of |V| and of |R|.
        changed, bins: bins that differ, and all bins.
    """

    difference: float = 0.0
    events: float = 0.0
    reference_events: float = 0.0
    changed: int = 0
    bins: int = 0

    def __add__(self, other: Tally) -> Tally:
        return Tally(*(getattr(self, field.name) + getattr(other, field.name) for field in fields(Tally)))

    @property
    def voxel_error(self) -> float | None:
        """Return the measure; None where the reference has no events."""
        return self.difference / self.reference_events if self.reference_events else None

    @property
    def count_error(self) -> float | None:
        return (self.events - self.reference_events) / self.reference_events if self.reference_events else None

    @property
    def changed_share(self) -> float | None:
        return self.changed / self.bins if self.bins else None


def compare(voxels: Voxels, reference: Voxels) -> Tally:
    """Return the tally of two arrays of the same shape, signed event counts.

    Raises:
        UsageError: their shapes differ.
    """
    if voxels.shape != reference.shape:
        raise UsageError(f"voxels {list(voxels.shape)} against a reference of {list(reference.shape)}")
    # Counts are exact in float32 up to 2**24; integer dtypes would wrap.
    one, other = (each if each.dtype.kind == "f" else each.astype(np.float64) for each in (voxels, reference))
    difference = one - other
    return Tally(
        difference=_sum(np.abs(difference)),
        events=_sum(np.abs(one)),
        reference_events=_sum(np.abs(other)),
        changed=int(np.count_nonzero(difference)),
        bins=one.size,
    )


def _sum(values: Voxels) -> float:
    return float(values.sum(dtype=np.float64))


def correlation(one: npt.ArrayLike, other: npt.ArrayLike) -> float:
    """Return Pearson's coefficient of two arrays of the same size; 0 where one of them is constant."""
    a, b = (np.asarray(each, np.float64).ravel() for each in (one, other))
    a, b = a - a.mean(), b - b.mean()
    scale = float(np.sqrt((a @ a) * (b @ b)))
    return float(a @ b) / scale if scale > 0.0 else 0.0

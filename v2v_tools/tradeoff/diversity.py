"""How alike samples are: siblings, which show the same clip, against samples of different clips.

Two coefficients: *pixels* is of |V| over all bins and pixels; *course* is of the events of each bin over the crop:
siblings share the motion of their scene even where their crops do not meet. Cameras are those of the recipe
without hot pixels, which would dominate the course.

The courses of different clips correlate as well, because every camera begins running and pauses later. The correlation
of siblings beyond that is (r - s) / (1 - s), with r between siblings and s between different clips.
"""

from __future__ import annotations

import itertools
import math
import statistics
import time
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from v2v_server.worker.arrays import SampleContext
from v2v_tools.tradeoff.accuracy import Places, seen, simulated
from v2v_tools.tradeoff.errors import correlation

_Activity = tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]


def effective_samples(count: int, coefficient: float) -> float:
    """Return the number of independent samples that ``count`` siblings with this correlation are worth for a mean.

    n / (1 + (n - 1) r), the design effect of Kish (Survey Sampling, 1965).
    """
    return count / (1 + (count - 1) * max(coefficient, 0.0))


def diversity(places: Places, *, until: float = math.inf) -> list[dict[str, Any]]:
    """Return the records of siblings and of a batch of different places; none where there is only one place.

    Args:
        until: reading of ``time.monotonic`` after which no further place is decoded; two are in any case.
    """
    if len(places.leases) < 2:
        return []
    found: list[list[_Activity]] = []
    for place, lease in enumerate(places.leases):
        if place < 2 or time.monotonic() < until:
            found.append([_activity(context) for context in seen(places, place, len(lease.indices))])
    siblings = [pair for place in found for pair in itertools.combinations(place, 2)]
    others = [pair for view in zip(*found, strict=True) for pair in itertools.combinations(view, 2)]
    alike, apart = _record("siblings", siblings), _record("batch", others)
    r, s = alike["course_correlation"], apart["course_correlation"]
    beyond = (r - s) / (1.0 - s) if s < 1.0 else 0.0
    alike |= {"course_correlation_beyond_batch": beyond}
    alike |= {f"effective_samples_of_{count}": effective_samples(count, beyond) for count in (2, 4)}
    return [alike, apart]


def _activity(context: SampleContext) -> _Activity:
    voxels = simulated(context, context.params).voxels
    events = np.abs(voxels).reshape(-1, *voxels.shape[2:])
    # Every fourth pixel of every fourth row: the same coefficient at a sixteenth of the memory.
    return events[:, ::4, ::4].copy(), events.sum(axis=(1, 2))


def _record(which: str, pairs: Sequence[tuple[_Activity, _Activity]]) -> dict[str, Any]:
    return {"measure": "diversity", "name": which, "pairs": len(pairs)} | {
        f"{what}_correlation": statistics.mean(correlation(one[number], other[number]) for one, other in pairs)
        for number, what in enumerate(("pixel", "course"))
    }

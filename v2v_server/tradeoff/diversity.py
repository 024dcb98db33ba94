"""How alike samples are: siblings, which show the same clip, against samples of different clips.

Two coefficients: *pixels* is of |V| over all bins and pixels; *course* is of the events of each bin over the crop:
siblings share the motion of their scene even where their crops do not meet. Cameras are those of the recipe
without hot pixels, which would dominate the course. The crop overlap is the share of a crop that a sibling shows too.

The courses of different clips correlate as well, because every camera begins running and pauses later. The correlation
of siblings beyond that is (r - s) / (1 - s), with r between siblings and s between different clips.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
import statistics
import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from v2v_protocol.messages import Lease
from v2v_protocol.sample import SampleParams
from v2v_server.corpus.sources.folder import Folder
from v2v_server.simulation.clip import simulate_clip
from v2v_server.simulation.view import apply_view
from v2v_server.tradeoff.errors import correlation
from v2v_server.worker.produce import decode_for, step_durations

_Activity = tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]


def overlap(one: SampleParams, other: SampleParams, height_px: int, width_px: int) -> float:
    """Return the share of a crop's pixels that the other crop shows too, both of the same size and scale."""
    rows = height_px - abs(one.crop_top_px - other.crop_top_px)
    columns = width_px - abs(one.crop_left_px - other.crop_left_px)
    return max(rows, 0) * max(columns, 0) / (height_px * width_px)


def effective_samples(count: int, coefficient: float) -> float:
    """Return the number of independent samples that ``count`` siblings with this correlation are worth for a mean.

    n / (1 + (n - 1) r), the design effect of Kish (Survey Sampling, 1965).
    """
    return count / (1 + (count - 1) * max(coefficient, 0.0))


def diversity(root: Path, leases: Sequence[Lease], *, until: float = math.inf) -> list[dict[str, Any]]:
    """Return the records of siblings and of a batch of different places; none where there is only one place.

    Args:
        root: folder of the videos.
        leases: one for each place, of its four views.
        until: reading of ``time.monotonic`` after which no further place is decoded; two are in any case.
    """
    if len(leases) < 2:
        return []
    places: list[list[tuple[SampleParams, _Activity]]] = []
    for lease in leases:
        if len(places) < 2 or time.monotonic() < until:
            places.append(_activities(root, lease))
    siblings = [pair for place in places for pair in itertools.combinations(place, 2)]
    others = [pair for view in zip(*places, strict=True) for pair in itertools.combinations(view, 2)]
    alike, apart = _record("siblings", siblings), _record("batch", others)
    r, s = alike["course_correlation"], apart["course_correlation"]
    beyond = (r - s) / (1.0 - s) if s < 1.0 else 0.0
    alike |= {"course_correlation_beyond_batch": beyond}
    alike |= {f"effective_samples_of_{count}": effective_samples(count, beyond) for count in (2, 4)}
    return [alike, apart]


def _activities(root: Path, lease: Lease) -> list[tuple[SampleParams, _Activity]]:
    made = []
    for decoded in decode_for(lease, lease.indices, Folder(root)):
        recipe = decoded.plan.spec.recipe
        params = dataclasses.replace(decoded.plan.params, hot_pixel_count=0)
        signal = decoded.clip.signal
        view = apply_view(decoded.clip.frames, params, recipe, signal)
        voxels, _ = simulate_clip(view, params, recipe, "float32", step_durations(lease, decoded), signal=signal)
        events = np.abs(voxels).reshape(-1, *voxels.shape[2:])
        # Every fourth pixel of every fourth row: the same coefficient at a sixteenth of the memory.
        made.append((params, (events[:, ::4, ::4].copy(), events.sum(axis=(1, 2)))))
    return made


def _record(
    which: str, pairs: Iterable[tuple[tuple[SampleParams, _Activity], tuple[SampleParams, _Activity]]]
) -> dict[str, Any]:
    pixels, courses, overlaps = [], [], []
    for (params, (one, one_course)), (other_params, (other, other_course)) in pairs:
        height, width = (4 * side for side in one.shape[1:])
        pixels.append(correlation(one, other))
        courses.append(correlation(one_course, other_course))
        overlaps.append(overlap(params, other_params, height, width))
    return {
        "measure": "diversity",
        "name": which,
        "pairs": len(pixels),
        "pixel_correlation": statistics.mean(pixels),
        "course_correlation": statistics.mean(courses),
        "crop_overlap": statistics.mean(overlaps) if which == "siblings" else None,
    }

"""Errors of each setting against its full model, by contrast threshold; and the parts of a sample that take time.

The full model has exactly decoded frames, all effects of the recipe, and the shortest sub-steps of all settings. Both
sides are the same camera: the sample's own draw and noise key, with both thresholds set to the value in question. Hot
pixels are left out: they fire alike on both sides and would make every relative error look small.
"""

from __future__ import annotations

import dataclasses
import statistics
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from v2v_protocol.messages import Lease
from v2v_protocol.sample import SampleParams
from v2v_server.corpus.sources.folder import Folder
from v2v_server.simulation.clip import simulate_clip
from v2v_server.simulation.kernels import Voxels
from v2v_server.worker.arrays import SampleContext
from v2v_server.worker.produce import decode_for, plan_sample, sample_context
from v2v_tools.tradeoff.errors import Tally, compare

THRESHOLDS = (0.05, 0.2, 0.5, 1.0, 2.0)

Tallies = dict[float, Tally]
"""By contrast threshold."""


class Places(NamedTuple):
    """Folder of a form's videos, and a lease for each place, of its four views."""

    root: Path
    leases: Sequence[Lease]


def seen(places: Places, place: int, views: int = 1) -> list[SampleContext]:
    """Return the first views of a place before simulation, without hot pixels, from one decode."""
    lease, contexts = places.leases[place], []
    for decoded in decode_for(lease, lease.indices[:views], Folder(places.root)):
        context, _ = sample_context(lease, decoded, {})
        context.params = dataclasses.replace(context.params, hot_pixel_count=0)
        contexts.append(context)
    return contexts


def simulated(context: SampleContext, params: SampleParams, tolerance: float | None = None) -> Voxels:
    """Simulate a camera of these parameters, float32; None takes the tolerance of the spec."""
    tolerance = context.spec.tolerance if tolerance is None else tolerance
    return simulate_clip(
        context.view, params, context.recipe, "float32", context.step_seconds, levels=context.levels,
        signal=context.signal, tolerance=tolerance,
    )  # fmt: skip


def at_threshold(params: SampleParams, threshold: float) -> SampleParams:
    """Return the same camera with both thresholds at ``threshold``, rounded to float32."""
    exact = float(np.float32(threshold))
    return dataclasses.replace(params, threshold_pos=exact, threshold_neg=exact)


NOISE_ROW, DRAW_ROW = "another noise seed", "another threshold draw"


def accuracy(model: Places, others: Mapping[str, Places], *, until: float) -> dict[str, Tallies]:
    """Return the tallies of settings that have one full model, and of two rows that give the scale.

    Args:
        model: the full model.
        others: by name; the same places in the same order.
        until: reading of ``time.monotonic`` after which no further place is compared; one is in any case.

    Returns:
        also under NOISE_ROW the model with the noise of another key, and under DRAW_ROW with the thresholds of another
        sample's draw.
    """
    tallies = {name: dict.fromkeys(THRESHOLDS, Tally()) for name in [*others, NOISE_ROW, DRAW_ROW]}
    for place, lease in enumerate(model.leases):
        if place and time.monotonic() >= until:
            break
        (exact,), other = seen(model, place), plan_sample(lease, lease.indices[1]).params
        cameras = {threshold: at_threshold(exact.params, threshold) for threshold in THRESHOLDS}
        truth = {threshold: simulated(exact, camera).voxels for threshold, camera in cameras.items()}
        for name, places in others.items():
            (context,) = [exact] if places == model else seen(places, place)
            for threshold, camera in cameras.items():
                made = truth[threshold] if places == model else simulated(context, camera).voxels
                tallies[name][threshold] += compare(made, truth[threshold])
        for threshold, camera in cameras.items():
            drawn = {"threshold_pos": other.threshold_pos, "threshold_neg": other.threshold_neg}
            for name, changes in ((NOISE_ROW, {"noise_key": other.noise_key}), (DRAW_ROW, drawn)):
                changed = dataclasses.replace(camera, **changes)
                tallies[name][threshold] += compare(simulated(exact, changed).voxels, truth[threshold])
    return tallies


def parts(places: Places, *, until: float) -> dict[str, Any]:
    """Return processor seconds of a sample by its parts, and the share of the samples in which each effect ran.

    The seconds of an effect are those that the kernel takes less without it.

    Args:
        until: as for :func:`accuracy`.
    """
    seconds: dict[str, list[float]] = {}
    ran: Counter[str] = Counter()
    substeps = steps = count = 0
    for place, lease in enumerate(places.leases):
        if place and time.monotonic() >= until:
            break
        before, (decoded,) = time.process_time(), decode_for(lease, lease.indices[:1], Folder(places.root))
        taken = {"decode": time.process_time() - before}
        before, (context, _) = time.process_time(), sample_context(lease, decoded, {})
        taken["view"] = time.process_time() - before
        taken["kernel"], made = _timed(context, context.params, context.spec.tolerance)
        whole, _ = _timed(context, context.params, 0.0)
        for name in context.params.effects:
            rest = {other: value for other, value in context.params.effects.items() if other != name}
            without = dataclasses.replace(context.params, effects=rest)
            taken[name] = whole - _timed(context, without, 0.0)[0]
        ran.update(list(made.given.params.effects))
        count, substeps, steps = count + 1, substeps + context.substeps, steps + len(context.source) - 1
        for name, value in taken.items():
            seconds.setdefault(name, []).append(value)
    return (
        {f"{name}_seconds": statistics.mean(values) for name, values in seconds.items()}
        | {f"{name}_share": ran[name] / count for name in seconds if name not in ("decode", "view", "kernel")}
        | {"substeps_per_step": substeps / steps or None}
    )


def _timed(context: SampleContext, params: SampleParams, tolerance: float) -> tuple[float, Voxels]:
    """Return the processor seconds of the faster of two simulations, and the result."""
    taken = []
    for _ in range(2):
        before, made = time.process_time(), simulated(context, params, tolerance)
        taken.append(time.process_time() - before)
    return min(taken), made

"""The rule by which a network ships, and the scores that it reads.

1. Figures are means over two kinds of data that no candidate was trained on: the recordings of `python -m bench
   recordings`, and `worlds`, photographs that move, as `python -m bench learn` draws them. Both weigh the same.
2. A network is out if its squared error is not below that of a constant grey: one for all pictures of a kind, their
   mean. The mean of each picture would be no fair measure, because events do not say how bright a picture is.
3. Of the others, a network is out if its correlation is more than 0.05 below the best one's.
4. Of those that are left, the one with the lowest LPIPS ships.

Real recordings are reported and decide nothing.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from torch import Tensor

from bench.accuracy.learn import score
from trainer.evaluation.config import folder_config
from trainer.evaluation.evaluate import Run, evaluate_sequence, find_recordings
from trainer.evaluation.metrics import GreyImage, Metric
from trainer.evaluation.score import mean_by_name, mean_over_sequences
from trainer.evaluation.voxelise import VoxelSettings
from trainer.models import VoxelNetwork
from v2v_protocol.errors import UsageError

SLACK = 0.05
"""How far below the best one's a correlation may be."""
GRIDS = (0, 5, 10, 20, 40, 80, math.inf)
"""Ends of the groups of windows, by the number of grids that a network has seen before."""


class Verdict(NamedTuple):
    """Hold what the rule says.

    Attributes:
        ships: name of the network that ships; None if all are out.
        out: why each other network does not ship, by name.
    """

    ships: str | None
    out: dict[str, str]


def apply(figures: Mapping[str, Mapping[str, float]]) -> Verdict:
    """Apply the rule.

    Args:
        figures: by name of the network: its means ``lpips``, ``correlation``, ``mse`` and ``grey_mse``.
    """
    out: dict[str, str] = {}
    for name, each in figures.items():
        if not each["mse"] < each["grey_mse"]:
            out[name] = f"squared error {each['mse']:.4f}, a constant grey has {each['grey_mse']:.4f}"
    left = {name: each for name, each in figures.items() if name not in out}
    best = max((each["correlation"] for each in left.values()), default=0.0)
    for name, each in left.items():
        if each["correlation"] < best - SLACK:
            out[name] = f"correlation {each['correlation']:.3f}, more than {SLACK} below {best:.3f}"
    left = {name: each for name, each in left.items() if name not in out}
    ships = min(left, key=lambda name: left[name]["lpips"], default=None)
    for name in left.keys() - {ships}:
        out[name] = f"LPIPS {left[name]['lpips']:.3f}, {ships} has {left[ships or name]['lpips']:.3f}"
    return Verdict(ships, out)


def _grey(_prediction: GreyImage, target: GreyImage) -> float:
    """Return the mean of the target [H, W]: a metric that needs no network."""
    return float(target.mean())


def _square(_prediction: GreyImage, target: GreyImage) -> float:
    """Return the mean of the target's squares."""
    return float(np.square(target, dtype=np.float64).mean())


def with_grey_mse(means: Mapping[str, float]) -> dict[str, float]:
    """Return mean metrics with ``grey_mse`` in place of ``grey`` and ``square``: the squared error of one grey for all
    pictures, their mean.
    """
    found = dict(means)
    return found | {"grey_mse": found.pop("square") - found.pop("grey") ** 2}


def on_recordings(
    folder: Path, network: VoxelNetwork, metrics: Mapping[str, Metric], window_events: int, *, published: bool
) -> tuple[dict[str, float], dict[str, dict[str, float]]]:
    """Score a network on a folder of recordings.

    Args:
        window_events: events of each window.
        published: take interpolated voxel grids, as published FireNet does.

    Returns:
        The mean over the recordings of each metric, and the squared error of a constant grey, ``grey_mse``; and the
        same over all scored windows, by the number of grids since the start, as far as there are any.

    Raises:
        UsageError: no window ends at a picture.
    """
    settings = VoxelSettings(bins=network.bins, kind="interpolated" if published else "discrete")
    every = {**metrics, "grey": _grey, "square": _square}
    run = Run(network, settings, every, window_events=window_events, score_blank=False)
    (data_set,) = folder_config(folder).data_sets
    scores = [evaluate_sequence(run, path, data_set) for path in find_recordings(folder, data_set).values()]
    scored = [each for each in scores if each.means]
    if not scored:
        raise UsageError(f"{folder}: no window of {window_events} events ends at a picture; write larger recordings")
    windows = [window for each in scored for window in each.by_frame]
    by_grids = {}
    for first, end in itertools.pairwise(GRIDS):
        among = [{name: window[name] for name in every} for window in windows if first <= window["frame"] < end]
        if among:
            name = f"grids {first + 1} to {end}" if end < math.inf else f"grids from {first + 1}"
            by_grids[name] = {"windows": len(among), **with_grey_mse(mean_by_name(among))}
    return with_grey_mse(mean_over_sequences(scored)), by_grids


def on_worlds(samples: tuple[Tensor, Tensor], network: VoxelNetwork, metrics: Mapping[str, Metric]) -> dict[str, float]:
    """Score a network on samples of `bench learn`: voxels [N, T, bins, H, W] and frames [N, T, 1, H, W], 0 .. 1."""
    voxels, frames = samples
    grey_mse = frames[:, frames.shape[1] // 2 :].var(correction=0)
    return score(network.forward_sequence, voxels, frames, metrics) | {"grey_mse": float(grey_mse)}


def mean_of(kinds: Sequence[Mapping[str, float]], lpips: str) -> dict[str, float]:
    """Return the figures of the rule: means over the kinds of data, with LPIPS (metric ``lpips``) as ``lpips``."""
    mean = mean_by_name(kinds)
    return {"lpips": mean.pop(lpips), **mean}

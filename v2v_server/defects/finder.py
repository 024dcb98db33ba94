"""Find the defects of a video from its frames, in the memory of a few."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import numpy.typing as npt

from v2v_server.corpus.scenes.analysis import SceneAnalysis, block_sums
from v2v_server.defects.bars import bars_of, common_bars
from v2v_server.defects.defect import BARS, BLACK, CUTS, DUPLICATES, STILL, Defect, Sides, Spans
from v2v_server.defects.steps import change_of, duplicated, is_cut, pattern_of, runs_of

_BARS_EVERY = 8
"""Frames."""
_STILL_LAG = 4
"""Frames over which a still picture does not change, so that slow motion counts."""
_STILL_CHANGE = 2 * 64
"""Change of a block, 1/64 grey level."""
_STILL_SHARE = 100
"""One of that number of blocks may change by more."""
_STILL_GAP = 2 * _STILL_LAG
"""Frames. A step at a keyframe of low quality, which shows nothing new, spoils the lag's frames and a few after it."""
_STILL_FRAMES = 16
_BLACK_LEVEL = 12 * 64
_BLACK_SHARE = 100
_BLACK_FRAMES = 4


def find_defects(pictures: Iterable[npt.NDArray[np.uint8]]) -> tuple[int, tuple[Defect, ...]]:
    """Find duplicated frames, hard cuts, bars, still and black stretches.

    Args:
        pictures: [N, H, W] uint8, full-range luma, or an iterable of N such pictures, which are read one by one.

    Returns:
        N, and at most one defect of each kind.
    """
    scene = SceneAnalysis()
    recent: list[npt.NDArray[np.int64]] = []
    changes: list[int] = []
    is_still: list[bool] = []
    is_black: list[bool] = []
    bars: list[tuple[int, int, int, int]] = []
    shape = 0, 0
    for number, picture in enumerate(pictures):
        scene.add(picture)
        blocks = block_sums(picture)
        shape = picture.shape[0], picture.shape[1]
        if recent:
            changes.append(change_of(recent[-1], blocks))
        recent = [*recent, blocks][-_STILL_LAG - 1 :]
        moved = int((np.abs(blocks - recent[0]) > _STILL_CHANGE).sum())
        is_still.append(moved * _STILL_SHARE <= blocks.size)
        is_black.append(int((blocks > _BLACK_LEVEL).sum()) * _BLACK_SHARE <= blocks.size)
        if number % _BARS_EVERY == 0 and not is_black[-1]:
            bars.append(bars_of(picture))
    count = len(is_black)
    if not count:
        return 0, ()
    black = np.array(is_black)
    still = np.array(is_still) & ~black
    repeats = duplicated(changes, recent[-1].size)
    pairs = tuple((step, step + 2) for step in np.flatnonzero(repeats).tolist())
    cuts = tuple((at - 1, at + 1) for at in scene.scene().shot_boundaries if is_cut(changes, at - 1))
    still_runs, black_runs = runs_of(still, _STILL_FRAMES, _STILL_GAP), runs_of(black, _BLACK_FRAMES)
    found = []
    if pairs:
        share = 1000 * len(pairs) // (count - 1)
        text = f"{_percent(share)} of the frames repeat the one before ({pattern_of(repeats)})"
        found.append(Defect(DUPLICATES, pairs, share, text))
    if cuts:
        found.append(Defect(CUTS, cuts, 1000 * len(cuts) // (count - 1), f"hard cuts or jumps: {len(cuts)}"))
    if (sides := common_bars(bars, *shape)) is not None:
        found.append(Defect(BARS, ((0, count),), 1000, f"bars: {_sides(sides)}", sides))
    found += [
        Defect(kind, spans, share, f"{_percent(share)} of the frames are {kind}")
        for kind, spans in ((STILL, still_runs), (BLACK, black_runs))
        if (share := _share(spans, count))
    ]
    return count, tuple(found)


def _share(spans: Spans, count: int) -> int:
    return 1000 * sum(end - first for first, end in spans) // count


def _percent(per_mille: int) -> str:
    return f"{(per_mille + 5) // 10}%"


def _sides(sides: Sides) -> str:
    names = ("top", sides.top), ("bottom", sides.bottom), ("left", sides.left), ("right", sides.right)
    return ", ".join(f"{name} {depth} px" for name, depth in names if depth)

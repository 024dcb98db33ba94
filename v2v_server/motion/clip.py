"""The levels between the frames of a clip: which steps are divided, into how many parts.

A step has n sub-steps if the longest motion of its cells, apart from the fastest tenth, is n - 1 to n times
``substep_px``; at most MOST_SUBSTEPS. A cell that moves by less than half of ``substep_px`` counts as still: its light
changes evenly. A step in which less than 1/256 of the cells move is not divided.
"""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from v2v_protocol.recipe import Recipe
from v2v_protocol.sample import SampleParams
from v2v_protocol.spec import MARGIN_PX, MOST_SUBSTEPS
from v2v_server.motion.lanes import CELL_PX
from v2v_server.motion.matching import UNITS_PER_PX, Vectors
from v2v_server.motion.plane import motions
from v2v_server.motion.pyramid import Cells, padded
from v2v_server.motion.warping import between
from v2v_server.simulation.draw import resized_size
from v2v_server.simulation.view import FrameArray, Window, contrast_table, crop_place, crop_region, resized
from v2v_server.simulation.voxel import FINE_STEPS, Levels, Moments

_LONGEST = 1 << 14
_LEAST_SHARE = 1 / 256
_FASTEST_SHARE = 0.1


def cells_of(params: SampleParams, recipe: Recipe, picture: Window) -> Cells:
    """Return the cells that a crop shows.

    Args:
        params, recipe: the draw and its recipe.
        picture: the usable picture without bars, which the draw refers to.
    """
    (top, rows), (left, columns) = (
        (int(cells[0]), int(cells[-1] - cells[0]) + 1) for cells in _shown_cells(params, recipe, picture)
    )
    return Cells(top, left, rows, columns)


def _shown_cells(
    params: SampleParams, recipe: Recipe, picture: Window
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Return row and column of the cell of the usable picture at the middle of each cell of the crop."""

    def shown(first: int, size: int, start: int, side: int) -> npt.NDArray[np.int64]:
        middles = first + CELL_PX // 2 + CELL_PX * np.arange(-(-size // CELL_PX))
        at: npt.NDArray[np.int64] = np.minimum((middles / params.scale).astype(np.int64), side - 1)
        return (start + at) // CELL_PX

    return (
        shown(params.crop_top_px, recipe.crop_height_px, picture.top_px, picture.height_px),
        shown(params.crop_left_px, recipe.crop_width_px, picture.left_px, picture.width_px),
    )


def levels_of(
    frames: FrameArray,
    params: SampleParams,
    recipe: Recipe,
    source_index: npt.NDArray[np.int64],
    substep_px: float,
    vectors: Vectors,
    picture: Window,
) -> Levels | None:
    """Return the levels between the frames of a sample, as its camera sees them.

    Memory: at most (MOST_SUBSTEPS - 1) x steps x crop x 2 bytes, 94 MiB for 200 steps of 128 x 128 px.

    Args:
        frames: [n, h, w] uint8, the ``source_window`` of the view with MARGIN_PX.
        params, recipe: the draw and its recipe.
        source_index: [steps + 1], which frame each position of the clip shows.
        substep_px: longest motion of a sub-step, above 0.
        vectors: [n, 2, rows, columns] of :func:`cells_of`: the motion to each frame from the one before, in the usable
            picture.
        picture: see :func:`cells_of`.

    Returns:
        the levels, for ``simulate_clip``; None if no step is divided.
    """
    down, across = _shown_cells(params, recipe, picture)
    vectors = vectors[:, :, down - down[0]][..., across - across[0]]
    top, left = crop_place(params, MARGIN_PX)
    if params.scale != 1.0:
        vectors = np.clip(np.rint(vectors * params.scale), -_LONGEST, _LONGEST).astype(np.int16)
        size = resized_size(frames.shape[1], frames.shape[2], params.scale)
        row, column, height, width = crop_region(params, recipe, *size, MARGIN_PX)
        frames = np.stack(
            [resized(frame, size, params.scale)[row : row + height, column : column + width] for frame in frames]
        )
    part = top, left, recipe.crop_height_px, recipe.crop_width_px
    levels = levels_between(frames, part, source_index, substep_px, vectors, mirrored=params.flip)
    if levels is not None and params.contrast != 0.0:
        table = contrast_table(params.contrast, 255 * FINE_STEPS)
        for level in levels.grey:  # one at a time: indices take 8 bytes a pixel
            level[...] = table[level]
    return levels


def levels_between(
    pictures: FrameArray,
    part: tuple[int, int, int, int],
    source_index: npt.NDArray[np.int64],
    substep_px: float,
    vectors: Vectors,
    *,
    mirrored: bool = False,
) -> Levels | None:
    """Return the levels between pictures.

    Args:
        pictures: [n, h, w] uint8.
        part: top, left, height and width of the part of them that is wanted.
        source_index: [steps + 1], which picture each position of the clip shows: the one before or the next.
        substep_px: longest motion of a sub-step, above 0.
        vectors: [n, 2, rows, columns], the motion to each picture from the one before, in cells of the part.
        mirrored: whether the levels show right and left exchanged.

    Returns:
        the levels; None if no step is divided.
    """
    top, left, height, width = part
    if min(height, width) < CELL_PX:
        return None
    shortest = math.ceil(substep_px * UNITS_PER_PX / 2)
    vectors = np.ascontiguousarray(vectors)
    divided = [
        (step, after, count - 1)
        for step, (before, after) in enumerate(pairwise(source_index.tolist()))
        if before != after and (count := substeps(vectors[after], substep_px)) > 1
    ]
    if not divided:
        return None
    counts = [count for _, _, count in divided]
    grey = np.empty((sum(counts), height, width), np.uint16)
    first, shown, later = 0, -1, pictures[:0]
    for _, after, count in divided:
        earlier = later if shown == after - 1 else padded(np.ascontiguousarray(pictures[after - 1]))
        shown, later = after, padded(np.ascontiguousarray(pictures[after]))
        between(earlier, later, vectors[after], shortest, top, left, grey[first : first + count], mirrored=mirrored)
        first += count
    at = np.repeat([step for step, _, _ in divided], counts)
    share = np.concatenate([np.arange(1, count + 1) / (count + 1) for count in counts])
    return Levels(Moments(at, share), grey)


def substeps(vectors: Vectors, substep_px: float) -> int:
    """Return the number of sub-steps of a step with this motion: 1 .. MOST_SUBSTEPS."""
    squares = np.square(vectors, dtype=np.int64).sum(axis=0)
    moving = squares[squares >= max(math.ceil(substep_px * UNITS_PER_PX / 2) ** 2, 1)]
    if len(moving) < _LEAST_SHARE * vectors[0].size or not len(moving):
        return 1
    which = int(len(moving) * (1 - _FASTEST_SHARE))
    longest = math.sqrt(np.partition(moving, which)[which]) / UNITS_PER_PX
    return 1 + int(min(longest / substep_px, MOST_SUBSTEPS - 1))  # the quotient may be infinite


def load() -> None:
    """Load this folder's kernels from numba's cache, or compile them."""
    first = (np.arange(32 * 32) * 37 % 251).astype(np.uint8).reshape(32, 32)
    pictures = np.stack([first, np.roll(first, 3, 1)])
    levels_between(pictures, (0, 0, 32, 32), np.arange(2), 1.0, motions(pictures))

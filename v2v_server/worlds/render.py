"""Render the pictures of a world at any times: levels of 12 bits, the same on every host.

A pyramid has the photograph in 12 bits and its means of 2 x 2, each rounded. A layer that shows f pixels of the
photograph in one of the picture (the root of the area, at the middle of the crop) is read from the levels 2^l <= f <
2^(l+1) and l + 1, each bilinearly, in the ratio 2 - f / 2^l to f / 2^l - 1: a zoom has no moment at which the picture
gets sharper at once. Below f = 1 level 0 is read alone. Beyond its border the photograph is mirrored.

Compiled without fast-math and without contraction to fused multiply-add: the instruction set changes the speed, never
a bit.
"""

# mypy: allow-untyped-defs, allow-untyped-calls
from __future__ import annotations

from typing import Any, NamedTuple

import numba
import numpy as np
import numpy.typing as npt

from v2v_server.simulation.view import Window
from v2v_server.simulation.voxel import Levels, Moments
from v2v_server.worlds.world import Doubles, World

WHITEST = 4095
"""The highest level of a rendered picture."""
LEAST_DEPTH = 2.0**-6
"""A place that is farther away, or behind the camera, counts as that far: only what is never seen can be."""
compiled: Any = numba.njit(nogil=True, cache=True, error_model="numpy")
"""Decorator of this folder's compiled functions."""


class PhotoPyramid(NamedTuple):
    """A photograph from fine to coarse.

    Attributes:
        grey: [pixels of all levels] float32, one level after the other, whole numbers from 0 to WHITEST.
        first: [levels] int64, where each begins.
        size: [levels, 2] int64, height and width of each, at least 2.
    """

    grey: npt.NDArray[np.float32]
    first: npt.NDArray[np.int64]
    size: npt.NDArray[np.int64]


def pyramid_of(grey: npt.NDArray[Any]) -> PhotoPyramid:
    """Return the pyramid of a photograph, [H, W] uint8 or uint16 grey levels from black to white of their type."""
    white = np.iinfo(grey.dtype).max
    table = ((np.arange(white + 1, dtype=np.uint64) * (2 * WHITEST) + white) // (2 * white)).astype(np.float32)
    levels = [np.pad(table[grey], [(0, max(0, 2 - side)) for side in grey.shape], "edge")]
    while min(levels[-1].shape) > 2:
        levels.append(_halved(levels[-1]))
    first = np.cumsum([0, *(level.size for level in levels)])[:-1]
    return PhotoPyramid(
        np.concatenate([level.ravel() for level in levels]), first, np.array([each.shape for each in levels])
    )


@compiled
def _halved(picture):
    """Return rounded means of 2 x 2; an odd last row or column counts twice."""
    height, width = picture.shape
    half = np.empty(((height + 1) // 2, (width + 1) // 2), np.float32)
    for y in range(half.shape[0]):
        above, below = picture[2 * y], picture[min(2 * y + 1, height - 1)]
        for x in range(half.shape[1]):
            right = min(2 * x + 1, width - 1)
            total = (above[2 * x] + above[right]) + (below[2 * x] + below[right])
            half[y, x] = np.floor((total + np.float32(2)) * np.float32(0.25))
    return half


def render(
    pyramid: PhotoPyramid, world: World, seconds: Doubles, window: Window | None = None
) -> npt.NDArray[np.uint16]:
    """Return the pictures of a world.

    Args:
        pyramid: of its photograph.
        world: the draw.
        seconds: [n] moments.
        window: the part to render, px of the picture (``world.py``), which it may leave; None: the crop.

    Returns:
        [n, h, w] uint16, 0 .. WHITEST, not mirrored.
    """
    top, left, height, width = world.crop if window is None else window
    out = np.empty((len(seconds), height, width), np.uint16)
    places, outlines = world.places(seconds), world.outlines
    back = inverse(places)
    middle = world.crop.left_px + world.crop.width_px / 2, world.crop.top_px + world.crop.height_px / 2
    depth = places[..., 2, 0] * middle[0] + places[..., 2, 1] * middle[1] + places[..., 2, 2]
    shown = np.sqrt(_determinant(places) / (depth * depth * depth))
    shown[:, 0] = np.maximum(shown[:, 0], 1 << world.focus)
    boxes = np.full((*shown.shape, 4), (0, height, 0, width))
    for layer, outline in enumerate(outlines, 1):
        reach = outline[2] * (1.0 + 1.0 / (6.0 * outline[-1])) * np.array([-1.0, 1.0])
        x, y = (part.ravel() for part in np.meshgrid(outline[0] + reach, outline[1] + reach))
        x, y = taken(back[:, layer, None], x, y)
        for side, (place, first, size) in enumerate(((y, top, height), (x, left, width))):
            ends = np.floor(place.min(axis=1) - first), np.ceil(place.max(axis=1) - first)
            boxes[:, layer, 2 * side : 2 * side + 2] = np.clip(np.stack(ends, axis=1), 0, size)
    _render(
        *pyramid, places, shown, boxes, outlines, top + 0.5, left + 0.5, np.empty((3, width)),
        np.empty((4, width), np.float32), np.empty((2, width), np.int32), np.empty((height, width), np.float32), out,
    )  # fmt: skip
    return out


def levels_between(
    pyramid: PhotoPyramid,
    world: World,
    seconds: Doubles,
    source_index: npt.NDArray[np.int64],
    substep_px: float,
    most_substeps: int,
) -> Levels | None:
    """Return the levels between the frames of a sample, rendered at their times.

    Args:
        pyramid, world: the photograph and the draw.
        seconds: [n], moment of each frame.
        source_index: [steps + 1], which frame each position of the clip shows.
        substep_px: longest motion of a sub-step, above 0.
        most_substeps: of a step.

    Returns:
        the levels, in 12 bits as the frames, mirrored if the crop is; None if no step is divided.
    """
    top, left, height, width = world.crop
    x, y = (part.ravel() for part in np.meshgrid(left + width * np.arange(3) / 2, top + height * np.arange(3) / 2))
    places = world.places(seconds)
    to_x, to_y = taken(inverse(places[1:])[:, :, None], *taken(places[:-1, :, None], x, y))
    longest = np.sqrt(((to_x - x) * (to_x - x) + (to_y - y) * (to_y - y)).max(axis=(1, 2)))
    step = np.flatnonzero(np.diff(source_index))
    shown = source_index[step]
    more = np.minimum(longest[shown] / substep_px, most_substeps - 1).astype(np.int64)
    if not more.any():
        return None
    share = np.concatenate([np.arange(1, count + 1) / (count + 1) for count in more])
    begin, end = np.repeat(seconds[shown], more), np.repeat(seconds[shown + 1], more)
    grey = render(pyramid, world, begin + share * (end - begin))
    return Levels(Moments(np.repeat(step, more), share), np.ascontiguousarray(grey[:, :, ::-1]) if world.flip else grey)


def inverse(places: Doubles) -> Doubles:
    """Return the inverse homographies, [..., 3, 3]."""
    return _adjugate(places) / _determinant(places)[..., None, None]


def taken(places: Doubles, x: Doubles, y: Doubles) -> tuple[Doubles, Doubles]:
    """Return x and y of places through homographies."""
    across, down, depth = (places[..., row, 0] * x + places[..., row, 1] * y + places[..., row, 2] for row in range(3))
    depth = np.maximum(depth, LEAST_DEPTH)
    return across / depth, down / depth


def _adjugate(places: Doubles) -> Doubles:
    found = np.empty_like(places)
    for row, column in np.ndindex(3, 3):
        (a, b), (c, d) = ((axis - 2, axis - 1) for axis in (row, column))
        found[..., column, row] = places[..., a, c] * places[..., b, d] - places[..., a, d] * places[..., b, c]
    return found


def _determinant(places: Doubles) -> Doubles:
    first, second, third = (places[..., 0, axis] * _adjugate(places)[..., axis, 0] for axis in range(3))
    total: Doubles = first + second + third
    return total


@compiled
def cover(outline, x, y):
    """Return the share of what is behind a patch that it covers at a place of the photograph (``world.Layer``)."""
    a, b = (x - outline[0]) / outline[2], (y - outline[1]) / outline[2]
    real, imaginary = a * a - b * b, 2.0 * a * b
    square = a * a + b * b
    q = (outline[3] * square + outline[4] * real + outline[5] * imaginary) * square
    q += outline[6] * (a * real - b * imaginary) + outline[7] * (a * imaginary + b * real)
    q += outline[8] * (real * real - imaginary * imaginary) + outline[9] * (2.0 * real * imaginary)
    u = min(max(outline[10] * (1.0 - q) + 0.5, 0.0), 1.0)
    return u * u * (3.0 - 2.0 * u)


@compiled
def _along(place, x, y, across, down, count):
    """Write the places of the photograph that a row shows."""
    across_y = place[0, 1] * y + place[0, 2]
    down_y, depth_y = place[1, 1] * y + place[1, 2], place[2, 1] * y + place[2, 2]
    for i in range(count):
        column = x + np.float64(np.int32(i))
        share = 1.0 / (place[2, 0] * column + depth_y)
        across[i] = (place[0, 0] * column + across_y) * share
        down[i] = (place[1, 0] * column + down_y) * share


@compiled
def _split(places, side, scale, pixels, whole, part, count):
    """Write number and fraction of the first of the two pixels of a level between which the places of an axis lie."""
    twice, share, most = 2.0 * side, 1.0 / (2.0 * side), np.float64(pixels - 1)
    for i in range(count):
        x = places[i] - twice * np.floor(places[i] * share)
        x = min(max(min(x, twice - x) * scale - 0.5, 0.0), most)
        first = np.floor(min(x, most - 1.0))
        whole[i], part[i] = np.int32(first), np.float32(x - first)


@compiled
def _read(grey, first, pitch, columns, rows, x, y, found, count):
    """Write the levels between four pixels each."""
    pitch, first = np.int32(pitch), np.int64(first)
    for i in range(count):
        at = np.uint64(first + np.int64(rows[i] * pitch + columns[i]))
        a, b = grey[at], grey[at + np.uint64(1)]
        at += np.uint64(pitch)
        c, d = grey[at], grey[at + np.uint64(1)]
        above, below = a + (b - a) * x[i], c + (d - c) * x[i]
        found[i] = above + (below - above) * y[i]


@compiled
def _render(grey, first, size, places, shown, boxes, outlines, top, left, doubles, singles, wholes, picture, out):
    """Render in memory of the caller; ``top`` and ``left`` are the middle of the first pixel."""
    across, down, share = doubles[0], doubles[1], doubles[2]
    x, y, found, coarse = singles[0], singles[1], singles[2], singles[3]
    columns, rows = wholes[0], wholes[1]
    for number in range(len(out)):
        for layer in range(places.shape[1]):
            level, part = 0, shown[number, layer]
            while part >= 2.0 and level < len(size) - 1:
                level, part = level + 1, part * 0.5
            blends = part > 1.0 and level < len(size) - 1
            begin, end = boxes[number, layer, 2], boxes[number, layer, 3]
            count = max(end - begin, 0)
            for row in range(boxes[number, layer, 0], boxes[number, layer, 1]):
                _along(places[number, layer], left + begin, top + row, across, down, count)
                for finer in range(level + blends, level - 1, -1):
                    scale = 1.0 / (1 << finer)
                    _split(across, size[0, 1], scale, size[finer, 1], columns, x, count)
                    _split(down, size[0, 0], scale, size[finer, 0], rows, y, count)
                    into = coarse if finer > level else found
                    _read(grey, first[finer], size[finer, 1], columns, rows, x, y, into, count)
                if blends:
                    weight = np.float32(part - 1.0)
                    for i in range(count):
                        found[i] += (coarse[i] - found[i]) * weight
                if layer == 0:
                    for i in range(count):
                        picture[row, i] = found[i]
                    continue
                for i in range(count):
                    share[i] = cover(outlines[layer - 1], across[i], down[i])
                for i in range(count):
                    behind = picture[row, begin + i]
                    picture[row, begin + i] = behind + (found[i] - behind) * np.float32(share[i])
        for row in range(out.shape[1]):
            for i in range(out.shape[2]):
                out[number, row, i] = np.uint16(np.int32(picture[row, i] + np.float32(0.5)))

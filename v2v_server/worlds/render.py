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
_SMALLEST_SIDE_PX = 2
compiled: Any = numba.njit(nogil=True, cache=True, error_model="numpy")
"""Decorator of this folder's compiled functions."""


class PhotoPyramid(NamedTuple):
    """A photograph from fine to coarse.

    Attributes:
        grey: [pixels of all levels] uint16, one level after the other, 0 .. WHITEST.
        first: [levels] int64, where each begins.
        size: [levels, 2] int64, height and width of each.
    """

    grey: npt.NDArray[np.uint16]
    first: npt.NDArray[np.int64]
    size: npt.NDArray[np.int64]


def pyramid_of(grey: npt.NDArray[Any]) -> PhotoPyramid:
    """Return the pyramid of a photograph, [H, W] uint8 or uint16 grey levels from black to white of their type."""
    white = np.iinfo(grey.dtype).max
    levels = [((grey.astype(np.uint32) * (2 * WHITEST) + white) // (2 * white)).astype(np.uint16)]
    while min(levels[-1].shape) >= 2 * _SMALLEST_SIDE_PX:
        levels.append(_halved(levels[-1]))
    sizes = np.array([level.shape for level in levels])
    ends = np.cumsum([level.size for level in levels])
    return PhotoPyramid(np.concatenate([level.ravel() for level in levels]), np.concatenate(([0], ends[:-1])), sizes)


@compiled
def _halved(picture):
    """Return rounded means of 2 x 2; an odd last row or column is repeated."""
    height, width = picture.shape
    half = np.empty(((height + 1) // 2, (width + 1) // 2), np.uint16)
    for y in range(half.shape[0]):
        above, below = picture[2 * y], picture[min(2 * y + 1, height - 1)]
        for x in range(half.shape[1]):
            right = min(2 * x + 1, width - 1)
            total = np.int64(above[2 * x]) + above[right] + below[2 * x] + below[right]
            half[y, x] = (total + 2) >> 2
    return half


def render(
    pyramid: PhotoPyramid, world: World, seconds: Doubles, window: Window | None = None
) -> npt.NDArray[np.uint16]:
    """Return the pictures of a world.

    Args:
        pyramid: of its photograph.
        seconds: [n] moments.
        window: the part to render, px of the picture (:mod:`v2v_server.worlds.world`), which it may leave; None: the
            crop.

    Returns:
        [n, h, w] uint16, 0 .. WHITEST, not mirrored.
    """
    top, left, height, width = world.crop if window is None else window
    out = np.empty((len(seconds), height, width), np.uint16)
    places = world.places(seconds)
    _render(*pyramid, places, _pixels_shown(places, world), patches_of(world), top, left, out)
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
    there = moved(places[:-1, :, None], inverse(places[1:])[:, :, None], x, y)
    longest = np.sqrt(((there[0] - x) ** 2 + (there[1] - y) ** 2).max(axis=(1, 2)))
    counts = 1 + np.minimum(longest / substep_px, most_substeps - 1).astype(np.int64)
    step = np.flatnonzero(np.diff(source_index))
    shown = source_index[step]
    more = counts[shown] - 1
    if not more.any():
        return None
    share = np.concatenate([np.arange(1, count + 1) / (count + 1) for count in more])
    begin, end = np.repeat(seconds[shown], more), np.repeat(seconds[shown + 1], more)
    grey = render(pyramid, world, begin + share * (end - begin))
    return Levels(Moments(np.repeat(step, more), share), np.ascontiguousarray(grey[:, :, ::-1]) if world.flip else grey)


def inverse(places: Doubles) -> Doubles:
    """Return the inverse homographies, [..., 3, 3]."""
    return _adjugate(places) / _determinant(places)[..., None, None]


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


def moved(places: Doubles, back: Doubles, x: Doubles, y: Doubles) -> tuple[Doubles, Doubles]:
    """Return where the points that places of the picture show are in another picture, by its inverse homography."""
    for matrix in (places, back):
        across, down, below = (
            matrix[..., row, 0] * x + matrix[..., row, 1] * y + matrix[..., row, 2] for row in range(3)
        )
        x, y = across / below, down / below
    return x, y


def patches_of(world: World) -> Doubles:
    """Return the patches' places, radii and outlines, [patches, 11]."""
    rows = [(*patch.place_px, patch.radius_px, *patch.outline) for patch in world.patches]
    return np.array(rows, np.float64).reshape(-1, 11)


def _pixels_shown(places: Doubles, world: World) -> Doubles:
    """Return how many pixels of the photograph one of the picture shows in each direction, [n, layers], at the middle
    of the crop.
    """
    across = world.crop.left_px + world.crop.width_px / 2
    down = world.crop.top_px + world.crop.height_px / 2
    below = places[..., 2, 0] * across + places[..., 2, 1] * down + places[..., 2, 2]
    area = _determinant(places) / (below * below * below)
    shown: Doubles = np.sqrt(np.abs(area))
    shown[:, 0] = np.maximum(shown[:, 0], 1 << world.focus)
    return shown


@compiled
def cover(patch, x, y):
    """Return the share of what is behind a patch that it covers at a place of the photograph (``world.Patch``)."""
    a, b = (x - patch[0]) / patch[2], (y - patch[1]) / patch[2]
    real, imaginary = a * a - b * b, 2.0 * a * b
    square = a * a + b * b
    q = patch[3] * square * square + (patch[4] * real + patch[5] * imaginary) * square
    q += patch[6] * (a * real - b * imaginary) + patch[7] * (a * imaginary + b * real)
    q += patch[8] * (real * real - imaginary * imaginary) + patch[9] * (2.0 * real * imaginary)
    u = min(max(patch[10] * (1.0 - q) + 0.5, 0.0), 1.0)
    return u * u * (3.0 - 2.0 * u)


@compiled
def _read(grey, first, height, width, x, y):
    """Return the level between four pixels, at a place in px of this level."""
    x, y = min(max(x - 0.5, 0.0), width - 1.0), min(max(y - 0.5, 0.0), height - 1.0)
    column, row = min(int(x), max(width - 2, 0)), min(int(y), max(height - 2, 0))
    right, down = min(column + 1, width - 1) - column, (min(row + 1, height - 1) - row) * width
    x, y = np.float32(x - column), np.float32(y - row)
    at = first + row * width + column
    a, b = np.float32(grey[at]), np.float32(grey[at + right])
    c, d = np.float32(grey[at + down]), np.float32(grey[at + down + right])
    above, below = a + (b - a) * x, c + (d - c) * x
    return above + (below - above) * y


@compiled
def _folded(x, size):
    """Return the place in a picture that is mirrored at its borders."""
    x -= 2.0 * size * np.floor(x / (2.0 * size))
    return min(x, 2.0 * size - x)


@compiled
def _render(grey, first, size, places, shown, patches, top, left, out):
    height, width = size[0]
    for number in range(len(out)):
        for row in range(out.shape[1]):
            y = top + row + 0.5
            for column in range(out.shape[2]):
                x = left + column + 0.5
                value = np.float32(0)
                for layer in range(places.shape[1]):
                    h = places[number, layer]
                    below = 1.0 / (h[2, 0] * x + h[2, 1] * y + h[2, 2])
                    across = (h[0, 0] * x + h[0, 1] * y + h[0, 2]) * below
                    down = (h[1, 0] * x + h[1, 1] * y + h[1, 2]) * below
                    share = np.float32(1)
                    if layer:
                        share = np.float32(cover(patches[layer - 1], across, down))
                        if share == 0:
                            continue
                    across, down = _folded(across, width), _folded(down, height)
                    level, part = 0, shown[number, layer]
                    while part >= 2.0 and level < len(size) - 1:
                        level += 1
                        part *= 0.5
                    scale = 1.0 / (1 << level)
                    found = _read(grey, first[level], size[level, 0], size[level, 1], across * scale, down * scale)
                    if part > 1.0 and level < len(size) - 1:
                        scale *= 0.5
                        level += 1
                        coarse = _read(grey, first[level], size[level, 0], size[level, 1], across * scale, down * scale)
                        found += (coarse - found) * np.float32(part - 1.0)
                    value += (found - value) * share
                out[number, row, column] = np.uint16(value + np.float32(0.5))

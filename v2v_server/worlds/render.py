"""Render the pictures of a world at any times, in levels of 12 to 16 bits; where its points go, and what hides them.

A pyramid has the photograph in these bits and its means of 2 x 2, each rounded. A layer that shows f pixels of the
photograph in one of the picture (the root of the area, at the middle of the crop) is read from the levels 2^l <= f <
2^(l+1) and l + 1, each bilinearly, in the ratio 2 - f / 2^l to f / 2^l - 1: a zoom has no moment at which the picture
gets sharper at once. Below f = 1 level 0 is read alone. Beyond its border the photograph is mirrored.

Everything has the same bytes on every host: it is compiled without fast-math and without contraction to fused
multiply-add, so the instruction set changes the speed, never a bit.
"""

# mypy: allow-untyped-defs, allow-untyped-calls
from __future__ import annotations

from typing import Any, NamedTuple

import numba
import numpy as np
import numpy.typing as npt

from v2v_server.simulation.vectors import use_widest_vectors
from v2v_server.simulation.voxel import Levels, Moments
from v2v_server.video.picture import MOST_BITS
from v2v_server.worlds.world import Doubles, World

_LOOKED_AT = 4
"""Of as many rows and columns, one is looked at to divide a step by how the light changes."""
_FASTEST_SHARE = 100
"""The fastest of as many pixels that change does not count there."""
_LEAST_PART = 2.0**-14
"""A smaller share of the coarser level changes no level by a half. A picture in its own size reads none of it."""
_LEAST_DEPTH = 2.0**-6
"""Smallest depth that is divided by. What the camera sees is always deeper."""
compiled: Any = numba.njit(nogil=True, cache=True, error_model="numpy")
"""Decorator of this folder's compiled functions."""


class PhotoPyramid(NamedTuple):
    """A photograph from fine to coarse.

    Attributes:
        grey: [pixels of all levels] float32, one level after the other, whole numbers from 0 to white.
        first: [levels] int64, where each begins.
        size: [levels, 2] int64, height and width of each, at least 2.
    """

    grey: npt.NDArray[np.float32]
    first: npt.NDArray[np.int64]
    size: npt.NDArray[np.int64]


def pyramid_of(grey: npt.NDArray[Any], bits: int = MOST_BITS) -> PhotoPyramid:
    """Return the pyramid of a photograph, [H, W] uint8 or uint16 grey levels from black to white of their type.

    Args:
        grey: the photograph.
        bits: of a level of the pyramid, at most 16.
    """
    white, whitest = np.iinfo(grey.dtype).max, 2**bits - 1
    table = ((np.arange(white + 1, dtype=np.uint64) * (2 * whitest) + white) // (2 * white)).astype(np.float32)
    levels = [np.pad(table[grey], [(0, max(0, 2 - side)) for side in grey.shape], "edge")]
    while min(levels[-1].shape) > 2:
        level = np.pad(levels[-1], [(0, side % 2) for side in levels[-1].shape], "edge")
        total = level[::2, ::2] + level[::2, 1::2] + level[1::2, ::2] + level[1::2, 1::2]
        levels.append(np.floor((total + np.float32(2)) * np.float32(0.25)))
    first, sizes = np.cumsum([0, *(level.size for level in levels)])[:-1], np.array([level.shape for level in levels])
    return PhotoPyramid(np.concatenate([level.ravel() for level in levels]), first, sizes)


def render(pyramid: PhotoPyramid, world: World, seconds: Doubles, every: int = 1) -> npt.NDArray[np.uint16]:
    """Return the pictures of a world.

    Args:
        pyramid: of its photograph.
        world: the draw.
        seconds: [n] moments.
        every: of as many rows and columns, the first is rendered.

    Returns:
        [n, H, W] uint16, the crop, in levels of the pyramid, not mirrored; with ``every``, of fewer rows and columns.
    """
    top, left, *sides = world.crop
    height, width = (-(-side // every) for side in sides)
    out, places, outlines = np.empty((len(seconds), height, width), np.uint16), world.places(seconds), world.outlines
    back, shown = _inverse(places)
    shown[:, 0] = np.maximum(shown[:, 0], 1 << world.focus)
    boxes = np.full((*shown.shape, 4), (0, height, 0, width))
    for layer, outline in enumerate(outlines, 1):
        # A patch covers nothing beyond this.
        reach = outline[2] * (1.0 + 1.0 / (6.0 * outline[8])) * np.array([-1.0, 1.0])
        corners = (part.ravel() for part in np.meshgrid(outline[0] + reach, outline[1] + reach))
        ends = (np.stack(_taken(back[:, layer, None], *corners)) - np.array([left, top])[:, None, None]) / every
        for axis, side in enumerate((width, height)):
            box = np.floor(ends[axis].min(axis=1)), np.ceil(ends[axis].max(axis=1))
            boxes[:, layer, 2 - 2 * axis : 4 - 2 * axis] = np.clip(np.stack(box, axis=1), 0, side)
    places[..., :2] *= every
    _render(
        *pyramid, places, shown, boxes, outlines, (top + 0.5) / every, (left + 0.5) / every, np.empty((3, width)),
        np.empty((4, width), np.float32), np.empty((2, width), np.int32), np.empty((height, width), np.float32), out,
    )  # fmt: skip
    return out


def parts_by_motion(world: World, seconds: Doubles, substep_px: float, most_parts: int) -> npt.NDArray[np.int64]:
    """Return the number of sub-steps between each moment and the next that move by ``substep_px`` at most, [n - 1].

    Args:
        world: the draw.
        seconds: [n] moments.
        substep_px: longest motion of a sub-step, above 0.
        most_parts: largest number of sub-steps.
    """
    top, left, height, width = world.crop
    places, halves = world.places(seconds), np.arange(3) / 2
    x, y = (part.ravel() for part in np.meshgrid(left + width * halves, top + height * halves))
    to_x, to_y = _taken(_inverse(places[1:])[0][:, :, None], *_taken(places[:-1, :, None], x, y))
    longest = np.sqrt(((to_x - x) * (to_x - x) + (to_y - y) * (to_y - y)).max(axis=(1, 2)))
    more: npt.NDArray[np.int64] = np.minimum(longest / substep_px, most_parts - 1).astype(np.int64)
    return more + 1


def parts_by_change(
    pyramid: PhotoPyramid,
    world: World,
    seconds: Doubles,
    changes: npt.NDArray[np.float32],
    share: float,
    most_parts: int,
) -> npt.NDArray[np.int64]:
    """Return the number of sub-steps between each moment and the next in which 99 % of the pixels that change do so by
    a share of their threshold at most, [n - 1].

    It is told from the shortest sub-step after each moment, so light that comes back does not hide.

    Args:
        pyramid, world: the photograph and the draw.
        seconds: [n] moments.
        changes: [2, levels], log intensity of each level in thresholds of brighter and of darker events.
        share: of the threshold, above 0.
        most_parts: largest number of sub-steps.
    """
    begin, soon = (
        render(pyramid, world, moments, _LOOKED_AT).reshape(len(moments), -1)
        for moments in (seconds[:-1], seconds[:-1] + np.diff(seconds) / most_parts)
    )
    brighter, darker = (table[soon] - table[begin] for table in changes)
    change = np.sort(np.maximum(brighter, -darker), axis=1)
    last = change.shape[1] - 1 - np.count_nonzero(change, axis=1) // _FASTEST_SHARE
    fastest = change[np.arange(len(change)), last] * np.float32(most_parts)
    parts: npt.NDArray[np.int64] = np.clip(np.ceil(fastest / share), 1, most_parts).astype(np.int64)
    return parts


def levels_between(
    pyramid: PhotoPyramid,
    world: World,
    seconds: Doubles,
    source_index: npt.NDArray[np.int64],
    parts: npt.NDArray[np.int64],
) -> Levels | None:
    """Return the levels between the frames of a sample, rendered at their times.

    Args:
        pyramid, world: the photograph and the draw.
        seconds: [n], moment of each frame.
        source_index: [steps + 1], which frame each position of the clip shows.
        parts: [n - 1], sub-steps between each frame and the next, at least 1.

    Returns:
        the levels, in the bits of the frames, mirrored if the crop is; None if no step is divided.
    """
    step = np.flatnonzero(np.diff(source_index))
    shown = source_index[step]
    more = parts[shown] - 1
    if not more.any():
        return None
    share = np.concatenate([np.arange(1, count + 1) / (count + 1) for count in more])
    begin, end = np.repeat(seconds[shown], more), np.repeat(seconds[shown + 1], more)
    grey = render(pyramid, world, begin + share * (end - begin))
    return Levels(Moments(np.repeat(step, more), share), np.ascontiguousarray(grey[:, :, ::-1]) if world.flip else grey)


def flow_of(
    world: World, seconds: float, other_seconds: float
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.uint8]]:
    """Return the exact flow of the crop from one moment to another.

    Args:
        world: the draw.
        seconds: the moment on whose grid it is.
        other_seconds: the moment that it leads to.

    Returns:
        [2, H, W], (x, y), px of the crop; [1, H, W], 1 where the point is seen at the other moment.
    """
    grid, _, (there,) = _pixels(world, seconds, [other_seconds])
    there[..., :2] -= grid
    there[..., 0] *= -1.0 if world.flip else 1.0
    flow, valid = _turned(world, there[..., :2]), _turned(world, there[..., 2:])
    return flow.astype(np.float32), valid.astype(np.uint8)


def masks_of(world: World, seconds: float) -> npt.NDArray[np.uint8]:
    """Return which layer each pixel of the crop shows, [1, H, W]: 0 the photograph, 1 the first patch."""
    return _turned(world, _pixels(world, seconds, [])[1][..., None])


def tracks_of(world: World, seconds: Doubles) -> npt.NDArray[np.float32]:
    """Return the paths of the world's points, [n, N, 3]: x and y in px of the crop, and 1 where the point is seen."""
    (start, end), (_, _, height, width) = world.seconds, world.crop
    at, points = start + world.points[:, 2] * (end - start), world.points[:, :2] * (float(width), float(height))
    tracks = _follow(world, at, points, seconds)[1]
    if world.flip:
        tracks[..., 0] = width - tracks[..., 0]
    return tracks.astype(np.float32)


def _pixels(world: World, seconds: float, others: list[float]) -> tuple[Doubles, npt.NDArray[np.uint8], Doubles]:
    """Follow what each pixel of the crop shows; return [H, W, 2], their middles, [H, W], layers, and [n, H, W, 3]."""
    _, _, height, width = world.crop
    grid = np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), axis=-1)
    layers, tracks = _follow(world, np.array([seconds]), grid.reshape(-1, 2), np.array(others, np.float64))
    return grid, layers.reshape(height, width), tracks.reshape(-1, height, width, 3)


def _turned(world: World, values: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return values [H, W, k] as arrays [k, H, W], mirrored if the crop is."""
    return np.ascontiguousarray((values[:, ::-1] if world.flip else values).transpose(2, 0, 1))


def _follow(world: World, at: Doubles, points: Doubles, seconds: Doubles) -> tuple[npt.NDArray[np.uint8], Doubles]:
    """Follow what is in front at places of the crop.

    A place shows the frontmost layer that covers at least half of what is behind it. Its point is the place of the
    photograph on that layer. It is seen at another moment if it lies in the crop then, and no layer in front covers
    half of it there.

    Args:
        world: the draw.
        at: [N] or [1], moment of each place.
        points: [N, 2], the places, px of the crop.
        seconds: [n] moments.

    Returns:
        [N], the layers; [n, N, 3], where each point is in the crop, and 1 where it is seen.
    """
    layers, tracks = np.empty(len(points), np.uint8), np.empty((len(seconds), len(points), 3))
    places = world.places(np.concatenate([at, seconds]))
    at_first, places = places[: len(at)], places[len(at) :]
    _walk(at_first, points, places, _inverse(places)[0], world.outlines, *world.crop, layers, tracks)
    return layers, tracks


def _inverse(places: Doubles) -> tuple[Doubles, Doubles]:
    """Return the inverse homographies, [..., 3, 3]; how many pixels of the photograph one of the picture shows at the
    middle of the crop, in each direction, [...].
    """
    found = np.empty_like(places)
    for row, column in np.ndindex(3, 3):
        (a, b), (c, d) = ((axis - 2, axis - 1) for axis in (row, column))
        found[..., column, row] = places[..., a, c] * places[..., b, d] - places[..., a, d] * places[..., b, c]
    first, second, third = (places[..., 0, axis] * found[..., axis, 0] for axis in range(3))
    area = first + second + third  # the determinant, because the depth there is 1
    return found / area[..., None, None], np.sqrt(area)


def _taken(places: Doubles, x: Doubles, y: Doubles) -> tuple[Doubles, Doubles]:
    """Return x and y of places through homographies."""
    across, down, depth = (places[..., row, 0] * x + places[..., row, 1] * y + places[..., row, 2] for row in range(3))
    depth = np.maximum(depth, _LEAST_DEPTH)
    return across / depth, down / depth


@compiled
def _numbers(outline):
    """Return an outline as numbers: a loop that reads them from an array becomes no vector instructions."""
    size = 1.0 / outline[2]
    return outline[0], outline[1], size, outline[3], outline[4], outline[5], outline[6], outline[7], outline[8]


@compiled
def _cover(numbers, x, y):
    """Return the share of what is behind a patch that it covers at a place of the photograph (``world.Layer``)."""
    middle_x, middle_y, size, k, c2, s2, c3, s3, slope = numbers
    a, b = (x - middle_x) * size, (y - middle_y) * size
    real, imaginary, square = a * a - b * b, 2.0 * a * b, a * a + b * b
    q = (k * square + c2 * real + s2 * imaginary) * square
    q += c3 * (a * real - b * imaginary) + s3 * (a * imaginary + b * real)
    u = min(max(slope * (1.0 - q) + 0.5, 0.0), 1.0)
    return u * u * (3.0 - 2.0 * u)


@compiled
def _along(place, x, y, across, down, count):
    """Write the places of the photograph that a row shows."""
    across_x, across_1 = place[0, 0], place[0, 1] * y + place[0, 2]
    down_x, down_1 = place[1, 0], place[1, 1] * y + place[1, 2]
    depth_x, depth_1 = place[2, 0], place[2, 1] * y + place[2, 2]
    for i in range(count):
        column = x + np.float64(np.int32(i))
        share = 1.0 / (depth_x * column + depth_1)
        across[i], down[i] = (across_x * column + across_1) * share, (down_x * column + down_1) * share


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
    use_widest_vectors()  # type: ignore[call-arg]
    across, down, share = doubles[0], doubles[1], doubles[2]
    x, y, found, coarse = singles[0], singles[1], singles[2], singles[3]
    columns, rows = wholes[0], wholes[1]
    for number in range(len(out)):
        for layer in range(places.shape[1]):
            level, part = 0, shown[number, layer]
            while part >= 2.0 and level < len(size) - 1:
                level, part = level + 1, part * 0.5
            blends = part > 1.0 + _LEAST_PART and level < len(size) - 1
            begin, end = boxes[number, layer, 2], boxes[number, layer, 3]
            for row in range(boxes[number, layer, 0], boxes[number, layer, 1]):
                _along(places[number, layer], left + begin, top + row, across, down, end - begin)
                skip, count = 0, end - begin
                if layer > 0:
                    numbers = _numbers(outlines[layer - 1])
                    for i in range(count):
                        share[i] = _cover(numbers, across[i], down[i])
                    # A patch is smaller than its box: what it does not cover is not read.
                    while skip < count and share[skip] == 0.0:
                        skip += 1
                    while count > skip and share[count - 1] == 0.0:
                        count -= 1
                count -= skip
                for finer in range(level + blends, level - 1, -1):
                    scale = 1.0 / (1 << finer)
                    _split(across[skip:], size[0, 1], scale, size[finer, 1], columns, x, count)
                    _split(down[skip:], size[0, 0], scale, size[finer, 0], rows, y, count)
                    into = coarse if finer > level else found
                    _read(grey, first[finer], size[finer, 1], columns, rows, x, y, into, count)
                if blends:
                    weight = np.float32(part - 1.0)
                    for i in range(count):
                        found[i] += (coarse[i] - found[i]) * weight
                line, covered = picture[row, begin + skip : end], share[skip:]
                if layer == 0:
                    line[:] = found
                    continue
                for i in range(count):
                    line[i] += (found[i] - line[i]) * np.float32(covered[i])
        for row in range(out.shape[1]):
            line, levels = picture[row], out[number, row]
            for i in range(len(levels)):
                levels[i] = np.uint16(np.int32(line[i] + np.float32(0.5)))


@compiled
def _taken_one(places, moment, layer, x, y):
    """Return a place through a homography (:func:`_taken`)."""
    depth = places[moment, layer, 2, 0] * x + places[moment, layer, 2, 1] * y + places[moment, layer, 2, 2]
    across = places[moment, layer, 0, 0] * x + places[moment, layer, 0, 1] * y + places[moment, layer, 0, 2]
    down = places[moment, layer, 1, 0] * x + places[moment, layer, 1, 1] * y + places[moment, layer, 1, 2]
    depth = max(depth, _LEAST_DEPTH)
    return across / depth, down / depth


@compiled
def _front(places, moment, outlines, x, y, behind):
    """Return the frontmost layer at a place of the picture; ``behind`` if none in front of that layer covers it."""
    for layer in range(len(outlines), behind, -1):
        across, down = _taken_one(places, moment, layer, x, y)
        if _cover(_numbers(outlines[layer - 1]), across, down) >= 0.5:
            return layer
    return behind


@compiled
def _walk(at, points, places, back, outlines, top, left, height, width, layers, tracks):
    for point in range(len(points)):
        start = min(point, len(at) - 1)
        x, y = points[point, 0] + left, points[point, 1] + top
        layers[point] = layer = _front(at, start, outlines, x, y, 0)
        across, down = _taken_one(at, start, layer, x, y)
        for moment in range(len(tracks)):
            x, y = _taken_one(back, moment, layer, across, down)
            is_inside = left <= x < left + width and top <= y < top + height
            tracks[moment, point, 0], tracks[moment, point, 1] = x - left, y - top
            tracks[moment, point, 2] = is_inside and _front(places, moment, outlines, x, y, layer) == layer

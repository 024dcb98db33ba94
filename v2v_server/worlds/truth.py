"""Where each point of a world goes, and what hides it.

A place of the crop shows the frontmost layer that covers at least half of what is behind it. Its point is the place of
the photograph on that layer. A point is seen at another moment if it lies in the crop then and no layer in front covers
half of it there. All of it is float64 until the result is rounded.
"""

# mypy: allow-untyped-defs, allow-untyped-calls
from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from v2v_server.worlds.render import LEAST_DEPTH, compiled, cover, inverse
from v2v_server.worlds.world import Doubles, World


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
    grid = _grid(world)
    _, (there,) = _follow(world, np.zeros(1) + seconds, grid, np.array([other_seconds]))
    flow, valid = there[:, :2] - grid, there[:, 2] > 0.0
    flow[:, 0] *= -1.0 if world.flip else 1.0
    return _picture(world, flow.astype(np.float32)), _picture(world, valid[:, None].astype(np.uint8))


def masks_of(world: World, seconds: float) -> npt.NDArray[np.uint8]:
    """Return which layer each pixel of the crop shows, [1, H, W]: 0 the photograph, 1 the first patch."""
    return _picture(world, _follow(world, np.zeros(1) + seconds, _grid(world), np.empty(0))[0][:, None])


def tracks_of(world: World, seconds: Doubles) -> npt.NDArray[np.float32]:
    """Return the paths of the world's points, [n, N, 3]: x and y in px of the crop, and 1 where the point is seen."""
    (start, end), (_, _, height, width) = world.seconds, world.crop
    first = world.points[:, :2] * (float(width), float(height))
    tracks = _follow(world, start + world.points[:, 2] * (end - start), first, seconds)[1]
    if world.flip:
        tracks[..., 0] = width - tracks[..., 0]
    return tracks.astype(np.float32)


def _grid(world: World) -> Doubles:
    """Return the middles of the crop's pixels, [pixels, 2]."""
    _, _, height, width = world.crop
    return np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), axis=-1).reshape(-1, 2)


def _picture(world: World, values: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return values of the crop's pixels, [pixels, k], as arrays [k, H, W], mirrored if the crop is."""
    planes = values.T.reshape(-1, world.crop.height_px, world.crop.width_px)
    return np.ascontiguousarray(planes[:, :, ::-1] if world.flip else planes)


def _follow(world: World, at: Doubles, points: Doubles, seconds: Doubles) -> tuple[npt.NDArray[np.uint8], Doubles]:
    """Follow what is in front at places of the crop.

    Args:
        world: the draw.
        at: [N] or [1], moment of each point.
        points: [N, 2], its place then, px of the crop.
        seconds: [n] moments.

    Returns:
        [N], its layer; [n, N, 3], its place, and 1 where it is seen.
    """
    layers, tracks = np.empty(len(points), np.uint8), np.empty((len(seconds), len(points), 3))
    places = world.places(seconds)
    _walk(world.places(at), points, places, inverse(places), world.outlines, *world.crop, layers, tracks)
    return layers, tracks


@compiled
def _taken(place, x, y):
    """Return a place through a homography (``render.taken``)."""
    depth = max(place[2, 0] * x + place[2, 1] * y + place[2, 2], LEAST_DEPTH)
    across = place[0, 0] * x + place[0, 1] * y + place[0, 2]
    return across / depth, (place[1, 0] * x + place[1, 1] * y + place[1, 2]) / depth


@compiled
def _front(places, outlines, x, y, behind):
    """Return the frontmost layer at a place of the picture; ``behind`` if none in front of that layer covers it."""
    for layer in range(len(outlines), behind, -1):
        across, down = _taken(places[layer], x, y)
        if cover(outlines[layer - 1], across, down) >= 0.5:
            return layer
    return behind


@compiled
def _walk(at, points, places, back, outlines, top, left, height, width, layers, tracks):
    for point in range(len(points)):
        start = at[min(point, len(at) - 1)]
        x, y = points[point, 0] + left, points[point, 1] + top
        layers[point] = layer = _front(start, outlines, x, y, 0)
        across, down = _taken(start[layer], x, y)
        for moment in range(len(tracks)):
            x, y = _taken(back[moment, layer], across, down)
            is_inside = left <= x < left + width and top <= y < top + height
            tracks[moment, point, 0], tracks[moment, point, 1] = x - left, y - top
            tracks[moment, point, 2] = is_inside and _front(places[moment], outlines, x, y, layer) == layer

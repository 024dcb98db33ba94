"""Where each point of a world goes, and what hides it.

A place of the crop shows the frontmost layer that covers at least half of what is behind it. Its point is the place of
the photograph on that layer. A point is seen at another moment if it lies in the crop then and no layer in front covers
half of it there. All of it is float64 until the result is rounded.
"""

# mypy: allow-untyped-defs, allow-untyped-calls
from __future__ import annotations

import numpy as np
import numpy.typing as npt

from v2v_server.worlds.render import compiled, cover, inverse, patches_of
from v2v_server.worlds.world import Doubles, World

_LEAST = 2.0**-6
"""Least share of the size at which a point is shown: those farther away or behind the camera count as that far."""


def flow_of(
    world: World, seconds: float, other_seconds: float
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.uint8]]:
    """Return the exact flow of the crop from one moment to another.

    Args:
        seconds: the moment on whose grid it is.
        other_seconds: the moment it leads to.

    Returns:
        [2, H, W], (x, y), px of the crop; [1, H, W], 1 where the point is seen at the other moment.
    """
    _, _, height, width = world.crop
    flow, valid = np.empty((2, height, width), np.float32), np.empty((1, height, width), np.uint8)
    places = world.places(np.array([seconds, other_seconds]))
    _flow(places[0], places[1], inverse(places[1]), patches_of(world), *world.crop[:2], flow, valid[0])
    if world.flip:
        flow, valid = np.ascontiguousarray(flow[:, :, ::-1]), np.ascontiguousarray(valid[:, :, ::-1])
        np.negative(flow[0], out=flow[0])
    return flow, valid


def masks_of(world: World, seconds: float) -> npt.NDArray[np.uint8]:
    """Return which layer each pixel of the crop shows, [1, H, W]: 0 the photograph, 1 the first patch."""
    mask = np.empty((1, world.crop.height_px, world.crop.width_px), np.uint8)
    _masks(world.places(np.array([seconds]))[0], patches_of(world), *world.crop[:2], mask[0])
    return np.ascontiguousarray(mask[:, :, ::-1]) if world.flip else mask


def tracks_of(world: World, seconds: Doubles) -> npt.NDArray[np.float32]:
    """Return the paths of the world's points, [n, N, 3]: x and y in px of the crop, and 1 where the point is seen."""
    top, left, height, width = world.crop
    start, end = world.seconds
    at = world.places(start + world.points[:, 2] * (end - start))
    first = world.points[:, :2] * (width, height) + (left, top)
    tracks = np.empty((len(seconds), len(first), 3), np.float32)
    places = world.places(seconds)
    _tracks(at, first, places, inverse(places), patches_of(world), *world.crop, tracks)
    if world.flip:
        tracks[..., 0] = width - tracks[..., 0]
    return tracks


@compiled
def _taken(place, x, y):
    """Return a place through a homography."""
    below = max(place[2, 0] * x + place[2, 1] * y + place[2, 2], _LEAST)
    across = place[0, 0] * x + place[0, 1] * y + place[0, 2]
    return across / below, (place[1, 0] * x + place[1, 1] * y + place[1, 2]) / below


@compiled
def _front(places, patches, x, y, behind):
    """Return the frontmost layer at a place of the picture; ``behind`` if none in front of that layer covers it."""
    for layer in range(len(patches), behind, -1):
        across, down = _taken(places[layer], x, y)
        if cover(patches[layer - 1], across, down) >= 0.5:
            return layer
    return behind


@compiled
def _masks(places, patches, top, left, mask):
    for row in range(mask.shape[0]):
        for column in range(mask.shape[1]):
            mask[row, column] = _front(places, patches, left + column + 0.5, top + row + 0.5, 0)


@compiled
def _flow(places, others, back, patches, top, left, flow, valid):
    height, width = valid.shape
    for row in range(height):
        for column in range(width):
            x, y = left + column + 0.5, top + row + 0.5
            layer = _front(places, patches, x, y, 0)
            across, down = _taken(places[layer], x, y)
            across, down = _taken(back[layer], across, down)
            flow[0, row, column], flow[1, row, column] = across - x, down - y
            is_inside = left <= across < left + width and top <= down < top + height
            valid[row, column] = is_inside and _front(others, patches, across, down, layer) == layer


@compiled
def _tracks(at, first, places, back, patches, top, left, height, width, tracks):
    for point in range(len(first)):
        x, y = first[point]
        layer = _front(at[point], patches, x, y, 0)
        across, down = _taken(at[point, layer], x, y)
        for moment in range(len(tracks)):
            x, y = _taken(back[moment, layer], across, down)
            is_inside = left <= x < left + width and top <= y < top + height
            tracks[moment, point, 0], tracks[moment, point, 1] = x - left, y - top
            tracks[moment, point, 2] = is_inside and _front(places[moment], patches, x, y, layer) == layer

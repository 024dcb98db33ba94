"""Draw a world from the identity of a sample: a photograph in front of a camera that moves, and patches before it.

Coordinates are continuous, x to the right and y down: pixel (row i, column j) has its middle at (j + 1/2, i + 1/2). The
camera's picture is the photograph, resized by ``scale``; its crop is what the camera sees. The place x of the
picture shows, of each layer, the place X of the photograph, which is mirrored beyond its border without end:

    d = x - c + shake(t)               c: the middle of the crop
    e = d / (1 + g(t) . d)             tilt: a share of the size at the crop's edge
    X = o(t) + z(t) R(t) e / scale

Layer 0 is the photograph: o is c / scale and a path to and fro along it. A patch is cut out at a place s of the
photograph; its own place p(t) goes to and fro within the crop, and o is s - z R p / scale. So shake and tilt move all
that the camera sees, and a patch goes its own way in front of the photograph. The frontmost layer is the last.

Everything is sums, products, quotients and floors in float64, so every host computes the same numbers.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from v2v_protocol.recipe import Recipe
from v2v_protocol.sample import SampleParams
from v2v_server.simulation.draw import SAMPLE_KEY, Purpose, below, in_log_range, in_range, raw_words, unit_of
from v2v_server.simulation.intensity import exponential
from v2v_server.simulation.view import Window

Doubles = npt.NDArray[np.float64]
_TAU = 6.283185307179586
_TAYLOR_TERMS = 8
_DOUBLINGS = 4
_ZOOM_REACH = 0.35
"""Largest natural logarithm of a zoom; at 0.35 what is seen is 1.4 times as large."""
_TILT_SECONDS = 1.0
"""Time in which a camera tilts as far as it does."""
_PACE_SECONDS, _PACE = 0.5, 0.25
"""Time between two knots of a pace, and the most seconds by which a path is early or late."""
_SHAKE_SECONDS = 1 / 12
_ROUNDED = 1 / 16
"""Part of a way to and fro on which it slows down, at each end of each of its two directions, as a share of both."""
_PLAIN_LEVEL = 4
"""Level of the pyramid that a plain world shows: means of 16 x 16 pixels."""
_SOFT_PX = 2.0
"""Width of a patch's outline, about."""
_KNOTS = 4
"""Knots that determine a place of a spline."""


class Path(NamedTuple):
    """How a layer goes.

    Attributes:
        speed_px: (x, y), px of the crop a second.
        reach_px: (x, y), half the way to and fro, above 0.
        start_px: (x, y), the place on it in the middle of the clip, -reach to reach.
        turn, start_turn: turns a second, turns in the middle of the clip.
        zoom: natural logarithm of the size, a second.
        pace: knots of the pace, -1 .. 1.
    """

    speed_px: tuple[float, float]
    reach_px: tuple[float, float]
    start_px: tuple[float, float]
    turn: float
    start_turn: float
    zoom: float
    pace: Doubles


class Patch(NamedTuple):
    """A piece of the photograph in front of it.

    With (a, b) the place from its middle in radii, z = a + i b, and the coefficients k, c2, s2, c3, s3, c4, s4:

        q = k |z|^4 + (c2 Re z^2 + s2 Im z^2) |z|^2 + c3 Re z^3 + s3 Im z^3 + c4 Re z^4 + s4 Im z^4

    is 0 in the middle, rises through 1 once in each direction, before |z| = 1, and there is the outline. With u =
    slope (1 - q) + 1/2, limited to 0 .. 1, the patch covers u^2 (3 - 2 u) of what is behind it.

    Attributes:
        path: its path in the crop, from the crop's middle.
        place_px: (x, y) of its middle in the photograph.
        radius_px: of the circle that holds it, px of the photograph.
        outline: k, c2, s2, c3, s3, c4, s4, slope.
    """

    path: Path
    place_px: tuple[float, float]
    radius_px: float
    outline: tuple[float, ...]


@dataclass(frozen=True, slots=True, eq=False)
class World:
    """One draw.

    Attributes:
        photograph_px: height and width of the photograph.
        scale: of the picture.
        crop: what the camera sees, px of the picture.
        flip: whether flow, masks and tracks are those of the mirrored crop. Pictures are mirrored by the view.
        seconds: first and last moment of the clip.
        path: of the camera over the photograph.
        tilt: (x, y), share of the size at the crop's edge.
        shake: [2, knots], px.
        focus: level of the pyramid below which the photograph is out of focus; 0: it is sharp.
        patches: from back to front.
        points: [N, 3], x and y in the crop, as shares, and a moment as a share of the clip, at which each tracked point
            is on the layer in front.
    """

    photograph_px: tuple[int, int]
    scale: float
    crop: Window
    flip: bool
    seconds: tuple[float, float]
    path: Path
    tilt: tuple[float, float]
    shake: Doubles
    focus: int
    patches: tuple[Patch, ...]
    points: Doubles

    def places(self, seconds: Doubles) -> Doubles:
        """Return what takes a place of the picture to that of the photograph which it shows.

        Args:
            seconds: [n] moments; before the first and after the last one of the clip, its pace stands still.

        Returns:
            [n, 1 + patches, 3, 3], homographies on columns (x, y, 1).
        """
        since, top, left = seconds - sum(self.seconds) / 2, self.crop.top_px, self.crop.left_px
        middle = np.array([left + self.crop.width_px / 2, top + self.crop.height_px / 2])
        shake = _spline(self.shake, (seconds - self.seconds[0]) / _SHAKE_SECONDS)
        tilt = _to_and_fro(since, 1 / _TILT_SECONDS, 1.0, 0.0) / (max(self.crop.height_px, self.crop.width_px) / 2)
        found = np.empty((len(seconds), 1 + len(self.patches), 3, 3))
        for number, layer in enumerate((None, *self.patches)):
            path = self.path if layer is None else layer.path
            paced = since + _PACE * _spline(path.pace[None], (seconds - self.seconds[0]) / _PACE_SECONDS)[0]
            size = exponential(_to_and_fro(paced, path.zoom, _ZOOM_REACH, 0.0)) / self.scale
            cosine, sine = _turned(path.turn * paced + path.start_turn)
            cosine, sine = size * cosine, size * sine
            x, y = (_to_and_fro(paced, *each) for each in zip(path.speed_px, path.reach_px, path.start_px, strict=True))
            if layer is None:
                x, y = (
                    (m + way - start) / self.scale for m, way, start in zip(middle, (x, y), path.start_px, strict=True)
                )
            else:
                x, y = layer.place_px[0] - (cosine * x - sine * y), layer.place_px[1] - (sine * x + cosine * y)
            across, down = shake[0] - middle[0], shake[1] - middle[1]
            tilt_x, tilt_y = tilt * self.tilt[0], tilt * self.tilt[1]
            depth = tilt_x, tilt_y, 1.0 + tilt_x * across + tilt_y * down
            rows = (
                (cosine, -sine, cosine * across - sine * down, x),
                (sine, cosine, sine * across + cosine * down, y),
            )
            for row, (*values, origin) in enumerate(rows):
                for column in range(3):
                    found[:, number, row, column] = values[column] + origin * depth[column]
            for column in range(3):
                found[:, number, 2, column] = depth[column]
        return found


def draw_world(
    recipe: Recipe,
    params: SampleParams,
    *,
    seed: int,
    epoch: int,
    index: int,
    picture_px: tuple[int, int],
    seconds: tuple[float, float],
) -> World:
    """Draw the world of a sample. Each draw has its own stream (``simulation/draw.py``).

    Args:
        recipe, params: the recipe and the sample's draw, whose crop is what the camera sees in the middle of the clip.
        seed, epoch, index: the sample's position.
        picture_px: height and width of the photograph.
        seconds: first and last moment of the clip.
    """

    def words(purpose: Purpose, layer: int, count: int) -> list[int]:
        return raw_words((seed, SAMPLE_KEY), (layer << 32, purpose, index, epoch), count)

    def knots(purpose: Purpose, layer: int, seconds_apart: float, rows: int) -> Doubles:
        count = int((seconds[1] - seconds[0]) / seconds_apart) + 1 + _KNOTS
        return np.array([2.0 * unit_of(raw) - 1.0 for raw in words(purpose, layer, rows * count)]).reshape(-1, rows).T

    def path(layer: int, reach: tuple[float, float], start: tuple[float, float], *, turns: bool, goes: bool) -> Path:
        raw = words(Purpose.WORLD_PATH, layer, 7)
        speed = in_log_range(recipe.world_speed_px, raw[0]) if goes else 0.0
        across, down = (float(each) for each in _turned(np.array(unit_of(raw[1]))))
        turn = in_range(recipe.world_turn_deg, raw[2]) / 360.0 * _sign(raw[3]) if turns else 0.0
        zoom = in_range(recipe.world_zoom, raw[4]) * _sign(raw[5]) if goes else 0.0
        pace = knots(Purpose.WORLD_PACE, layer, _PACE_SECONDS, 1)[0]
        return Path((speed * across, speed * down), reach, start, turn, unit_of(raw[6]) if layer else 0.0, zoom, pace)

    crop = Window(params.crop_top_px, params.crop_left_px, *recipe.crop_px)
    size = crop.width_px, crop.height_px
    kind, plain = words(Purpose.WORLD_KIND, 0, 2)
    is_still = unit_of(kind) < recipe.world_still_share
    goes = unit_of(kind) >= recipe.world_still_share + recipe.world_turn_only_share
    whole = tuple(side * params.scale for side in picture_px[::-1])
    reach = tuple(max((all_ - seen) / 2, seen / 4) for all_, seen in zip(whole, size, strict=True))
    start = tuple(
        min(max(first + (seen - all_) / 2, -most), most)
        for first, all_, seen, most in zip((crop.left_px, crop.top_px), whole, size, reach, strict=True)
    )
    tilt, way = words(Purpose.WORLD_TILT, 0, 2)
    tilts = in_range(recipe.world_tilt, tilt) if goes else 0.0
    tilt_x, tilt_y = (float(tilts * each) for each in _turned(np.array(unit_of(way))))
    shakes = in_range(recipe.world_shake_px, words(Purpose.WORLD_SHAKE, 1, 1)[0]) if goes else 0.0
    patches = []
    for layer in range(1, 1 + below(recipe.world_patches + 1, words(Purpose.WORLD_PATCHES, 0, 1)[0])):
        raw = words(Purpose.WORLD_PATCHES, layer, 5)
        radius = in_range(recipe.world_patch_px, raw[0]) / 2 / params.scale
        there = tuple((2.0 * unit_of(each) - 1.0) * side / 2 for each, side in zip(raw[1:3], size, strict=True))
        place = tuple(
            in_range((min(radius, side / 2), max(side - radius, side / 2)), each)
            for each, side in zip(raw[3:], picture_px[::-1], strict=True)
        )
        own = path(layer, (size[0] / 2, size[1] / 2), there, turns=True, goes=True)
        patches.append(
            Patch(own, place, radius, _outline(words(Purpose.WORLD_OUTLINE, layer, 6), radius * params.scale))
        )
    points = [unit_of(raw) for raw in words(Purpose.WORLD_POINTS, 0, 3 * recipe.track_points)]
    return World(
        picture_px, params.scale, crop, params.flip, seconds, path(0, reach, start, turns=not is_still, goes=goes),
        (tilt_x, tilt_y), shakes * knots(Purpose.WORLD_SHAKE, 0, _SHAKE_SECONDS, 2),
        _PLAIN_LEVEL if unit_of(plain) < recipe.world_plain_share else 0, tuple(patches),
        np.array(points).reshape(-1, 3),
    )  # fmt: skip


def _outline(raw: list[int], radius_px: float) -> tuple[float, ...]:
    """Return the outline of a patch of this radius in the crop; see :class:`Patch`."""
    two, three, four = (
        [most * (2.0 * unit_of(each) - 1.0) for each in pair]
        for most, pair in zip((0.3, 0.3, 0.15), (raw[:2], raw[2:4], raw[4:]), strict=True)
    )
    longest = [math.sqrt(across * across + down * down) for across, down in (two, three, four)]
    size = (1.0 + longest[1]) / (1.0 - longest[0] - longest[2])
    slope = radius_px / (4.0 * _SOFT_PX)
    return (size, *(size * each for each in two), *three, *(size * each for each in four), slope)


def _sign(raw: int) -> float:
    return 1.0 if raw >> 63 else -1.0


def _to_and_fro(seconds: Doubles, speed: float, reach: float, start: float) -> Doubles:
    """Return the place on a straight way, -reach to reach, that is gone to and fro from ``start`` on."""
    turns = (speed * seconds + start) / (4.0 * reach) + 0.25
    place = 0.25 - np.abs(turns - np.floor(turns) - 0.5)
    over = np.maximum(np.abs(place) - (0.25 - _ROUNDED), 0.0)
    result: Doubles = 4.0 * reach * (place - np.copysign(over * over / (2.0 * _ROUNDED), place))
    return result


def _spline(knots: Doubles, at: Doubles) -> Doubles:
    """Return the uniform cubic B-spline of knots [rows, K] at [n], [rows, n]: it stays within them, and has two smooth
    derivatives.
    """
    at = np.clip(at, 0.0, knots.shape[1] - _KNOTS + 1)
    first = np.minimum(np.floor(at).astype(np.int64), knots.shape[1] - _KNOTS)
    x = at - first
    y = 1.0 - x
    weights = y * y * y, (3.0 * x - 6.0) * x * x + 4.0, (3.0 * y - 6.0) * y * y + 4.0, x * x * x
    result: Doubles = sum((knots[:, first + k] * (weight / 6.0) for k, weight in enumerate(weights)), np.zeros(1))
    return result


def _turned(turns: Doubles) -> tuple[Doubles, Doubles]:
    """Return cosine and sine of angles in turns, to a few units in the last place."""
    angle = (turns - np.floor(turns + 0.5)) * (_TAU / 2**_DOUBLINGS)
    square = angle * angle
    cosine, sine = np.ones_like(angle), np.ones_like(angle)
    for k in range(_TAYLOR_TERMS, 0, -1):
        cosine = 1.0 - cosine * square / ((2 * k - 1) * (2 * k))
        sine = 1.0 - sine * square / ((2 * k) * (2 * k + 1))
    sine = sine * angle
    for _ in range(_DOUBLINGS):
        cosine, sine = cosine * cosine - sine * sine, 2.0 * cosine * sine
    return cosine, sine

"""Draw a world from the identity of a sample: a photograph before a camera that moves, and patches in front of it.

Coordinates are continuous, x to the right and y down: pixel (row i, column j) has its middle at (j + 1/2, i + 1/2). The
camera's picture is the photograph, resized by ``scale``; its crop is what the camera sees. The place x of the picture
shows, of each layer, the place X of the photograph, which is mirrored beyond its border without end:

    d = x - c                          c: the middle of the crop
    e = d / (1 + g(t) . d) + shake(t)  g: the tilt; at the crop's edge, its share of the size
    X = o(t) + z(t) R(t) e / scale

Layer 0 is the photograph: o goes to and fro along it. A patch is cut out at a place s of the photograph; its own place
p goes to and fro within the crop, and o is s - z R p / scale. So shake and tilt move all that the camera sees, and a
patch goes its own way in front of the photograph. The frontmost layer is the last.

Everything is sums, products, quotients, roots and floors in float64, so every host computes the same numbers.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from v2v_protocol.recipe import Range, Recipe
from v2v_protocol.sample import SampleParams
from v2v_server.simulation.draw import SAMPLE_KEY, Purpose, below, in_log_range, in_range, raw_words, unit_of
from v2v_server.simulation.intensity import exponential
from v2v_server.simulation.view import Window

Doubles = npt.NDArray[np.float64]
_TAU = 6.283185307179586
_ZOOM_REACH = 0.35
"""Largest natural logarithm of a zoom; at 0.35 what is seen is 1.4 times as large."""
_KNOT_SECONDS = 0.2
"""Time between two knots of shake and pace. A path is early or late by at most half of it."""
_ROUNDED = 1 / 16
"""Share of a way to and fro on which it slows down, before and after each of its two ends."""
_MOST_LAYERS = 3
_OUTLINE = 0.3
"""Largest c2, s2, c3 and s3 of an outline; the first two as shares of k."""
_SOFT_PX = 2.0
"""Width of a patch's outline, about."""
_PLAIN_LEVEL = 4
"""Level of the pyramid that a plain world shows: means of 16 x 16 pixels."""


class Layer(NamedTuple):
    """The photograph, or a patch that is cut out of it, and how it goes.

    With (a, b) the place from a patch's middle in radii, z = a + i b, and the coefficients k, c2, s2, c3, s3:

        q = k |z|^4 + (c2 Re z^2 + s2 Im z^2) |z|^2 + c3 Re z^3 + s3 Im z^3

    is 0 in the middle, rises through 1 once in each direction, before |z| = 1, and there is the outline. With u =
    slope (1 - q) + 1/2, limited to 0 .. 1, the patch covers u^2 (3 - 2 u) of what is behind it.

    Attributes:
        place_px: [2], x and y in the photograph: its middle, or that of the patch.
        speed_px: [2], px of the crop a second.
        reach_px: [2], half the way to and fro, px of the crop, above 0.
        start_px: [2], the place on the way in the middle of the clip, from that of the photograph or the crop.
        turn: turns a second.
        zoom: natural logarithm of what is shown, a second.
        outline: x and y of the place, radius in px of the photograph, k, c2, s2, c3, s3, slope; empty for the
            photograph.
    """

    place_px: Doubles
    speed_px: Doubles
    reach_px: Doubles
    start_px: Doubles
    turn: float
    zoom: float
    outline: tuple[float, ...]


@dataclass(frozen=True, slots=True, eq=False)
class World:
    """One draw.

    Attributes:
        scale: of the picture.
        crop: what the camera sees, px of the picture.
        flip: whether flow, masks, tracks and levels between frames are mirrored. Pictures are mirrored by the view.
        seconds: first and last moment of the clip.
        tilt: [2], x and y, share of the size at the crop's edge.
        knots: [2 + layers, K] of the shake, x and y in px of the crop, and of the pace of each layer, -1 .. 1.
        focus: level of the pyramid that the photograph is at least read from; 0: it is sharp.
        layers: from back to front.
        points: [N, 3], x and y in the crop and a moment in the clip, as shares, at which a tracked point is in front.
    """

    scale: float
    crop: Window
    flip: bool
    seconds: tuple[float, float]
    tilt: Doubles
    knots: Doubles
    focus: int
    layers: tuple[Layer, ...]
    points: Doubles

    @property
    def outlines(self) -> Doubles:
        """Return the outlines of the patches, [patches, 9]."""
        return np.array([layer.outline for layer in self.layers[1:]], np.float64).reshape(-1, 9)

    def places(self, seconds: Doubles) -> Doubles:
        """Return what takes a place of the picture to that of the photograph which it shows.

        Args:
            seconds: [n] moments.

        Returns:
            [n, layers, 3, 3], homographies on columns (x, y, 1).
        """
        since, (top, left, height, width) = seconds - (self.seconds[0] + self.seconds[1]) / 2, self.crop
        across, down = -(left + width / 2), -(top + height / 2)
        knots = _spline(self.knots, (seconds - self.seconds[0]) / _KNOT_SECONDS)
        x, y = self.tilt[:, None] * (_to_and_fro(since, 1.0, 1.0, 0.0) * (2.0 / max(height, width)))
        depth = x, y, 1.0 + x * across + y * down
        found = np.empty((len(seconds), len(self.layers), 3, 3))
        found[:, :, 2] = np.stack(depth, axis=1)[:, None]
        for number, layer in enumerate(self.layers):
            paced = since + knots[2 + number] * (_KNOT_SECONDS / 2)
            ways = zip(layer.speed_px, layer.reach_px, layer.start_px, strict=True)
            way = [start + _to_and_fro(paced, speed, reach, start) for speed, reach, start in ways]
            size = exponential(_to_and_fro(paced, layer.zoom, _ZOOM_REACH, 0.0)) / self.scale
            cosine, sine = (size * each for each in _turned(layer.turn * paced))
            x, y = knots[:2] - (way if number else [0.0])
            for row, (a, b) in enumerate(((cosine, -sine), (sine, cosine))):
                origin = layer.place_px[row] + (a * x + b * y) + (0.0 if number else way[row] / self.scale)
                for column, value in enumerate((a, b, a * across + b * down)):
                    found[:, number, row, column] = value + origin * depth[column]
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
    """Draw the world of a sample. Each number has its own place in a counter stream (``simulation/draw.py``): no draw
    changes another.

    Args:
        recipe, params: the recipe and the sample's draw, whose crop is what the camera sees in the middle of the clip.
        seed, epoch, index: the sample's position.
        picture_px: height and width of the photograph.
        seconds: first and last moment of the clip.
    """

    def words(purpose: Purpose, block: int, count: int) -> list[int]:
        return raw_words((seed, SAMPLE_KEY), (block << 32, purpose, index, epoch), count)

    def layer(
        number: int, goes: float, turns: float, place: Doubles, reach: Doubles, start: Doubles, *outline: float
    ) -> Layer:
        way, length, turn, turn_sign, zoom, zoom_sign = words(Purpose.WORLD_PATH, number, 6)
        return Layer(
            place, _vector(goes * in_log_range(recipe.world_speed_px, length), way), reach, start,
            turns * _either(recipe.world_turn_deg, turn, turn_sign) / 360.0,
            goes * _either(recipe.world_zoom, zoom, zoom_sign), outline,
        )  # fmt: skip

    crop = Window(params.crop_top_px, params.crop_left_px, *recipe.crop_px)
    sides, seen = np.array(picture_px[::-1], np.float64), np.array(recipe.crop_px[::-1], np.float64)
    kind, plain, patches, tilt, tilt_way, shake = words(Purpose.WORLD, 0, 6)
    turns = float(unit_of(kind) >= recipe.world_still_share)
    goes = float(unit_of(kind) >= recipe.world_still_share + recipe.world_turn_only_share)
    free = np.maximum(sides * params.scale - seen, seen / 2) / 2
    start = np.array(crop[1::-1]) + seen / 2 - sides * params.scale / 2
    layers = [layer(0, goes, turns, sides / 2, free, np.clip(start, -free, free))]
    for number in range(1, 1 + below(recipe.world_patches + 1, patches)):
        size, *raw = words(Purpose.WORLD, number, 9)
        radius, drawn = in_range(recipe.world_patch_px, size) / 2, _signed(raw)
        place = sides / 2 + np.maximum(sides / 2 - radius / params.scale, 0.0) * drawn[:2]
        two, three = _OUTLINE * drawn[4:6], _OUTLINE * drawn[6:8]
        k = (1.0 + np.abs(three[0]) + np.abs(three[1])) / (1.0 - np.abs(two[0]) - np.abs(two[1]))
        outline = *place, radius / params.scale, k, *(k * two), *three, radius / (4.0 * _SOFT_PX)
        layers.append(layer(number, 1.0, 1.0, place, seen / 2, seen / 2 * drawn[2:4], *map(float, outline)))
    rows, count = 2 + _MOST_LAYERS, int((seconds[1] - seconds[0]) / _KNOT_SECONDS) + 5
    knots = _signed(words(Purpose.WORLD_KNOTS, 0, rows * count)).reshape(count, rows).T
    knots[:2] *= goes * in_range(recipe.world_shake_px, shake)
    return World(
        params.scale, crop, params.flip, seconds, _vector(goes * in_range(recipe.world_tilt, tilt), tilt_way), knots,
        _PLAIN_LEVEL if unit_of(plain) < recipe.world_plain_share else 0, tuple(layers),
        _signed(words(Purpose.WORLD_POINTS, 0, 3 * recipe.track_points)).reshape(-1, 3) / 2 + 0.5,
    )  # fmt: skip


def _vector(length: float, raw: int) -> Doubles:
    """Return a vector in a drawn direction."""
    return length * np.array(_turned(np.array(unit_of(raw))))


def _either(ends: Range, raw: int, sign: int) -> float:
    """Return a number of a range, positive or negative."""
    return math.copysign(in_range(ends, raw), unit_of(sign) - 0.5)


def _signed(raw: list[int]) -> Doubles:
    """Return uniform numbers in [-1, 1)."""
    return np.array([2.0 * unit_of(each) - 1.0 for each in raw])


def _to_and_fro(seconds: Doubles, speed: float, reach: float, start: float) -> Doubles:
    """Return the way from ``start`` on a straight line that is gone to and fro, -reach to reach, and slows down at its
    ends.
    """
    turns = (speed * np.append(seconds, 0.0) + start) / (4.0 * reach) + 0.25
    place = 0.25 - np.abs(turns - np.floor(turns) - 0.5)
    over = np.maximum(np.abs(place) - (0.25 - _ROUNDED), 0.0)
    place = place - np.copysign(over * over / (2.0 * _ROUNDED), place)
    way: Doubles = 4.0 * reach * (place[:-1] - place[-1])
    return way


def _spline(knots: Doubles, at: Doubles) -> Doubles:
    """Return the uniform cubic B-spline of knots [rows, K] at [n], 0 to K - 3, [rows, n]: it stays within them, and has
    two smooth derivatives.
    """
    at = np.clip(at, 0.0, knots.shape[1] - 3)
    first = np.minimum(np.floor(at).astype(np.int64), knots.shape[1] - 4)
    x, y = at - first, 1.0 - (at - first)
    weights = y * y * y, (3.0 * x - 6.0) * x * x + 4.0, (3.0 * y - 6.0) * y * y + 4.0, x * x * x
    result: Doubles = sum((knots[:, first + k] * (weight / 6.0) for k, weight in enumerate(weights)), np.zeros(1))
    return result


def _turned(turns: Doubles) -> tuple[Doubles, Doubles]:
    """Return cosine and sine of angles in turns, to a few units in the last place: by their series at a 16th of the
    angle, doubled four times.
    """
    angle = (turns - np.floor(turns + 0.5)) * (_TAU / 16)
    cosine, sine, square = np.ones_like(angle), np.ones_like(angle), angle * angle
    for k in range(8, 0, -1):
        cosine, sine = 1.0 - cosine * square / ((2 * k - 1) * (2 * k)), 1.0 - sine * square / ((2 * k) * (2 * k + 1))
    sine = sine * angle
    for _ in range(4):
        cosine, sine = cosine * cosine - sine * sine, 2.0 * cosine * sine
    return cosine, sine

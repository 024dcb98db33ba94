"""Draw a world from the identity of a sample: a photograph in front of a camera that moves, and patches before it.

Coordinates are continuous, x to the right and y down: pixel (row i, column j) has its middle at (j + 1/2, i + 1/2). The
camera's picture is the photograph, resized by ``scale``; its crop is what the camera sees. The place x of the
picture shows, of each layer, the place X of the photograph, which is mirrored beyond its border without end:

    d = x - c                          c: the middle of the crop
    e = d / (1 + g(t) . d) + shake(t)  g: the tilt; at the crop's edge, its share of the size
    X = o(t) + z(t) R(t) e / scale

Layer 0 is the photograph: o goes to and fro along it. A patch is cut out at a place s of the photograph; its own place
p goes to and fro within the crop, and o is s - z R p / scale. So shake and tilt move all that the camera sees, and a
patch goes its own way in front of the photograph. The frontmost layer is the last.

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
Pair = tuple[float, float]
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
_SHAKE_BLOCK = 2**16
_MOST_OF_OUTLINE = (0.3, 0.3, 0.3, 0.3, 0.15, 0.15)
"""Largest c2, s2, c3, s3, c4 and s4, the former and the latter two as shares of k."""
_PLAIN_LEVEL = 4
"""Level of the pyramid that a plain world shows: means of 16 x 16 pixels."""
_SOFT_PX = 2.0
"""Width of a patch's outline, about."""
_KNOTS = 4
"""Knots that determine a place of a spline."""


class Layer(NamedTuple):
    """The photograph, or a patch that is cut out of it, and how it goes.

    With (a, b) the place from a patch's middle in radii, z = a + i b, and the coefficients k, c2, s2, c3, s3, c4, s4:

        q = k |z|^4 + (c2 Re z^2 + s2 Im z^2) |z|^2 + c3 Re z^3 + s3 Im z^3 + c4 Re z^4 + s4 Im z^4

    is 0 in the middle, rises through 1 once in each direction, before |z| = 1, and there is the outline. With u =
    slope (1 - q) + 1/2, limited to 0 .. 1, the patch covers u^2 (3 - 2 u) of what is behind it.

    Attributes:
        place_px: (x, y) in the photograph: its middle, or that of the patch.
        speed_px: (x, y), px of the crop a second.
        reach_px: (x, y), half the way to and fro, px of the crop, above 0.
        start_px: (x, y), the place on the way in the middle of the clip, from that of the photograph or the crop.
        turn, start_turn: turns a second, turns in the middle of the clip.
        zoom: natural logarithm of what is shown, a second.
        pace: [1, knots], -1 .. 1.
        outline: x and y of the place, radius in px of the photograph, k, c2, s2, c3, s3, c4, s4, slope; empty for the
            photograph.
    """

    place_px: Pair
    speed_px: Pair
    reach_px: Pair
    start_px: Pair
    turn: float
    start_turn: float
    zoom: float
    pace: Doubles
    outline: tuple[float, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class World:
    """One draw.

    Attributes:
        scale: of the picture.
        crop: what the camera sees, px of the picture.
        flip: whether flow, masks, tracks and levels between frames are mirrored. Pictures are mirrored by the view.
        seconds: first and last moment of the clip.
        tilt: (x, y), share of the size at the crop's edge.
        shake: [2, knots], px of the crop.
        focus: level of the pyramid that the photograph is at least read from; 0: it is sharp.
        layers: from back to front.
        points: [N, 3], x and y in the crop and a moment in the clip, as shares, at which a tracked point is in front.
    """

    scale: float
    crop: Window
    flip: bool
    seconds: Pair
    tilt: Pair
    shake: Doubles
    focus: int
    layers: tuple[Layer, ...]
    points: Doubles

    @property
    def outlines(self) -> Doubles:
        """Return the outlines of the patches, [patches, 11]."""
        return np.array([layer.outline for layer in self.layers[1:]], np.float64).reshape(-1, 11)

    def places(self, seconds: Doubles) -> Doubles:
        """Return what takes a place of the picture to that of the photograph which it shows.

        Args:
            seconds: [n] moments.

        Returns:
            [n, layers, 3, 3], homographies on columns (x, y, 1).
        """
        since = seconds - (self.seconds[0] + self.seconds[1]) / 2
        top, left, height, width = self.crop
        across, down = -(left + width / 2), -(top + height / 2)
        tilt = _to_and_fro(since, 1 / _TILT_SECONDS, 1.0, 0.0) * (2.0 / max(height, width))
        tilt_x, tilt_y = self.tilt[0] * tilt, self.tilt[1] * tilt
        depth = tilt_x, tilt_y, 1.0 + tilt_x * across + tilt_y * down
        found = np.empty((len(seconds), len(self.layers), 3, 3))
        found[:, :, 2] = np.stack(depth, axis=1)[:, None]
        for number, layer in enumerate(self.layers):
            paced = since + _PACE * _spline(layer.pace, (seconds - self.seconds[0]) / _PACE_SECONDS)[0]
            way = [start + _to_and_fro(paced, speed, reach, start)
                   for speed, reach, start in zip(*layer[1:4], strict=True)]  # fmt: skip
            size = exponential(_to_and_fro(paced, layer.zoom, _ZOOM_REACH, 0.0)) / self.scale
            cosine, sine = (size * each for each in _turned(layer.turn * paced + layer.start_turn))
            x, y = _spline(self.shake, (seconds - self.seconds[0]) / _SHAKE_SECONDS) - (way if number else [0.0])
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
    seconds: Pair,
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

    def knots(block: int, seconds_apart: float, rows: int) -> Doubles:
        count = int((seconds[1] - seconds[0]) / seconds_apart) + 1 + _KNOTS
        drawn = [_signed(raw) for raw in words(Purpose.WORLD_KNOTS, block, rows * count)]
        return np.array(drawn).reshape(count, rows).T

    def layer(block: int, place: Pair, reach: Pair, start: Pair, outline: tuple[float, ...] = ()) -> Layer:
        raw = words(Purpose.WORLD_PATH, block, 7)
        goes, turns = (float(bool(block) or kind >= least) for least in shares)
        speed = goes * in_log_range(recipe.world_speed_px, raw[0])
        turn = turns * math.copysign(in_range(recipe.world_turn_deg, raw[2]) / 360.0, _signed(raw[3]))
        zoom = goes * math.copysign(in_range(recipe.world_zoom, raw[4]), _signed(raw[5]))
        return Layer(
            place, _towards(speed, raw[1]), reach, start, turn, bool(block) * unit_of(raw[6]), zoom,
            knots(block, _PACE_SECONDS, 1), outline,
        )  # fmt: skip

    raw = words(Purpose.WORLD, 0, 6)
    kind, shares = unit_of(raw[0]), (recipe.world_still_share + recipe.world_turn_only_share, recipe.world_still_share)
    crop = Window(params.crop_top_px, params.crop_left_px, *recipe.crop_px)
    sides, seen, corner = np.array(picture_px[::-1]), np.array(recipe.crop_px[::-1]), np.array(crop[1::-1])
    free = np.maximum(sides * params.scale - seen, seen / 2) / 2
    start = corner + seen / 2 - sides * params.scale / 2
    layers = [layer(0, _pair(sides / 2), _pair(free), _pair(np.clip(start, -free, free)))]
    for block in range(1, 1 + below(recipe.world_patches + 1, raw[2])):
        own = words(Purpose.WORLD, block, 11)
        radius = in_range(recipe.world_patch_px, own[0]) / 2
        room = np.maximum(sides / 2 - radius / params.scale, 0.0)
        place = _pair(sides / 2 + room * [_signed(each) for each in own[1:3]])
        outline = *place, radius / params.scale, *_outline(own[5:], radius)
        layers.append(
            layer(block, place, _pair(seen / 2), _pair(seen / 2 * [_signed(each) for each in own[3:5]]), outline)
        )
    points = [unit_of(each) for each in words(Purpose.WORLD_POINTS, 0, 3 * recipe.track_points)]
    tilt, shake = (
        in_range(ends, each) if kind >= shares[0] else 0.0
        for ends, each in ((recipe.world_tilt, raw[3]), (recipe.world_shake_px, raw[5]))
    )
    return World(
        params.scale, crop, params.flip, seconds, _towards(tilt, raw[4]),
        shake * knots(_SHAKE_BLOCK, _SHAKE_SECONDS, 2),
        _PLAIN_LEVEL if unit_of(raw[1]) < recipe.world_plain_share else 0, tuple(layers),
        np.array(points).reshape(-1, 3),
    )  # fmt: skip


def _outline(raw: list[int], radius_px: float) -> tuple[float, ...]:
    """Return coefficients and slope of the outline of a patch of this radius in the crop."""
    drawn = [most * _signed(each) for most, each in zip(_MOST_OF_OUTLINE, raw, strict=True)]
    two, three, four = (math.sqrt(drawn[k] * drawn[k] + drawn[k + 1] * drawn[k + 1]) for k in (0, 2, 4))
    size = (1.0 + three) / (1.0 - two - four)
    drawn = [each if k in (2, 3) else size * each for k, each in enumerate(drawn)]
    return (size, *drawn, radius_px / (4.0 * _SOFT_PX))


def _pair(values: Doubles) -> Pair:
    return float(values[0]), float(values[1])


def _towards(length: float, raw: int) -> Pair:
    """Return a vector of this length in a drawn direction."""
    across, down = _turned(np.array(unit_of(raw)))
    return length * float(across), length * float(down)


def _signed(raw: int) -> float:
    """Return a uniform number in [-1, 1)."""
    return 2.0 * unit_of(raw) - 1.0


def _to_and_fro(seconds: Doubles, speed: float, reach: float, start: float) -> Doubles:
    """Return the way from ``start`` on a straight line that is gone to and fro, -reach to reach, and slows down at its
    ends.
    """
    turns = (speed * np.append(seconds, 0.0) + start) / (4.0 * reach) + 0.25
    place = 0.25 - np.abs(turns - np.floor(turns) - 0.5)
    over = np.maximum(np.abs(place) - (0.25 - _ROUNDED), 0.0)
    place = place - np.copysign(over * over / (2.0 * _ROUNDED), place)
    return 4.0 * reach * (place[:-1] - place[-1])


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

"""Pictures and truth of a world by its definition, point by point in float64: ``v2v_server/worlds`` written again with
numpy's and scipy's own functions, without homographies and without its kernels.
"""

from __future__ import annotations

import dataclasses
from functools import cache

import numpy as np
import numpy.typing as npt
from scipy import ndimage  # type: ignore[import-untyped]
from scipy.interpolate import BSpline  # type: ignore[import-untyped]

from tests.oracles.rendered import GAMMA, LOG_EPS, START_LOG_UNITS, Counts, Errors, counts_of, errors, log_levels
from v2v_protocol.recipe import PRESETS
from v2v_protocol.spec import StreamSpec
from v2v_server.simulation import simulate
from v2v_server.simulation.draw import draw
from v2v_server.simulation.kernels import fill
from v2v_server.video.decode import SampleView
from v2v_server.worlds.clip import render_clip
from v2v_server.worlds.render import pyramid_of
from v2v_server.worlds.world import World, draw_world

Reals = npt.NDArray[np.float64]


class Oracle:
    """A world and its photograph.

    Args:
        world: the draw.
        grey: [H, W] uint8 or uint16.
        is_rounded: whether its light has whole levels of 12 bits; else that of its own.
    """

    def __init__(self, world: World, grey: npt.NDArray[np.unsignedinteger], *, is_rounded: bool = True) -> None:
        self.world, self.size = world, grey.shape[::-1]
        self._pose = cache(self._pose_at)
        light = grey * (4095 / np.iinfo(grey.dtype).max)
        self.levels = [np.floor(light + 0.5) if is_rounded else light]
        while min(self.levels[-1].shape) > 2:
            level = np.pad(self.levels[-1], [(0, side % 2) for side in self.levels[-1].shape], "edge")
            height, width = level.shape
            means = level.reshape(height // 2, 2, width // 2, 2).mean(axis=(1, 3))
            self.levels.append(np.floor(means + 0.5) if is_rounded else means)

    def grid(self) -> Reals:
        """Return the middles of the crop's pixels, [2, H, W] in px of the picture, from left to right as the view sees
        them.
        """
        top, left, height, width = self.world.crop
        y, x = np.mgrid[top : top + height, left : left + width] + 0.5
        return np.stack([x[:, ::-1], y[:, ::-1]]) if self.world.flip else np.stack([x, y])

    def place(self, seconds: float, layer: int, x: Reals) -> Reals:
        """Return the place of the photograph, [2, ...], that places of the picture show of a layer."""
        origin, turn, shake, tilt, middle = self._pose(seconds, layer)
        d = x - middle
        e = d / (1.0 + np.tensordot(tilt, d, 1)) + shake
        return origin + np.tensordot(turn, e, 1)

    def picture_place(self, seconds: float, layer: int, x: Reals) -> Reals:
        """Return the place of the picture that shows places of the photograph, [2, ...]; NaN behind the camera."""
        origin, turn, shake, tilt, middle = self._pose(seconds, layer)
        e = np.tensordot(np.linalg.inv(turn), x - origin, 1) - shake
        share = 1.0 - np.tensordot(tilt, e, 1)
        return np.where(share > 0.0, e / share, np.nan) + middle

    def _pose_at(self, seconds: float, number: int) -> tuple[Reals, Reals, Reals, Reals, Reals]:
        """Return o, z R / scale, the shake, the tilt and c, each with axes to broadcast."""
        world, layer = self.world, self.world.layers[number]
        top, left, height, width = world.crop
        since, begin = seconds - sum(world.seconds) / 2, world.seconds[0]
        count = world.knots.shape[1]
        at = np.clip((seconds - begin) / 0.2, 0, count - 3) + 3
        shake_x, shake_y, *pace = (float(BSpline(np.arange(count + 4), knots, 3)(at)) for knots in world.knots)
        paced = since + 0.1 * pace[number]
        way = [
            start + _way(paced * speed, reach, start)
            for speed, reach, start in zip(layer.speed_px, layer.reach_px, layer.start_px, strict=True)
        ]
        angle, zoom = 2 * np.pi * layer.turn * paced, np.exp(_way(paced * layer.zoom, 0.35, 0.0))
        turn = zoom / world.scale * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        origin = layer.place_px - turn @ way if number else layer.place_px + np.array(way) / world.scale
        tilt = np.array(world.tilt) * _way(since, 1.0, 0.0) / (max(height, width) / 2)
        middle = np.array([left + width / 2, top + height / 2])
        axes = (2, 1, 1)
        return origin.reshape(axes), turn, np.array([shake_x, shake_y]).reshape(axes), tilt, middle.reshape(axes)

    def shown(self, seconds: float, number: int) -> float:
        """Return how many pixels of the photograph one of the picture shows in each direction."""
        return float(np.sqrt(np.linalg.det(self._pose(seconds, number)[1])))

    def cover(self, number: int, x: Reals) -> Reals:
        """Return what a patch covers at places of the photograph."""
        place_x, place_y, radius, k, c2, s2, c3, s3, slope = self.world.layers[number].outline
        z = ((x[0] - place_x) + 1j * (x[1] - place_y)) / radius
        size = np.abs(z)
        q = k * size**4 + (c2 * (z**2).real + s2 * (z**2).imag) * size**2 + c3 * (z**3).real + s3 * (z**3).imag
        u = np.clip(slope * (1 - q) + 0.5, 0.0, 1.0)
        covered: Reals = u**2 * (3 - 2 * u)
        return covered

    def picture(self, seconds: float) -> Reals:
        """Return the picture, [H, W], 0 .. 4095, not rounded."""
        x = self.grid()
        seen = np.zeros(x.shape[1:])
        for number in range(len(self.world.layers)):
            place = self.place(seconds, number, x)
            share = self.cover(number, place) if number else np.ones(x.shape[1:])
            pixels = self.shown(seconds, number)
            pixels = max(pixels, 2.0**self.world.focus) if number == 0 else pixels
            level = min(int(np.floor(np.log2(max(pixels, 1.0)))), len(self.levels) - 1)
            found = self._read(level, place)
            if level + 1 < len(self.levels) and pixels > 1.0:
                found = found + (self._read(level + 1, place) - found) * (pixels / 2**level - 1.0)
            seen = seen + (found - seen) * share
        return seen

    def _read(self, level: int, place: Reals) -> Reals:
        """Read a level bilinearly at places of the mirrored photograph."""
        inside = [np.abs((x + side) % (2 * side) - side) for x, side in zip(place, self.size, strict=True)]
        rows_columns = [inside[1] / 2**level - 0.5, inside[0] / 2**level - 0.5]
        found: Reals = ndimage.map_coordinates(self.levels[level], rows_columns, order=1, mode="nearest")
        return found

    def front(self, seconds: float, x: Reals, behind: int | npt.NDArray[np.int64] = 0) -> npt.NDArray[np.int64]:
        """Return the frontmost layer at places of the picture, at least ``behind``."""
        front = np.broadcast_to(np.asarray(behind), x.shape[1:]).copy()
        for number in range(1, len(self.world.layers)):
            covers = self.cover(number, self.place(seconds, number, x)) >= 0.5
            front[covers & (number > front)] = number
        return front

    def at_outline(self, seconds: float, x: Reals) -> npt.NDArray[np.bool_]:
        """Return which places of the picture lie on an outline."""
        found = np.zeros(x.shape[1:], np.bool_)
        for number in range(1, len(self.world.layers)):
            found |= np.abs(self.cover(number, self.place(seconds, number, x)) - 0.5) < 0.4
        return found

    def followed(
        self, seconds: float, other: float, x: Reals
    ) -> tuple[Reals, npt.NDArray[np.bool_], npt.NDArray[np.int64]]:
        """Return where what is in front at places of the picture is at another moment, [2, ...]; whether it is seen
        there; and the layer.
        """
        layer = self.front(seconds, x)
        there: Reals = np.full(x.shape, np.nan)
        for number in range(len(self.world.layers)):
            to = self.picture_place(other, number, self.place(seconds, number, x))
            there = np.where(layer == number, to, there)
        top, left, height, width = self.world.crop
        inside = (there[0] >= left) & (there[0] < left + width) & (there[1] >= top) & (there[1] < top + height)
        place = np.where(np.isfinite(there), there, 0.0)
        return there, inside & (self.front(other, place, layer) == layer), layer


def _way(moved: float, reach: float, start: float) -> float:
    """Return the way from a start on a line that is gone to and fro: the integral of its speed, 1 but for the ends."""
    quarter = 4 * reach

    def place(phase: float) -> float:
        phase = (phase + 0.25) % 1.0 - 0.25  # -1/4 .. 3/4, the ends of the way at 1/4 and 3/4
        sign = 1.0
        if phase > 0.25:
            phase, sign = phase - 0.5, -1.0
        # A parabola over the last 1/16 of each quarter, tangent to the line.
        over = max(abs(phase) - 3 / 16, 0.0)
        return sign * float(np.sign(phase)) * (abs(phase) - 8.0 * over**2)

    return quarter * (place((moved + start) / quarter) - place(start / quarter))


def waves(grey: tuple[float, float], period_px: float, size: int = 240) -> npt.NDArray[np.uint16]:
    """Return a photograph, [size, size], of two crossed sines between two grey levels of 0 .. 255."""
    y, x = np.mgrid[:size, :size] + 0.5
    sines = np.sin(2 * np.pi * x / period_px) + np.sin(2 * np.pi * y / period_px + 1.0)
    light = (grey[0] + grey[1]) / 2 + (grey[1] - grey[0]) / 4 * sines
    levels: npt.NDArray[np.uint16] = np.floor(light * (65535 / 255) + 0.5).astype(np.uint16)
    return levels


def event_counts(
    photograph: npt.NDArray[np.unsignedinteger],
    spec: StreamSpec,
    px_per_frame: float,
    threshold: float,
    index: int = 0,
    side: int = 24,
    steps: int = 8,
    moments: int = 64,
) -> tuple[Counts, Counts]:
    """Return the events of each frame step of a photograph that passes, and the exact crossings of its light.

    The light is the photograph, bilinear between its pixels, in float64.

    Args:
        photograph: [H, W].
        spec: its fields of a world say how light is rendered; all else is fixed.
        px_per_frame: speed, in a direction that the index draws.
        threshold: of both polarities.
        index: of the sample.
        side: of the crop, px.
        steps: between frames, at 60 Hz.
        moments: of a step, at which the light is known.
    """
    height, width = photograph.shape
    fine = {name: getattr(spec.recipe, name) for name in ("world_bits", "world_change_share")}
    recipe = PRESETS["noise-free"].replace(
        **fine, crop_height_px=side, crop_width_px=side, world_speed_px=60.0 * px_per_frame, voxels_per_clip=steps,
        bins=1, threshold=threshold, threshold_ratio=1.0, gamma=GAMMA, log_eps=LOG_EPS,
    )  # fmt: skip
    params = draw(recipe, seed=1, epoch=0, index=index, picture_height_px=height, picture_width_px=width, video_id="")
    seconds, pyramid = np.arange(steps + 1) / 60.0, pyramid_of(photograph, recipe.world_bits)
    view = SampleView(dataclasses.replace(spec, recipe=recipe), params, ())
    clip = render_clip(pyramid, (height, width), seconds, (1, 0, index), view)
    made = simulate(
        clip.frames, threshold_pos=threshold, bins=1, gamma=GAMMA, log_eps=LOG_EPS, bits=clip.signal.bits,
        start_residual=START_LOG_UNITS,
    )  # fmt: skip
    given = dataclasses.replace(made.given, levels=clip.levels)
    counts = fill(given, made.real, {"event_counts": None})[0]["event_counts"].reshape(steps, 2, -1).astype(np.int64)
    world = draw_world(
        recipe, params, seed=1, epoch=0, index=index, picture_px=(height, width), seconds=(0.0, float(seconds[-1]))
    )
    oracle = Oracle(world, photograph, is_rounded=False)
    times = np.linspace(0.0, seconds[-1], steps * moments + 1)
    levels = np.stack([log_levels(oracle.picture(time) / 4095).ravel() for time in times.tolist()])
    return Counts(counts[:, 1], counts[:, 0]), counts_of(levels, times, seconds, threshold)


def event_errors(
    photograph: npt.NDArray[np.unsignedinteger], spec: StreamSpec, px_per_frame: float, threshold: float
) -> Errors:
    """Return how far events are from the exact crossings, see :func:`event_counts`."""
    return errors(*event_counts(photograph, spec, px_per_frame, threshold))

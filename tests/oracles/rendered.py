"""Scenes that move by formula and can be rendered at any time: the truth of what happens between two video frames.

Speeds are in px a second, so one scene gives frames of any rate. What moves follows a winding path at constant speed
whose heading swings once a second, or turns, or grows. Light is 0 (black) to 1 (white), sampled at points from cubic
splines or smooth profiles, before any rounding; a video has 8 bits of it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy import ndimage  # type: ignore[import-untyped]

from tests.oracles.dense import Events, dense_events
from tests.oracles.known_motion import photograph

Reals = npt.NDArray[np.float64]
GAMMA, LOG_EPS = 2.2, 1e-3
START_LOG_UNITS = 0.06
"""Residual of every pixel at the start; both sides of a comparison begin with it."""
PHOTOGRAPHS = ("camera", "coffee", "coins")
OTHERS = ("gravel", "parallax", "occlusion", "rotation", "zoom", "plain", "thin", "flicker")
NAMES = (*PHOTOGRAPHS, *OTHERS)
SMALL = ("insects", "rain")
"""Scenes of things that are smaller than a block."""
_LONGEST_SECONDS, _PATH_HZ = 4.0, 9600
_FLICKER_HZ, _FLICKER_SHARE = 10.0, 0.3


class Counts(NamedTuple):
    """Events of each bin and pixel, [bins, pixels] int64."""

    positive: npt.NDArray[np.int64]
    negative: npt.NDArray[np.int64]


@dataclass(frozen=True)
class Errors:
    """Errors of counts, as shares: of the number of events, of signed bins, of bins of both polarities."""

    count: float
    signed: float
    split: float


@dataclass(frozen=True)
class RenderedScene:
    """A scene.

    Attributes:
        name: see :func:`rendered_scene`.
        light: the picture [height, width], 0 .. 1, of a time in seconds (0 .. 4).
    """

    name: str
    light: Callable[[float], Reals]

    def frames(self, frames_per_second: float, count: int) -> npt.NDArray[np.uint8]:
        """Return the first frames of a video: [count, height, width]."""
        seen = np.stack([self.light(n / frames_per_second) for n in range(count)])
        return np.rint(255.0 * seen).astype(np.uint8)

    def counts(self, edges_seconds: Reals, threshold: float, rendered_hz: float) -> Counts:
        """Return the true events between the edges of bins, from levels at ``rendered_hz``, linear in between."""
        seconds = np.arange(math.floor(edges_seconds[-1] * rendered_hz + 1e-6) + 1) / rendered_hz
        levels = np.stack([log_levels(self.light(time)).ravel() for time in seconds])
        return counts_of(levels, seconds, edges_seconds, threshold)


def log_levels(light: Reals) -> Reals:
    """Return log intensity of light in 0 .. 1."""
    levels: Reals = np.log(LOG_EPS + light**GAMMA)
    return levels


def counts_of(
    levels: Reals, seconds: Reals, edges_seconds: Reals, threshold: float, start: Reals | float = START_LOG_UNITS
) -> Counts:
    """Return the events of [n, pixels] log intensities at [n] times, linear in between, from residuals [pixels]."""
    start = np.broadcast_to(start, levels.shape[1])
    events = dense_events(levels, seconds, start, threshold, threshold)
    return Counts(*(_binned(events, sign, edges_seconds, levels.shape[1]) for sign in (1, -1)))


def errors(made: Counts, true: Counts) -> Errors:
    """Return how far counts are from the truth."""
    events, net = int(true.positive.sum() + true.negative.sum()), true.positive - true.negative
    apart = [np.abs(mine - other).sum() for mine, other in zip(made, true, strict=True)]
    return Errors(
        (int(made.positive.sum() + made.negative.sum()) - events) / max(events, 1),
        float(np.abs(made.positive - made.negative - net).sum() / max(np.abs(net).sum(), 1)),
        float(sum(apart) / max(events, 1)),
    )


def rendered_scene(
    name: str,
    height: int,
    width: int,
    px_per_second: float,
    behind: str = "camera",
    shown: str | None = None,
) -> RenderedScene:
    """Return a scene.

    Args:
        name: of NAMES or SMALL, "discs", or a photograph of scikit-image, which passes.
        height, width: of the picture, px.
        px_per_second: speed; of the fastest part, where parts differ.
        behind: the photograph that rests in "occlusion", "discs" and SMALL.
        shown: the photograph that moves in "occlusion", "rotation" and "zoom"; None: the scene's own.
    """
    y, x = np.mgrid[0:height, 0:width].astype(np.float64)
    y, x = y - (height - 1) / 2, x - (width - 1) / 2
    reach, rests = max(height, width) / 2, photo(behind, y, x)

    def moved(seconds: float, share: float = 1.0) -> tuple[Reals, Reals]:
        down, right = path(seconds) * px_per_second * share
        return y - down, x - right

    def parallax(seconds: float) -> Reals:
        front = moved(seconds)
        cover = np.clip(0.5 + 8.0 * (photo("coins", front[0] / 2, front[1] / 2) - 0.45), 0.0, 1.0)
        return photo("coffee", *moved(seconds, 1 / 3)) * (1 - cover) + photo("camera", *front) * cover

    def occlusion(seconds: float) -> Reals:
        front = moved(seconds)
        radius = np.hypot(front[0] / (0.5 * reach), front[1] / (0.35 * reach))
        cover = np.clip(0.5 + (1.0 - radius) * 0.35 * reach, 0.0, 1.0)
        return rests * (1 - cover) + photo(shown or "coffee", *front) * cover

    def rotation(seconds: float) -> Reals:
        angle = px_per_second * seconds / reach
        return photo(
            shown or "coffee", y * math.cos(angle) - x * math.sin(angle), y * math.sin(angle) + x * math.cos(angle)
        )

    def zoom(seconds: float) -> Reals:
        smaller = math.exp(-px_per_second * seconds / reach)
        return photo(shown or "coins", y * smaller, x * smaller)

    def plain(seconds: float) -> Reals:
        down, right = moved(seconds)
        picture = 0.35 + 0.2 * np.tanh((down + right) / reach)
        for number, (row, column) in enumerate(((-0.4, -0.5), (0.3, 0.4), (-0.5, 0.6), (0.6, -0.3))):
            distance = np.maximum(np.abs(down - row * reach), np.abs(right - column * reach) * (1 + number % 2))
            picture += (0.35 - 0.2 * number) / (1.0 + np.exp(np.clip((distance - 0.22 * reach) / 0.5, -50.0, 50.0)))
        return np.clip(picture, 0.0, 1.0)

    def thin(seconds: float) -> Reals:
        down, right = moved(seconds)
        picture = 0.5 + 0.15 * np.tanh(down / reach)
        for number, (angle, place) in enumerate(((0.3, -0.5), (1.2, 0.1), (2.0, 0.6), (2.8, -0.1))):
            distance = down * math.cos(angle) + right * math.sin(angle) - place * reach
            picture += (-0.4 if number % 2 else 0.3) * np.exp(-0.5 * (distance / 0.8) ** 2)
        return np.clip(picture, 0.0, 1.0)

    def flicker(seconds: float) -> Reals:
        lamp = 1.0 - _FLICKER_SHARE * (0.5 + 0.5 * math.sin(2 * math.pi * _FLICKER_HZ * seconds))
        return photo("coffee", *moved(seconds)) * lamp

    def wrapped(at: Reals, period: float) -> Reals:
        inside: Reals = (at + period / 2) % period - period / 2
        return inside

    def discs(seconds: float) -> Reals:
        picture = rests.copy()
        for number, (row, column) in enumerate(((-0.6, -0.4), (0.1, 0.7), (0.6, -0.3))):
            radius, place = (0.34 - 0.06 * number) * reach, path(seconds + number / 3) * px_per_second
            down, right = (
                wrapped(at - share * reach - way, side + 2 * radius + 4)
                for at, share, way, side in zip((y, x), (row, column), place, (height, width), strict=True)
            )
            cover = np.clip(0.5 + radius - np.hypot(down, right), 0.0, 1.0)
            picture += (0.15 + 0.37 * number - picture) * cover
        return picture

    def insects(seconds: float) -> Reals:
        picture, random = rests.copy(), np.random.default_rng(1)
        for row, column, heading, share in random.uniform(-0.5, 0.5, (round(height * width / 400), 4)):
            ahead, aside = path(seconds + column + 0.5) * px_per_second * (0.75 + share / 2)
            cosine, sine = math.cos(2 * math.pi * heading), math.sin(2 * math.pi * heading)
            down = wrapped(y[:, :1] - row * height - (ahead * cosine - aside * sine), height + 12)
            right = wrapped(x[:1] - column * width - (ahead * sine + aside * cosine), width + 12)
            picture *= 1.0 - 0.9 * np.exp(-0.5 * down**2) * np.exp(-0.5 * right**2)
        return picture

    def rain(seconds: float) -> Reals:
        picture, random = rests.copy(), np.random.default_rng(2)
        for row, column, share in random.uniform(-0.5, 0.5, (round(height * width / 300), 3)):
            down = wrapped(y[:, :1] - row * height - seconds * px_per_second * (1 + 0.4 * share), height + 40)
            cover = 0.5 * np.exp(-0.5 * (down / 4.0) ** 2) * np.exp(-0.5 * ((x[:1] - column * width) / 0.7) ** 2)
            picture += (0.85 - picture) * cover
        return picture

    kinds = {
        "parallax": parallax, "occlusion": occlusion, "rotation": rotation, "zoom": zoom, "plain": plain,
        "thin": thin, "flicker": flicker, "discs": discs, "insects": insects, "rain": rain,
    }  # fmt: skip
    return RenderedScene(name, kinds.get(name) or (lambda seconds: photo(name, *moved(seconds))))


def _binned(events: Events, sign: int, edges: Reals, pixels: int) -> npt.NDArray[np.int64]:
    """Return counts of one polarity; an event at the edge of two bins belongs to the earlier one."""
    bins = len(edges) - 1
    place = np.searchsorted(edges, events.seconds, side="left") - 1
    inside = (events.polarity == sign) & (place >= 0) & (place < bins)
    counted = np.bincount(place[inside] * pixels + events.pixel[inside], minlength=bins * pixels)
    return counted.reshape(bins, pixels)


def path(seconds: float) -> Reals:
    """Return (down, right) after a time on the winding path, in units of the speed."""
    table = _path_table()
    place = min(seconds * _PATH_HZ, len(table) - 1.000001)
    first = int(place)
    at: Reals = table[first] + (place - first) * (table[first + 1] - table[first])
    return at


@lru_cache(maxsize=1)
def _path_table() -> Reals:
    direction = 0.5 + 1.5 * np.sin(2 * np.pi * (np.arange(int(_LONGEST_SECONDS * _PATH_HZ)) + 0.5) / _PATH_HZ)
    steps = np.stack([np.sin(direction), np.cos(direction)], axis=1) / _PATH_HZ
    return np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])


@lru_cache(maxsize=8)
def _spline(name: str) -> Reals:
    spline: Reals = ndimage.spline_filter(photograph(name) / 255.0, mode="mirror")
    return spline


def photo(name: str, y: Reals, x: Reals) -> Reals:
    """Return a photograph at places relative to its middle, mirrored beyond its border."""
    spline = _spline(name)
    place = [y + (spline.shape[0] - 1) / 2, x + (spline.shape[1] - 1) / 2]
    seen: Reals = ndimage.map_coordinates(spline, place, mode="mirror", prefilter=False)
    return np.clip(seen, 0.0, 1.0)

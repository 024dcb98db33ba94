"""Kinds of rendered scenes that predicted losses are calibrated on, and others that they are judged by.

Which kinds calibrate was fixed before any was looked at. The blurred photographs that calibrate, and the last three
kinds that are held out, were added after the first nine had been looked at once. Speeds are px a frame at
FRAMES_PER_SECOND, the fastest part's, or the mean speed of what shakes. The truth of each scene is rendered at eight
times its speed, at least 24 times a frame.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from tests.oracles.rendered import Counts, Reals, RenderedScene, path, photo, rendered_scene

FRAMES_PER_SECOND, SIDE_PX, STEPS, THRESHOLD = 30.0, 128, 6, 0.2
SPEEDS_PX = (1.0, 3.0, 6.0, 12.0)
_SHAKE_HZ = (9.0, 5.0, 13.0)
_REACH = SIDE_PX / 2
_Y, _X = np.mgrid[0:SIDE_PX, 0:SIDE_PX] - (SIDE_PX - 1) / 2
Light = Callable[[float], Reals]
Frames = npt.NDArray[np.uint8]


def _begin(number: int) -> float:
    """Return where on the winding path a scene begins, seconds: before it there is room for half an exposure."""
    return 0.1 + 0.37 * number


class Seen(NamedTuple):
    """A scene as a video shows it, and its true events in bins of a frame."""

    kind: str
    name: str
    px_per_frame: float
    frames: Frames
    true: Counts


def pan(picture: str, px: float, number: int) -> Light:
    def light(seconds: float) -> Reals:
        down, right = path(_begin(number) + seconds) * px
        return photo(picture, _Y - down, _X - right)

    return light


def _turn(picture: str, px: float, number: int) -> Light:
    def light(seconds: float) -> Reals:
        angle = (-1) ** number * px * seconds / _REACH
        return photo(picture, _Y * math.cos(angle) - _X * math.sin(angle), _Y * math.sin(angle) + _X * math.cos(angle))

    return light


def _zoom(picture: str, px: float, number: int) -> Light:
    def light(seconds: float) -> Reals:
        scale = math.exp((-1) ** (number + 1) * px * seconds / _REACH)
        return photo(picture, _Y * scale, _X * scale)

    return light


def shake(picture: str, px: float, number: int) -> Light:
    hertz = _SHAKE_HZ[number % len(_SHAKE_HZ)]
    largest, heading = px / (4.0 * hertz), 0.4 + 1.1 * number

    def light(seconds: float) -> Reals:
        away = largest * math.sin(2.0 * math.pi * hertz * seconds + number)
        return photo(picture, _Y - away * math.sin(heading), _X - away * math.cos(heading))

    return light


def _discs(picture: str, px: float, number: int, behind: float, count: int) -> Light:
    """Return plain and textured discs over a picture that moves at a share of their speed, the other way."""
    rng = np.random.default_rng(number)
    places, sizes = rng.uniform(-0.5, 0.5, (count, 2)) * _REACH, rng.uniform(0.25, 0.45, count) * _REACH
    greys = rng.choice([0.1, 0.3, 0.9], count)
    middle = path(_begin(number) + 0.5 * STEPS / FRAMES_PER_SECOND)

    def light(seconds: float) -> Reals:
        down, right = (path(_begin(number) + seconds) - middle) * px
        seen = photo(picture, _Y + behind * down, _X + behind * right)
        for each, ((top, left), size, grey) in enumerate(zip(places, sizes, greys, strict=True)):
            turned = (down, right) if each % 2 == 0 else (right, -down)
            y, x = _Y - turned[0] - top, _X - turned[1] - left
            cover = np.clip(0.5 + size - np.hypot(y, x), 0.0, 1.0)
            front = photo("gravel", y, x) if (number + each) % 2 else grey
            seen = seen * (1.0 - cover) + front * cover
        return seen

    return light


def disc_over_still(picture: str, px: float, number: int) -> Light:
    return _discs(picture, px, number, 0.0, 1)


def _discs_over_moving(picture: str, px: float, number: int) -> Light:
    return _discs(picture, px, number, 0.4, 3)


def _hand_held(picture: str, px: float, number: int) -> Light:
    """Return a pan with a slow shake on it."""
    hertz, heading = 4.0 + number % 3, 0.4 + 1.1 * number

    def light(seconds: float) -> Reals:
        down, right = path(_begin(number) + seconds) * px
        away = 0.5 * px / (4.0 * hertz) * math.sin(2.0 * math.pi * hertz * seconds + number)
        return photo(picture, _Y - down - away * math.sin(heading), _X - right - away * math.cos(heading))

    return light


def _known(name: str, each: float = 0.37) -> Callable[[str, float, int], Light]:
    """Return scenes of ``rendered.py``, each begun later by this time in seconds."""

    def made(_: str, px: float, number: int) -> Light:
        light = rendered_scene(name, SIDE_PX, SIDE_PX, px).light
        return lambda seconds: light(each * number + seconds)

    return made


class Kind(NamedTuple):
    """A kind of scene: what moves how, which pictures it shows, and the exposure of its frames."""

    moves: Callable[[str, float, int], Light]
    pictures: tuple[str, ...]
    exposure: float = 0.0


CALIBRATION = {
    "photograph pans": Kind(pan, ("coffee", "camera")),
    "leaves turn": Kind(_turn, ("leaves1", "leaves2")),
    "disc over a still photograph": Kind(disc_over_still, ("coffee", "coins")),
    "leaves shake": Kind(shake, ("leaves1", "leaves2")),
    "photograph zooms": Kind(_zoom, ("camera", "coins")),
    "blurred leaves pan": Kind(pan, ("leaves1", "leaves2"), 0.5),
    "blurred photograph pans": Kind(pan, ("coins", "camera"), 0.8),
    "discs over moving leaves": Kind(_discs_over_moving, ("leaves1", "leaves2")),
    "lamp over a pan": Kind(_known("flicker"), ("", "")),
}
HELD_OUT = {
    "leaves pan": Kind(pan, ("leaves3", "leaves4")),
    "photograph turns": Kind(_turn, ("chelsea", "astronaut")),
    "disc over still leaves": Kind(disc_over_still, ("leaves3", "leaves4")),
    "photograph shakes": Kind(shake, ("rocket", "astronaut")),
    "leaves zoom": Kind(_zoom, ("leaves3", "leaves4")),
    "blurred photograph turns": Kind(_turn, ("chelsea", "rocket"), 0.5),
    "discs over a moving photograph": Kind(_discs_over_moving, ("astronaut", "rocket")),
    "two layers": Kind(_known("parallax"), ("", "")),
    "plain shapes": Kind(_known("plain", 0.0), ("",)),
    "blurred leaves zoom": Kind(_zoom, ("leaves5", "leaves6"), 0.6),
    "hand-held photograph": Kind(_hand_held, ("astronaut", "gravel")),
    "hand-held leaves": Kind(_hand_held, ("leaves5", "leaves6")),
}


def frames_of(moves: Callable[[str, float, int], Light], picture: str, px: float, exposure: float = 0.0) -> Frames:
    """Return the frames of the first scene of its kind, at a speed in px a frame."""
    scene = RenderedScene("", moves(picture, px * FRAMES_PER_SECOND, 0), exposure)
    return scene.frames(FRAMES_PER_SECOND, STEPS + 1)


def scenes_of(kind: str) -> Iterator[Seen]:
    """Yield the scenes of a kind: each picture at each speed."""
    moves, pictures, exposure = (CALIBRATION | HELD_OUT)[kind]
    for number, (picture, px) in enumerate((picture, px) for px in SPEEDS_PX for picture in pictures):
        scene = RenderedScene(kind, moves(picture, px * FRAMES_PER_SECOND, number), exposure)
        edges = np.arange(STEPS + 1) / FRAMES_PER_SECOND
        true = scene.counts(edges, THRESHOLD, FRAMES_PER_SECOND * max(24, round(8 * px)))
        yield Seen(kind, picture or f"{number % 2}", px, scene.frames(FRAMES_PER_SECOND, STEPS + 1), true)

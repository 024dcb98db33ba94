"""Scenes whose events are known: light given by formula, and photographs moved along a known path.

An analytic scene is a log intensity that is a function of time and pixel, with the times at which it turns. Between its
turns it is monotone, so its true events follow exactly from its values there (``dense_events`` on the turns and the
edges of the bins), whatever happens in between.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import ndimage  # type: ignore[import-untyped]

from tests.oracles.dense import bin_events, dense_events
from tests.oracles.known_motion import photograph

Reals = npt.NDArray[np.float64]
SECONDS = 1.0
"""Duration of every analytic scene."""
PIXELS = 256
START_SHARE = 1 / math.pi
"""Every residual starts at this share of the threshold: from 0, symmetric scenes would meet thresholds exactly at the
edges of bins, where rounding decides which bin an event falls into; so they would from any simple fraction."""
_JUMP_SECONDS = 0.4837  # between frames of any of the usual rates


@dataclass(frozen=True)
class Scene:
    """One analytic scene.

    Attributes:
        name: what it shows.
        monotone: True where no pixel ever turns: then no frame rate can miss an event.
        level: log intensity [n, pixels] of times [n, 1] or [n, pixels] (seconds).
        turns: [m, pixels] seconds, ascending for each pixel; times at which a pixel may turn, or jump.
    """

    name: str
    monotone: bool
    level: Callable[[Reals], Reals]
    turns: Reals

    def events(self, edges: Reals, threshold: float) -> tuple[npt.NDArray[np.int64], int]:
        """Return the true signed counts [bins, pixels] between the edges (seconds), and the number of events.

        The residual starts at START_SHARE of the threshold.
        """
        times = np.concatenate([self.turns, np.broadcast_to(edges[:, None], (len(edges), self.turns.shape[1]))])
        times = np.sort(np.clip(times, edges[0], edges[-1]), axis=0)
        start = np.full(times.shape[1], START_SHARE * threshold)
        events = dense_events(self.level(times), times, start, threshold, threshold)
        return bin_events(events, edges, times.shape[1]), len(events.seconds)


def analytic_scenes() -> list[Scene]:
    """Return ramps, jumps, sinusoids, moving edges and gratings, lamps."""
    each = np.linspace(0.0, 1.0, PIXELS)
    still = np.empty((0, PIXELS))
    jump = np.full((1, PIXELS), _JUMP_SECONDS)
    scenes = [
        Scene("ramp up, 0.5 to 6 log units", True, lambda t: -6.5 + (0.5 + 5.5 * each) * t, still),
        Scene("ramp down, 0.5 to 6 log units", True, lambda t: -0.5 - (0.5 + 5.5 * each) * t, still),
        Scene("jump of -5 to 5 log units", True, lambda t: -6.0 + 0 * t + (10.0 * each - 5.0) * (t > jump), jump),
    ]
    for hertz in (1.0, 5.0, 12.0):
        scenes.append(_sinusoid(f"sinusoid of {hertz:g} Hz, +-0.97 log units", hertz, each, lambda s: 0.97 * s))
    for speed, width in ((200.0, 1.0), (200.0, 8.0)):
        scenes.append(_edge(speed, width))
    scenes.append(_sinusoid("grating, 5 periods a second, contrast 0.8", 5.0, each, lambda s: np.log1p(0.8 * s)))
    scenes.append(_sinusoid("lamp at 100 Hz, contrast 0.9", 100.0, 0.0 * each, lambda s: np.log1p(0.9 * s)))
    return scenes


def _sinusoid(name: str, hertz: float, phase: Reals, form: Callable[[Reals], Reals]) -> Scene:
    """Return a scene of ``form`` of sin(2 pi (hertz t + phase)), increasing in the sine; it turns where that is +-1."""
    half = np.arange(math.ceil(2 * hertz * SECONDS) + 5)[:, None]
    turns = (half / 2 - 0.75 - phase) / hertz
    return Scene(name, False, lambda t: form(np.sin(2 * np.pi * (hertz * t + phase))), turns)


def _edge(speed: float, width: float) -> Scene:
    """Return a soft edge from dark (0.05) to bright (0.9) that passes over a row of pixels; its profile is logistic."""
    place = np.linspace(0.25, 0.75, PIXELS) * speed * SECONDS

    def level(t: Reals) -> Reals:
        bright: Reals = np.log(0.05 + 0.85 / (1.0 + np.exp(np.clip((place - speed * t) / width, -500, 500))))
        return bright

    return Scene(f"edge, {width:g} px wide, {speed:g} px/s", True, level, np.empty((0, PIXELS)))


def moved_photograph(name: str, frames: int, height: int, width: int, px_per_frame: float) -> Reals:
    """Return a photograph of scikit-image seen by a camera that moves at constant speed along a winding path.

    Args:
        name: of ``known_motion.PHOTOGRAPHS``.
        frames: how many, at equal times.
        height, width: of the picture, px.
        px_per_frame: speed; every displacement is a real number, rendered with the photograph's cubic spline.

    Returns:
        [frames, height, width] float64 in 0 .. 1, what an ideal sensor would see, before any rounding.
    """
    picture = photograph(name).astype(np.float64) / 255.0
    spline = ndimage.spline_filter(picture, mode="mirror")
    phase = np.linspace(0.0, 1.0, frames)
    direction = 0.5 + 1.5 * np.sin(2 * np.pi * phase)
    step = px_per_frame * np.stack([np.sin(direction), np.cos(direction)])
    path = np.concatenate([np.zeros((2, 1)), np.cumsum(step[:, 1:], axis=1)], axis=1)
    top, left = (picture.shape[0] - height) / 2, (picture.shape[1] - width) / 2
    row, column = np.mgrid[0:height, 0:width].astype(np.float64)
    seen = np.empty((frames, height, width))
    for number in range(frames):
        place = [row + top + path[0, number], column + left + path[1, number]]
        ndimage.map_coordinates(spline, place, output=seen[number], mode="mirror", prefilter=False)
    return np.clip(seen, 0.0, 1.0, out=seen)

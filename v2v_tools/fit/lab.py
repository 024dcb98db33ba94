"""Measure a simulated camera as a laboratory does: steps of light, still light, light that swings.

threshold, its spread   slow ramps of log intensity up and down; a pixel's threshold is the ramp by its events
background rate         still light, dark and bright
latency                 time from a step of light to the first event, half of the pixels
bandwidth               frequency at which the events of a swinging light fall to 1 / sqrt(2)
refractory period       shortest interval between events of a pixel in a steep ramp
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from v2v_protocol.events import EventList
from v2v_protocol.recipe import Recipe, effect_settings
from v2v_server.simulation.clip import simulate
from v2v_server.simulation.effects import NOISE
from v2v_tools.fit.interval import Doubles

_SIDE_PX = 32
DARK_GREY, BRIGHT_GREY = 70, 255
_RAMP_GREYS = 40, 255
_FREQUENCIES_HZ = np.geomspace(2.0, 1000.0, 19)


def camera_of(recipe: Recipe) -> dict[str, float]:
    """Return the camera in the middle of a recipe's ranges; noise and hot pixels stay out if they are per frame."""
    low, high = recipe.threshold
    threshold, ratio = (low + high) / 2, sum(recipe.threshold_ratio) / 2
    camera = {name: sum(getattr(recipe, name)) / 2 for name in effect_settings()}
    camera |= {"threshold_pos": threshold, "threshold_neg": threshold * ratio, "log_eps": sum(recipe.log_eps) / 2}
    return camera | {"gamma": recipe.gamma}


def measure(camera: Mapping[str, float]) -> dict[str, float]:
    """Simulate the experiments.

    Args:
        camera: parameters by the recipe's names, ``threshold_pos``, ``threshold_neg``, ``gamma``.

    Returns:
        by name: ``threshold_on``, ``threshold_off`` (log units), ``threshold_spread`` (share), ``background_dark_hz``,
        ``background_bright_hz``, ``latency_dark_us``, ``latency_bright_us``, ``bandwidth_bright_hz``,
        ``refractory_us``. NaN where no event was seen.
    """
    quiet = {name: 0.0 if name in (*NOISE, "dead_pixel_share") else value for name, value in camera.items()}
    on, off = (_ramp_thresholds(quiet, 4.0, falls=falls) for falls in (False, True))
    still = [_rate(camera, grey) for grey in (DARK_GREY, BRIGHT_GREY)]
    # Between events of a ramp pass the refractory period and the time in which the ramp rises by a threshold.
    seconds = 0.02
    period = _mean(_ramp_thresholds(quiet, seconds, falls=False)) - _mean(on)
    return {
        "threshold_on": _mean(on),
        "threshold_off": _mean(off),
        "threshold_spread": float(np.std(on) / np.mean(on)) if len(on) else math.nan,
        "background_dark_hz": still[0],
        "background_bright_hz": still[1],
        "latency_dark_us": _latency_us(quiet, DARK_GREY // 2, DARK_GREY),
        "latency_bright_us": _latency_us(quiet, BRIGHT_GREY // 2, BRIGHT_GREY),
        "bandwidth_bright_hz": _bandwidth_hz(quiet),
        "refractory_us": max(1e6 * seconds * period / (_ends(camera)[1] - _ends(camera)[0]), 0.0),
    }


def table(columns: Mapping[str, Mapping[str, float]]) -> str:
    """Return a table of measurements: a row for each quantity, a column for each camera or data sheet."""
    rows = list(dict.fromkeys(name for column in columns.values() for name in column))
    lines = ["  ".join([f"{'':22s}", *(f"{name:>14s}" for name in columns)])]
    for row in rows:
        cells = (f"{column.get(row, math.nan):14.4g}".replace("nan", "  -") for column in columns.values())
        lines.append("  ".join([f"{row:22s}", *cells]))
    return "\n".join(lines)


def _events(camera: Mapping[str, float], greys: Doubles, frames_per_second: float) -> EventList:
    frames = np.rint(greys).astype(np.uint8)[:, None, None] * np.ones((1, _SIDE_PX, _SIDE_PX), np.uint8)
    arguments: dict[str, Any] = dict(camera)
    made = simulate(frames, bins=1, frames_per_second=frames_per_second, **arguments)
    return made.to_events(1e6 / frames_per_second)


def _ramp_thresholds(camera: Mapping[str, float], seconds: float, *, falls: bool) -> Doubles:
    """Return the mean change of a ramp between two events of a pixel, log units: [pixels that fire three times]."""
    count = max(3, round(seconds * (50.0 if seconds > 1 else 1000.0)))
    low, high = _ends(camera)
    wanted = np.linspace(low, high, count + 1)
    greys = np.rint(255.0 * np.maximum(np.exp(wanted) - camera["log_eps"], 0.0) ** (1 / camera["gamma"]))
    events = _events(camera, greys[::-1] if falls else greys, count / seconds)
    first, last, number = _spans(events)
    fires = number >= 3
    return np.asarray((last - first)[fires] / (number[fires] - 1) * 1e-6 / seconds * (high - low))


def _spans(events: EventList) -> tuple[Doubles, Doubles, Doubles]:
    """Return the times of the first and the last event of each pixel, us, and the number of its events."""
    place, t = events.y.astype(np.int64) * events.width_px + events.x, events.t.astype(np.float64)
    first, last = np.full(_SIDE_PX**2, np.inf), np.zeros(_SIDE_PX**2)
    np.minimum.at(first, place, t)
    np.maximum.at(last, place, t)
    return first, last, np.bincount(place, minlength=_SIDE_PX**2).astype(np.float64)


def _ends(camera: Mapping[str, float]) -> tuple[float, float]:
    """Return the log intensity at the ends of a ramp."""
    low, high = (math.log(camera["log_eps"] + (grey / 255.0) ** camera["gamma"]) for grey in _RAMP_GREYS)
    return low, high


def _mean(values: Doubles) -> float:
    return float(values.mean()) if len(values) else math.nan


def _rate(camera: Mapping[str, float], grey: int, seconds: float = 10.0) -> float:
    events = _events(camera, np.full(round(seconds * 50) + 1, float(grey)), 50.0)
    return len(events) / seconds / _SIDE_PX**2


def _latency_us(camera: Mapping[str, float], before: int, after: int) -> float:
    """Return the median time from a step of light to a pixel's first event: of a photoreceptor without delay, 0."""
    begin, frames_per_second = 3, 10_000.0
    greys = np.concatenate([np.full(begin, float(before)), np.full(2000, float(after))])
    first = np.median(_spans(_events(camera, greys, frames_per_second))[0])
    return float(first) - 1e6 * (begin - 1) / frames_per_second if np.isfinite(first) else math.nan


def _bandwidth_hz(camera: Mapping[str, float]) -> float:
    swings = 200.0 + 50.0 * np.sin(2 * math.pi * np.arange(0.0, 6.0, 1 / 32))
    quick = {**camera, "refractory_seconds": 0.0}
    counts = np.array([len(_events(quick, swings, 32 * frequency)) for frequency in _FREQUENCIES_HZ], np.float64)
    falling = np.minimum.accumulate(counts)[::-1] / max(counts[0], 1.0)
    if not falling[0] < math.sqrt(0.5) < falling[-1]:
        return math.nan
    return float(np.exp(np.interp(math.sqrt(0.5), falling, np.log(_FREQUENCIES_HZ[::-1]))))

"""Write a fitted camera as a recipe; report in words and draw what was fitted and what was not."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from v2v_pictures.colours import Image
from v2v_pictures.comparison import Curves, draw_comparison
from v2v_protocol.recipe import Recipe
from v2v_protocol.safe_yaml import format_yaml
from v2v_protocol.settings import settings_of
from v2v_protocol.write_aside import write_file
from v2v_server.simulation.effects import EFFECTS
from v2v_tools.fit.fit import FittedCamera
from v2v_tools.fit.interval import Doubles, Estimate
from v2v_tools.fit.statistics import BRIGHTNESS_EDGES, COUNT_EDGES, INTERVAL_EDGES_US, Panels, per_second

_UNITS = {"threshold_pos": "log units", "threshold_neg": "log units"}
_DIGITS = 4


def recipe_fields(fitted: FittedCamera) -> dict[str, Any]:
    """Return the fields of the recipe that differ from the recipe ``paper``; ranges are the intervals.

    A clip starts as in a running camera. A parameter that the recording cannot tell is off; thresholds that it cannot
    tell stay those of ``paper``.
    """
    fields: dict[str, Any] = {
        "preset": "paper", "start": "triangular", "noise_sigma": [0.0, 0.0], "noise_unit": "second",
        "hot_pixel_share": [0.0, 0.0], "hot_pixel_sigma": [0.0, 0.0],
    }  # fmt: skip
    used = {name: made for name, made in fitted.estimates.items() if name in fitted.camera}
    if {"threshold_pos", "threshold_neg"} <= used.keys():
        less, more = sorted((used.pop("threshold_pos"), used.pop("threshold_neg")), key=lambda made: made.value)
        doubt = max((made.high - made.low) / 2 / made.value for made in (less, more))
        ratio = more.value / less.value
        fields["threshold"] = _range(less.low, less.high)
        fields["threshold_ratio"] = _range(max(1.0, ratio * (1 - doubt)), max(1.0, ratio * (1 + doubt)))
    for name, made in used.items():
        low, high = shown_interval(name, made)
        setting = settings_of(Recipe)[name]
        fields[name] = _range(max(low, setting.low), min(high, setting.high))
    return fields


def shown_interval(name: str, made: Estimate) -> tuple[float, float]:
    """Return the interval in the unit of the recipe; the corner frequency is estimated as 1 / Hz."""
    if name != "photoreceptor_hz":
        return made.low, made.high
    return 1.0 / max(made.high, 1e-6), 1.0 / max(made.low, 1e-4)


def write_recipe(path: Path, fitted: FittedCamera, source: str) -> None:
    """Write the recipe file, with the report as comments.

    Raises:
        UsageError: the file cannot be written.
    """
    comments = "".join(f"# {line}\n" for line in report_lines(fitted, source))
    write_file(path, comments + format_yaml(recipe_fields(fitted)), "--out")


def report_lines(fitted: FittedCamera, source: str) -> list[str]:
    """Return the report: the recording, each parameter with its interval, and what was left out and why."""
    facts = fitted.facts
    lines = [
        f"Camera of {source}, fitted by v2v-fit: {facts['events']:.0f} events "
        f"({100 * facts['on_share']:.0f} % brighter), {facts['frames']:.0f} frames, {facts['seconds']:.1f} s; "
        f"{facts['pixels']:.0f} pixels in use",
        *fitted.notes,
        *_of_frames(fitted),
        "Fitted (90 % intervals; thresholds and log_eps are those of linear intensity):",
    ]
    for name, made in fitted.estimates.items():
        if name not in fitted.left_out:
            low, high = shown_interval(name, made)
            value = made.value if name != "photoreceptor_hz" else 1.0 / max(made.value, 1e-4)
            unit = _UNITS.get(name) or settings_of(Recipe)[name].unit
            lines.append(f"  {name} = {value:.3g} [{low:.3g}, {high:.3g}] {unit}".rstrip() + f": {made.note}")
    lines.append("Left out:")
    for name, why in fitted.left_out.items():
        made = fitted.estimates[name]
        low, high = shown_interval(name, made)
        between = f" ({low:.3g} to {high:.3g})" if math.isfinite(high - low) else ""
        lines.append(f"  {name}: {why}" if made.told else f"  {name}: this recording cannot tell{between}: {why}")
    if {"threshold_pos", "threshold_neg"} <= fitted.camera.keys():
        lines.append("A recipe draws which polarity has the larger threshold: it keeps the ratio, not its direction.")
    return lines


def _of_frames(fitted: FittedCamera) -> list[str]:
    """Return what was assumed of the frames: their light and their times."""
    if not fitted.facts["frames"]:
        return []
    late, times = fitted.late, f"cannot be judged: {fitted.late.note}"
    if math.isfinite(late.value):
        times = (
            f"they show the light of {1e3 * late.value:.1f} ms later "
            f"[{1e3 * late.low:.1f}, {1e3 * late.high:.1f}], as blurred frames do too; --frame-offset adds to them"
        )
    return [
        f"Light of the frames: {fitted.light.name}. The recipe is valid for it; its gamma is that of its videos",
        f"Times of the frames: {times}",
    ]


def draw_fit(fitted: FittedCamera, source: str) -> Image:
    """Draw the page: [height, width, 3] uint8 RGB."""
    measured = _curves(fitted.measured)
    simulated = None if fitted.simulated is None else _curves(fitted.simulated)
    grey = [f"{low}" for low in BRIGHTNESS_EDGES[:-1]]
    gaps = ["" if number % 3 else f"{edge / 1e3:.3g} ms" for number, edge in enumerate(INTERVAL_EDGES_US[:-1])]
    counts = [f"{low}" for low in COUNT_EDGES[:-1]]
    titles = (
        ("rates", "darker events a pixel and second, by grey level", grey),
        ("rates", "brighter events a pixel and second, by grey level", grey),
        ("still", "noise, darker: pixels without a change, by grey level", grey),
        ("still", "noise, brighter: pixels without a change, by grey level", grey),
        ("pixels", "share of the pixels, by events", counts),
        ("rates", "brighter events as a share, by grey level", grey),
        ("intervals", "share of intervals between events of one polarity", gaps),
        ("intervals", "share of intervals between opposite events", gaps),
    )
    shown = {name: ", ".join(effect.FIELD for effect in EFFECTS if name == effect.PANEL) for name, *_ in titles}
    panels = [
        Curves(f"{title} ({shown[name]})", ticks, measured[number], None if simulated is None else simulated[number])
        for number, (name, title, ticks) in enumerate(titles)
    ]
    lines = report_lines(fitted, source)
    return draw_comparison(lines[0], panels, lines[1:])


def _curves(panels: Panels) -> list[Doubles]:
    rates, still = (
        per_second(panels["rates"], panels["exposure"]),
        per_second(panels["still"], panels["still_exposure"]),
    )
    pixels, intervals = (panels[name] / max(panels[name].sum(), 1.0) for name in ("pixels", "intervals"))
    off, on = rates[:8], rates[8:]
    share = np.divide(on, on + off, out=np.zeros_like(on), where=on + off > 0)
    return [off, on, still[:8], still[8:], pixels, share, intervals[:22], intervals[22:]]


def _range(low: float, high: float) -> list[float]:
    return [float(f"{end:.{_DIGITS}g}") for end in (low, high)]

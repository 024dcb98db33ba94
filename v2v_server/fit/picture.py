"""Draw a fitted camera: measured against simulated statistics, by panel, and what was fitted."""

from __future__ import annotations

import numpy as np

from v2v_pictures.colours import Image
from v2v_pictures.comparison import Curves, draw_comparison
from v2v_server.fit.fit import FittedCamera
from v2v_server.fit.interval import Doubles
from v2v_server.fit.report import report_lines
from v2v_server.fit.statistics import BRIGHTNESS_EDGES, COUNT_EDGES, INTERVAL_EDGES_US, Panels, per_second


def draw_fit(fitted: FittedCamera, source: str) -> Image:
    """Draw the page: [height, width, 3] uint8 RGB."""
    measured = _curves(fitted.measured)
    simulated = None if fitted.simulated is None else _curves(fitted.simulated)
    grey = [f"{low}" for low in BRIGHTNESS_EDGES[:-1]]
    gaps = ["" if number % 3 else _time(edge) for number, edge in enumerate(INTERVAL_EDGES_US[:-1])]
    counts = [f"{low}" for low in COUNT_EDGES[:-1]]
    titles = (
        ("darker events a pixel and second, by grey level", grey),
        ("brighter events a pixel and second, by grey level", grey),
        ("noise, darker: pixels without a change, by grey level", grey),
        ("noise, brighter: pixels without a change, by grey level", grey),
        ("share of the pixels, by events of a pixel", counts),
        ("brighter events as a share, by grey level", grey),
        ("share of intervals between events of one polarity", gaps),
        ("share of intervals between opposite events", gaps),
    )
    panels = [
        Curves(title, ticks, measured[number], None if simulated is None else simulated[number])
        for number, (title, ticks) in enumerate(titles)
    ]
    lines = report_lines(fitted, source)
    return draw_comparison(lines[0], panels, lines[1:])


def _curves(panels: Panels) -> list[Doubles]:
    rates = per_second(panels.rates.sum(axis=0), panels.exposure.sum(axis=0))
    still = per_second(panels.still.sum(axis=0), panels.still_exposure.sum(axis=0))
    pixels, intervals = panels.pixels.sum(axis=0), panels.intervals.sum(axis=0)
    off, on = rates[:8], rates[8:]
    share = np.divide(on, on + off, out=np.zeros_like(on), where=on + off > 0)
    intervals = intervals / max(intervals.sum(), 1.0)
    return [off, on, still[:8], still[8:], pixels / max(pixels.sum(), 1.0), share, intervals[:22], intervals[22:]]


def _time(edge_us: float) -> str:
    return (
        f"{edge_us:.0f} us"
        if edge_us < 1e3
        else f"{edge_us / 1e3:.0f} ms"
        if edge_us < 1e6
        else f"{edge_us / 1e6:.0f} s"
    )

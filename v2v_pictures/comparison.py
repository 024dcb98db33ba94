"""A page of panels, each with a measured and a simulated distribution, and lines of text below."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from v2v_pictures import canvas
from v2v_pictures.canvas import Canvas
from v2v_pictures.colours import DARKER, Image

_WIDTH_PX, _PANEL_PX, _LINE_PX = 1400, 190, 22
_COLUMNS = 2
MEASURED, SIMULATED = canvas.INK, DARKER


@dataclass(frozen=True, eq=False)
class Curves:
    """One panel.

    Attributes:
        title: what is counted, and its unit.
        ticks: a label below each bar, "" for none.
        measured: [k] heights, at least 0.
        simulated: [k] heights in the same unit; None without a simulation.
    """

    title: str
    ticks: Sequence[str]
    measured: npt.NDArray[np.float64]
    simulated: npt.NDArray[np.float64] | None = None


def draw_comparison(title: str, panels: Sequence[Curves], lines: Sequence[str]) -> Image:
    """Draw the page: [height, width, 3] uint8. Bars are measured, lines simulated; each panel has its own scale."""
    rows = -(-len(panels) // _COLUMNS)
    step = _PANEL_PX + 3 * _LINE_PX + 14
    top = 2 * canvas.PAGE_MARGIN_PX + 40
    page = Canvas(_WIDTH_PX, top + rows * step + (len(lines) + 1) * _LINE_PX + canvas.PAGE_MARGIN_PX)
    page.title(canvas.PAGE_MARGIN_PX, canvas.PAGE_MARGIN_PX, title)
    legend = page.text(canvas.PAGE_MARGIN_PX, top - 26, "bars: measured", colour=MEASURED)
    page.text(legend + 16, top - 26, "lines: simulated", colour=SIMULATED)
    width = (_WIDTH_PX - (_COLUMNS + 1) * canvas.PAGE_MARGIN_PX) // _COLUMNS
    for number, panel in enumerate(panels):
        row, column = divmod(number, _COLUMNS)
        _draw(
            page,
            panel,
            canvas.PAGE_MARGIN_PX + column * (width + canvas.PAGE_MARGIN_PX),
            top + row * step + _LINE_PX,
            width,
        )
    for number, line in enumerate(lines):
        fits = canvas.shortened(line[::-1], _WIDTH_PX - 2 * canvas.PAGE_MARGIN_PX)[::-1]
        page.text(canvas.PAGE_MARGIN_PX, top + rows * step + number * _LINE_PX, fits)
    return page.image()


def _draw(page: Canvas, panel: Curves, left: int, top: int, width: int) -> None:
    bottom, count = top + _PANEL_PX, len(panel.measured)
    both = panel.measured if panel.simulated is None else np.concatenate([panel.measured, panel.simulated])
    highest = float(both.max(initial=0.0)) or 1.0
    x = page.text(left, top - _LINE_PX, panel.title)
    page.text(x + 12, top - _LINE_PX, f"top: {highest:.3g}", colour=canvas.SOFT)
    edges = left + width * np.arange(count + 1) / count
    heights = bottom - _PANEL_PX * panel.measured / highest
    for number in range(count):
        page.box(edges[number] + 1, heights[number], edges[number + 1] - 1, bottom, canvas.PAUSED_INK)
        page.text(
            (edges[number] + edges[number + 1]) / 2, bottom + 4, panel.ticks[number], colour=canvas.SOFT, anchor="ma"
        )
    if panel.simulated is not None:
        levels = bottom - _PANEL_PX * panel.simulated / highest
        for number in range(count):
            page.line(edges[number], levels[number], edges[number + 1], levels[number], SIMULATED, 3)
    page.frame(left, top, left + width, bottom)

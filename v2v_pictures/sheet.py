"""A page of virtual cameras: for each its draw, its activity over time, and frame, bins and flow of some moments.

Headings over the columns, an arrow for time, named pauses, and a legend below explain it. All panels share one scale.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from v2v_pictures import canvas
from v2v_pictures.camera import Camera
from v2v_pictures.canvas import GAP_PX, PAGE_MARGIN_PX, Canvas, label
from v2v_pictures.colours import BRIGHTER, DARKER, Image, draw_events, draw_flow, draw_grey, draw_wheel, full_colour
from v2v_pictures.labels import labelled_panel
from v2v_pictures.overview import draw_overview, overview_height, overview_width, whole_panel
from v2v_pictures.strip import LABEL_PX, TICKS_PX, draw_strip

_TITLE_PX, _HEADING_PX, _CAMERA_PX, _STRIP_PX, _LEGEND_PX = 64, 58, 38, 54, 132
SCALE_PX = 341
_BETWEEN_PX = 26
_LEAST_SOURCE_PX = 120
MOST_BINS = 8
_ARROWS = 4
"""Arrows along a side of a panel of flow, for readers who cannot tell the colours apart."""
_STILL = 0.15
"""Flow below this share of the largest gets no arrow."""


@dataclass(frozen=True, slots=True)
class Scale:
    """One scale of colour for all panels of a page.

    Attributes:
        full: events that get full colour.
        largest_px: flow that gets full colour.
        highest_rate: events a pixel and bin that fill a bar of the activity strips.
    """

    full: float
    largest_px: float
    highest_rate: float

    @classmethod
    def of(cls, cameras: Sequence[Camera]) -> Scale:
        """Return the scale for these cameras, from the moments that a sheet shows of them."""
        shown = [camera.voxels[moment] for camera in cameras for moment in camera.moments(3)]
        flows = [camera.flow.astype(np.float32) for camera in cameras if camera.flow is not None]
        longest = max((float(np.quantile(np.hypot(flow[:, 0], flow[:, 1]), 0.99)) for flow in flows), default=1.0)
        highest = max((float(np.quantile(camera.rates, 0.99)) for camera in cameras), default=0.0)
        return cls(full_colour(shown), max(1.0, longest), max(highest, 1e-9))


def draw_sheet(
    cameras: Sequence[Camera], title: str, *, moments: int = 1, tile_px: int = 192, whole: Camera | None = None
) -> Image:
    """Draw the page.

    Args:
        cameras: at least one; all with equally many bins, and all or none with flow.
        title: of the page.
        moments: how many voxel grids to show of each camera.
        tile_px: side of a panel.
        whole: a camera that sees the whole picture, to show first; None leaves it out.

    Returns:
        [height, width, 3] uint8 RGB.
    """
    scale = Scale.of(cameras if whole is None else [whole, *cameras])
    bins = min(cameras[0].voxels.shape[1], MOST_BINS)
    with_flow = cameras[0].flow is not None
    columns = 1 + bins + with_flow
    width = 2 * PAGE_MARGIN_PX + columns * (tile_px + GAP_PX) + 2 * 2 * GAP_PX
    strip_px = LABEL_PX + _STRIP_PX + TICKS_PX + GAP_PX
    block = _CAMERA_PX + strip_px + moments * (tile_px + GAP_PX) + _BETWEEN_PX
    first = _TITLE_PX
    if whole is not None:
        width, first = max(width, overview_width(tile_px)), first + overview_height(whole, tile_px)
    page = Canvas(width, first + _HEADING_PX + len(cameras) * block + _LEGEND_PX)
    left = _columns(bins, with_flow, tile_px)
    page.title(PAGE_MARGIN_PX, 18, title)
    if whole is not None:
        draw_overview(page, whole, cameras, _TITLE_PX, tile_px, scale.full, scale.highest_rate)
    _headings(page, left, bins, with_flow, tile_px, first)
    for number, camera in enumerate(cameras):
        top = first + _HEADING_PX + number * block
        picks = camera.moments(moments)
        _camera_line(page, camera, number, picks, top)
        top += _CAMERA_PX
        strip_left = PAGE_MARGIN_PX
        if camera.whole is not None:
            whole_panel(page, camera, PAGE_MARGIN_PX, top, tile_px, strip_px - GAP_PX)
            strip_left = left[1]
        strip_width = page.width_px - PAGE_MARGIN_PX - strip_left
        draw_strip(page, camera, strip_left, top + LABEL_PX, strip_width, _STRIP_PX, scale.highest_rate, picks)
        for row, pick in enumerate(picks):
            y = top + strip_px + row * (tile_px + GAP_PX)
            _moment(page, camera, pick, scale, left, y, tile_px)
            if len(picks) > 1:
                label(page, left[0] + 5, y + 5, f"voxel grid {pick + 1}", canvas.MARK)
    _legend(page, cameras, scale, page.height_px - _LEGEND_PX)
    return page.image()


def _columns(bins: int, with_flow: bool, tile_px: int) -> list[int]:
    """Left edges of the panels; the bins stand a little apart from frame and flow."""
    step = tile_px + GAP_PX
    edges = [PAGE_MARGIN_PX] + [PAGE_MARGIN_PX + step + 2 * GAP_PX + number * step for number in range(bins)]
    return [*edges, edges[-1] + step + 2 * GAP_PX] if with_flow else edges


def _headings(page: Canvas, left: list[int], bins: int, with_flow: bool, tile_px: int, y: int) -> None:
    below = y + 27
    page.text(left[0] + tile_px / 2, y, "video frame", size=canvas.HEADING_PT, anchor="ma")
    page.text(left[0] + tile_px / 2, below, "at the end of the bins", colour=canvas.SOFT, anchor="ma")
    events_heading(page, left[1], y)
    bin_headings(page, left[1 : 1 + bins], below, tile_px)
    if with_flow:
        page.text(left[-1] + tile_px / 2, y, "optical flow", size=canvas.HEADING_PT, anchor="ma")
        page.text(left[-1] + tile_px / 2, below, "over the voxel grid", colour=canvas.SOFT, anchor="ma")


def bin_headings(page: Canvas, left: Sequence[int], y: int, tile_px: int) -> None:
    """Write the bins' numbers over their panels, with arrows of time between them."""
    for number, x in enumerate(left):
        x_end = page.text(x, y, f"bin {number + 1}", colour=canvas.SOFT)
        if number + 1 < len(left):
            page.arrow(x_end + 10, y + 11, left[number + 1] - 6)
        else:
            end = x + tile_px
            page.arrow(x_end + 10, y + 11, end - canvas.text_width("time") - 8)
            page.text(end, y, "time", colour=canvas.SOFT, anchor="ra")


def events_heading(page: Canvas, x: float, y: float, what: str = "simulated events:") -> None:
    """Write the heading of events, with what red and blue mean."""
    x = page.text(x, y, what, size=canvas.HEADING_PT)
    x = page.text(x + 10, y, "brighter", size=canvas.HEADING_PT, colour=BRIGHTER)
    page.text(x + 10, y, "darker", size=canvas.HEADING_PT, colour=DARKER)


def flow_panel(page: Canvas, x: int, y: int, flow: npt.NDArray[np.generic], largest_px: float, tile_px: int) -> None:
    """Draw flow [2, H, W], px, in colour and with arrows, whose length grows with the flow up to ``largest_px``."""
    page.panel(x, y, draw_flow(flow, largest_px), tile_px, tile_px)
    height, width = flow.shape[1:]
    scale = min(tile_px / width, tile_px / height)
    x0, y0 = x + (tile_px - width * scale) / 2, y + (tile_px - height * scale) / 2
    rows, columns = (np.linspace(0, side, _ARROWS + 1).round().astype(int) for side in (height, width))
    for top, bottom in pairwise(rows):
        for left, right in pairwise(columns):
            if bottom <= top or right <= left:
                continue
            along = flow[:, top:bottom, left:right].mean(axis=(1, 2), dtype=np.float64) / largest_px
            length = float(np.hypot(*along))
            if length < _STILL:
                continue
            along *= min(1.0, length) / length * 0.85 * tile_px / _ARROWS
            centre_x, centre_y = x0 + (left + right) / 2 * scale, y0 + (top + bottom) / 2 * scale
            page.vector(centre_x - along[0] / 2, centre_y - along[1] / 2, *along)


def _camera_line(page: Canvas, camera: Camera, number: int, picks: Sequence[int], top: int) -> None:
    page.line(PAGE_MARGIN_PX, top - 8, page.width_px - PAGE_MARGIN_PX, top - 6, canvas.SHADE, 2)
    x = page.text(PAGE_MARGIN_PX, top, f"Camera {number + 1}", size=canvas.HEADING_PT)
    if camera.title:
        x = page.text(x + 10, top, camera.title, size=canvas.HEADING_PT, colour=canvas.MARK)
    if warning := camera.warning(picks):
        x = page.text(x + 18, top + 4, warning)
    right = page.width_px - PAGE_MARGIN_PX
    x = page.text(x + 18, top + 4, canvas.beginning(camera.describe(), right - x - 18), colour=canvas.SOFT)
    if right - x > _LEAST_SOURCE_PX:
        page.text(right, top + 4, canvas.shortened(camera.source, right - x - 24), colour=canvas.SOFT, anchor="ra")


def _moment(page: Canvas, camera: Camera, pick: int, scale: Scale, left: list[int], y: int, tile_px: int) -> None:
    labelled_panel(page, camera, pick, left[0], y, draw_grey(camera.frames[pick]), tile_px, with_text=True)
    bins = camera.voxels.shape[1]
    for number in range(min(bins, MOST_BINS)):
        events = draw_events(camera.voxels[pick, number], scale.full)
        labelled_panel(page, camera, pick, left[1 + number], y, events, tile_px)
        if camera.paused[pick * bins + number]:
            label(page, left[1 + number] + 5, y + 5, "paused")
    if camera.flow is not None:
        flow_panel(page, left[-1], y, camera.flow[pick], scale.largest_px, tile_px)


def _legend(page: Canvas, cameras: Sequence[Camera], scale: Scale, top: int) -> None:
    page.line(PAGE_MARGIN_PX, top, page.width_px - PAGE_MARGIN_PX, top, canvas.LINE)
    draw_scale(page, scale.full, PAGE_MARGIN_PX, top + 16)
    x, y = PAGE_MARGIN_PX + SCALE_PX + 44, top + 16
    page.hatch(x, y + 1, x + 46, y + 19)
    page.frame(x, y + 1, x + 46, y + 19)
    page.text(x + 58, y, "the camera is paused: its picture stands still, only noise fires")
    page.frame(x, y + 29, x + 46, y + 47, canvas.MARK, 2)
    whole = any(camera.whole is not None for camera in cameras)
    crop = "; in the video: what the camera sees" if whole else ""
    page.text(x + 58, y + 28, f"in the strip: the voxel grid shown below it{crop}")
    said = "threshold: the change of log brightness that makes an event, brighter / darker"
    page.text(x, y + 56, said, colour=canvas.SOFT)
    said = "pale bars of the strip: noise; a bar is as long as the square root of the events"
    if any(camera.tracks is not None for camera in cameras):
        said = "tints in a panel: patches; trails: points that are followed; pale bars of the strip: noise"
    elif any(camera.boxes is not None or camera.masks is not None for camera in cameras):
        said += "; boxes and tints in a panel: labels, a colour a class"
    page.text(x, y + 80, said, colour=canvas.SOFT)
    if cameras[0].flow is not None:
        radius = 46
        x = page.width_px - PAGE_MARGIN_PX - 2 * radius - 1
        page.panel(x, top + 18, draw_wheel(radius), 2 * radius + 1, 2 * radius + 1)
        page.text(x - 14, y, "flow: where a pixel moves to", anchor="ra")
        page.text(x - 14, y + 28, f"rim: {scale.largest_px:.1f} px or more", colour=canvas.SOFT, anchor="ra")


def draw_scale(page: Canvas, full: float, x: int, y: int) -> None:
    """Draw the colour scale of events, SCALE_PX wide."""
    ramp = np.linspace(-full, full, SCALE_PX, dtype=np.float32)[None].repeat(20, axis=0)
    page.text(x + SCALE_PX / 2, y, "events a pixel and bin", anchor="ma")
    page.panel(x, y + 26, draw_events(ramp, full), SCALE_PX, 20)
    page.text(x, y + 52, f"{full:.0f} or more darker", colour=DARKER)
    page.text(x + SCALE_PX / 2, y + 52, "none", colour=canvas.SOFT, anchor="ma")
    page.text(x + SCALE_PX, y + 52, f"{full:.0f} or more brighter", colour=BRIGHTER, anchor="ra")

"""A page of virtual cameras: for each its draw, its activity over time, and moments of it: frame, bins, flow.

The page explains itself: headings over the columns, an arrow for time, pauses hatched and named, one scale of colour
for all panels, a legend below.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from v2v_pictures import canvas
from v2v_pictures.camera import Camera
from v2v_pictures.canvas import Canvas
from v2v_pictures.colours import BRIGHTER, DARKER, Image, draw_events, draw_flow, draw_grey, draw_wheel, full_colour

MARGIN_PX, GAP_PX = 28, 8
_TITLE_PX, _HEADING_PX, _CAMERA_PX, _STRIP_PX, _LEGEND_PX = 62, 46, 36, 46, 96
_STRIP_LABEL_PX = 116
_LEAST_SOURCE_PX = 120
_HATCH_PX = 7
_MOST_BINS = 8


@dataclass(frozen=True, slots=True)
class Scale:
    """One scale of colour for all panels of a page.

    Attributes:
        full: events that get full colour.
        largest_px: flow that gets full colour.
    """

    full: float
    largest_px: float

    @classmethod
    def of(cls, cameras: Sequence[Camera]) -> Scale:
        """For these cameras, from the moments that a sheet shows of them."""
        shown = [camera.voxels[moment] for camera in cameras for moment in camera.moments(3)]
        flows = [camera.flow.astype(np.float32) for camera in cameras if camera.flow is not None]
        longest = max((float(np.quantile(np.hypot(flow[:, 0], flow[:, 1]), 0.99)) for flow in flows), default=1.0)
        return cls(full_colour(shown), max(1.0, longest))


def draw_sheet(cameras: Sequence[Camera], title: str, *, moments: int = 1, tile_px: int = 192) -> Image:
    """The page.

    Args:
        cameras: at least one; all with as many bins, and all or none with flow.
        title: of the page.
        moments: how many voxel grids to show of each camera.
        tile_px: side of a panel.

    Returns:
        [height, width, 3] uint8 RGB.
    """
    scale = Scale.of(cameras)
    bins = min(cameras[0].voxels.shape[1], _MOST_BINS)
    with_flow = cameras[0].flow is not None
    columns = 1 + bins + with_flow
    width = 2 * MARGIN_PX + columns * (tile_px + GAP_PX) + 2 * 2 * GAP_PX
    block = _CAMERA_PX + _STRIP_PX + 18 + moments * (tile_px + GAP_PX) + 20
    page = Canvas(width, _TITLE_PX + _HEADING_PX + len(cameras) * block + _LEGEND_PX)
    left = _columns(bins, with_flow, tile_px)
    page.text(MARGIN_PX, 20, title, size=canvas.TITLE_PT)
    _headings(page, left, bins, with_flow, tile_px)
    for number, camera in enumerate(cameras):
        top = _TITLE_PX + _HEADING_PX + number * block
        picks = camera.moments(moments)
        _camera_line(page, camera, number, top)
        draw_strip(page, camera, MARGIN_PX, top + _CAMERA_PX, width - 2 * MARGIN_PX, _STRIP_PX, picks)
        for row, pick in enumerate(picks):
            y = top + _CAMERA_PX + _STRIP_PX + 18 + row * (tile_px + GAP_PX)
            _moment(page, camera, pick, scale, left, y, tile_px)
    _legend(page, scale, with_flow, page.height_px - _LEGEND_PX)
    return page.image()


def _columns(bins: int, with_flow: bool, tile_px: int) -> list[int]:
    """Left edges of the panels; the bins stand a little apart from frame and flow."""
    step = tile_px + GAP_PX
    edges = [MARGIN_PX] + [MARGIN_PX + step + 2 * GAP_PX + number * step for number in range(bins)]
    return [*edges, edges[-1] + step + 2 * GAP_PX] if with_flow else edges


def _headings(page: Canvas, left: list[int], bins: int, with_flow: bool, tile_px: int) -> None:
    y = _TITLE_PX + 4
    page.text(left[0] + tile_px / 2, y, "video frame", size=canvas.HEADING_PT, anchor="ma")
    page.text(left[0] + tile_px / 2, y + 20, "at the end of the bins", colour=canvas.SOFT, anchor="ma")
    end = left[bins] + tile_px
    events = "simulated events: one voxel grid"
    page.text((left[1] + end) / 2, y, events, size=canvas.HEADING_PT, anchor="ma")
    for number in range(bins):
        page.text(left[1 + number] + tile_px / 2, y + 20, f"bin {number + 1}", colour=canvas.SOFT, anchor="ma")
    page.text(left[1], y + 2, "time", colour=canvas.SOFT)
    page.arrow(left[1] + 34, y + 10, (left[1] + end) / 2 - canvas.text_width(events, canvas.HEADING_PT) / 2 - 12)
    page.arrow((left[1] + end) / 2 + canvas.text_width(events, canvas.HEADING_PT) / 2 + 12, y + 10, end)
    if with_flow:
        page.text(left[-1] + tile_px / 2, y, "optical flow", size=canvas.HEADING_PT, anchor="ma")
        page.text(left[-1] + tile_px / 2, y + 20, "over the voxel grid", colour=canvas.SOFT, anchor="ma")


def _camera_line(page: Canvas, camera: Camera, number: int, top: int) -> None:
    page.line(MARGIN_PX, top - 6, page.width_px - MARGIN_PX, top - 6, canvas.SHADE, 2)
    x = page.text(MARGIN_PX, top, f"Camera {number + 1}", size=canvas.HEADING_PT)
    if camera.title:
        x = page.text(x + 10, top, camera.title, size=canvas.HEADING_PT, colour=canvas.MARK)
    x = page.text(x + 18, top + 3, camera.describe(), colour=canvas.SOFT)
    right = page.width_px - MARGIN_PX
    if right - x > _LEAST_SOURCE_PX:
        page.text(right, top + 3, canvas.shortened(camera.source, right - x - 24), colour=canvas.SOFT, anchor="ra")


def draw_strip(
    page: Canvas,
    camera: Camera,
    left: int,
    top: int,
    width: int,
    height: int,
    picks: Sequence[int],
    cursor: int | None = None,
) -> None:
    """Activity over the whole clip: brighter events up, darker down; pauses hatched and named.

    Args:
        page: to draw on.
        camera: whose activity. Each strip has a scale of its own, whose top is written beside it.
        left, top, width, height: where, px.
        picks: voxel grids to point at.
        cursor: a bin to draw a line at, for films.
    """
    rates, paused, middle = camera.rates, camera.paused, top + height / 2
    highest = max(float(np.quantile(rates, 0.99)), 1e-9)
    label = _STRIP_LABEL_PX
    page.text(left, top + height / 2 - 16, "events a pixel")
    page.text(left, top + height / 2, f"up to {highest:.1g} a bin", colour=canvas.SOFT)
    left, width = left + label, width - label
    count = rates.shape[1]
    at = [left + width * number / count for number in range(count + 1)]
    edges = np.flatnonzero(np.diff(np.concatenate([[False], paused, [False]])))
    for start, end in zip(edges[::2], edges[1::2], strict=True):
        page.hatch(at[start], top, at[end], top + height)
    for number in range(count):
        up, down = np.minimum(rates[:, number] / highest, 1.0) * (height / 2)
        page.box(at[number], middle - up, at[number + 1], middle, BRIGHTER)
        page.box(at[number], middle, at[number + 1], middle + down, DARKER)
    for start, end in zip(edges[::2], edges[1::2], strict=True):  # seen behind full bars too
        page.hatch(at[start], top, at[end], top + _HATCH_PX)
        page.hatch(at[start], top + height - _HATCH_PX, at[end], top + height)
    page.line(left, middle, left + width, middle, canvas.LINE)
    page.frame(left, top, left + width, top + height)
    for start, end in zip(edges[::2], edges[1::2], strict=True):
        if at[end] - at[start] > canvas.text_width("paused") + 8:
            centre, half = (at[start] + at[end]) / 2, canvas.text_width("paused") / 2 + 4
            page.box(centre - half, middle - 9, centre + half, middle + 9, canvas.SHADE)
            page.text(centre, middle, "paused", colour=canvas.SOFT, anchor="mm")
    bins = camera.voxels.shape[1]
    for pick in picks:
        page.frame(at[pick * bins], top, at[(pick + 1) * bins], top + height, canvas.MARK)
        page.pointer((at[pick * bins] + at[(pick + 1) * bins]) / 2, top - 1)
    if cursor is not None:
        page.line(at[cursor], top, at[cursor], top + height, canvas.MARK, 2)


def _moment(page: Canvas, camera: Camera, pick: int, scale: Scale, left: list[int], y: int, tile_px: int) -> None:
    page.panel(left[0], y, draw_grey(camera.frames[pick]), tile_px, tile_px)
    bins = camera.voxels.shape[1]
    for number in range(min(bins, _MOST_BINS)):
        page.panel(left[1 + number], y, draw_events(camera.voxels[pick, number], scale.full), tile_px, tile_px)
        if camera.paused[pick * bins + number]:
            page.text(left[1 + number] + 6, y + 5, "paused", colour=canvas.SOFT)
    if camera.flow is not None:
        page.panel(left[-1], y, draw_flow(camera.flow[pick], scale.largest_px), tile_px, tile_px)


def _legend(page: Canvas, scale: Scale, with_flow: bool, top: int) -> None:
    page.line(MARGIN_PX, top, page.width_px - MARGIN_PX, top, canvas.LINE)
    y, x = top + 22, MARGIN_PX
    ramp = np.linspace(-scale.full, scale.full, 241, dtype=np.float32)[None].repeat(16, axis=0)
    page.panel(x, y, draw_events(ramp, scale.full), 241, 16)
    page.text(x, y + 22, f"{scale.full:.0f} or more darker", colour=DARKER)
    page.text(x + 241, y + 22, f"{scale.full:.0f} or more brighter", colour=BRIGHTER, anchor="ra")
    page.text(x + 120, y - 16, "events a pixel and bin", colour=canvas.SOFT, anchor="ma")
    x += 280
    page.hatch(x, y, x + 46, y + 16)
    page.frame(x, y, x + 46, y + 16)
    page.text(x + 56, y, "the camera is paused: the picture stands still, only noise fires")
    page.frame(x, y + 24, x + 46, y + 40, canvas.MARK)
    page.text(x + 56, y + 24, "the voxel grid shown below the strip")
    if with_flow:
        radius = 34
        right = page.width_px - MARGIN_PX
        wheel = draw_wheel(radius)
        page.panel(right - 2 * radius - 1, top + 12, wheel, 2 * radius + 1, 2 * radius + 1)
        page.text(right - 2 * radius - 14, y, "colour: where a pixel moves to", anchor="ra")
        page.text(
            right - 2 * radius - 14, y + 18, f"rim: {scale.largest_px:.1f} px or more", colour=canvas.SOFT, anchor="ra"
        )

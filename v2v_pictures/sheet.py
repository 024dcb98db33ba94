"""A page of virtual cameras: for each its draw, its activity over time, and frame, bins and flow of some moments.

Headings over the columns, an arrow for time, named pauses, and a legend below explain it. All panels share one scale.
The parts of the page come first: the strip of a camera's activity, the labels of a panel, and the whole picture of a
video with the places where the cameras look.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from v2v_pictures import canvas
from v2v_pictures.camera import Camera
from v2v_pictures.canvas import GAP_PX, PAGE_MARGIN_PX, Canvas, Rgb, label
from v2v_pictures.colours import BRIGHTER, DARKER, Image, draw_events, draw_flow, draw_grey, draw_wheel, full_colour

LABEL_PX, TICKS_PX = 22, 24
"""Above and below the strip."""
_HATCH_PX = 7
_PALE = 0.6
"""How much of the way to white the bars of noise are."""


def draw_strip(
    page: Canvas,
    camera: Camera,
    left: int,
    top: int,
    width: int,
    height: int,
    highest: float,
    picks: Sequence[int] = (),
    cursor: int | None = None,
) -> None:
    """Draw the strip, with LABEL_PX of text above it and TICKS_PX below it.

    Args:
        left, top, width, height: of the strip itself, px.
        highest: events a pixel and bin of a full bar, which reaches from the middle to the edge; above 0, written above
            the strip. Higher rates are cut there. One value for all strips of a page makes them comparable. A bar's
            length is the square root of its share, so that a quiet camera still shows when it fires.
        picks: voxel grids to point at.
        cursor: a bin to draw a line at, for films.
    """
    rates, middle = camera.rates, top + height / 2
    x = page.text(left, top - LABEL_PX, f"events over {camera.timing or 'the whole clip'}")
    page.text(x + 12, top - LABEL_PX, f"full bar: {highest:.2g} or more a pixel and bin", colour=canvas.SOFT)
    count = rates.shape[1]
    at = [left + width * number / count for number in range(count + 1)]
    edges = np.flatnonzero(np.diff(np.concatenate([[False], camera.paused, [False]])))
    pauses = [(at[start], at[end]) for start, end in zip(edges[::2], edges[1::2], strict=True)]
    for start, end in pauses:
        page.hatch(start, top, end, top + height)
    moving = np.where(camera.paused, 0.0, rates if camera.quiet is None else np.minimum(camera.quiet, rates))
    for bars, brighter, darker in ((rates, _pale(BRIGHTER), _pale(DARKER)), (moving, BRIGHTER, DARKER)):
        for number, (up, down) in enumerate(np.sqrt(np.minimum(bars / highest, 1.0)).T * (height / 2)):
            page.box(at[number], middle - up, at[number + 1], middle, brighter)
            page.box(at[number], middle, at[number + 1], middle + down, darker)
    for start, end in pauses:  # seen behind full bars too
        page.hatch(start, top, end, top + _HATCH_PX)
        page.hatch(start, top + height - _HATCH_PX, end, top + height)
    page.line(left, middle, left + width, middle, canvas.LINE)
    page.frame(left, top, left + width, top + height)
    for start, end in pauses:
        if end - start > canvas.text_width("paused") + 8:
            centre, half = (start + end) / 2, canvas.text_width("paused") / 2 + 4
            page.box(centre - half, middle - 10, centre + half, middle + 11, canvas.PAPER)
            page.text(centre, middle, "paused", anchor="mm")
    bins = camera.voxels.shape[1]
    for pick in picks:
        page.frame(at[pick * bins], top, at[(pick + 1) * bins], top + height, canvas.MARK, 2)
    if cursor is not None:
        page.line(at[cursor], top - 3, at[cursor], top + height + 3, canvas.MARK, 3)
        picks = [cursor // bins]
    _ticks(page, len(camera.voxels), left, width, top + height + 4, picks)


def _ticks(page: Canvas, grids: int, left: int, width: int, top: int, picks: Sequence[int]) -> None:
    """Write the number of each pick below it, and those of the first and last grid where they fit."""
    free_from, free_to = float(left), float(left + width)
    for place, pick in enumerate(picks):
        text = f"{pick + 1}" if len(picks) > 1 else f"voxel grid {pick + 1}"
        half = canvas.text_width(text) / 2
        centre = min(max(left + width * (pick + 0.5) / grids, left + half), left + width - half)
        if place == 0:
            free_to = centre - half - 12
        if place == 0 or centre - half > free_from:
            page.text(centre, top, text, colour=canvas.MARK, anchor="ma")
            free_from = centre + half + 12
    if left + canvas.text_width("voxel grid 1") < free_to or not picks:
        page.text(left, top, "voxel grid 1", colour=canvas.SOFT)
    if left + width - canvas.text_width(str(grids)) > free_from:
        page.text(left + width, top, str(grids), colour=canvas.SOFT, anchor="ra")


def _pale(colour: Rgb) -> Rgb:
    red, green, blue = (round(part + _PALE * (255 - part)) for part in colour)
    return red, green, blue


_COLOURS: tuple[Rgb, ...] = (
    (0, 128, 70),
    (190, 110, 0),
    (120, 50, 170),
    (0, 130, 140),
    (120, 110, 0),
    (180, 0, 140),
)
"""Colours of the classes, in turn: none is the red or blue of events."""
_TINT = 0.45
_NO_OBJECT = (0, 255)
_TRAIL_FRAMES = 4
"""Frames before the shown one that the trail of a point goes through."""
_TEXT_PT = 12


def class_colour(category: int) -> Rgb:
    """Return the colour of a class."""
    return _COLOURS[category % len(_COLOURS)]


def tint(image: Image, mask: npt.NDArray[np.uint8]) -> Image:
    """Return a picture [H, W, 3] tinted by the classes of a mask [H, W]; classes 0 and 255 leave it as it is."""
    tinted = image.astype(np.float32)
    for category in np.unique(mask):
        if category not in _NO_OBJECT:
            place = mask == category
            tinted[place] += _TINT * (np.array(class_colour(int(category)), np.float32) - tinted[place])
    return np.rint(tinted).astype(np.uint8)


def labelled_panel(
    page: Canvas, camera: Camera, grid: int, x: int, y: int, image: Image, tile_px: int, *, with_text: bool = False
) -> None:
    """Draw a panel with the boxes, the mask and the tracks of one voxel grid's frame.

    Args:
        camera: has the labels; without any, this is only the panel.
        grid: number of the voxel grid.
        x, y, tile_px: place and side of the panel, px.
        image: [H, W, 3], as large as the camera's frames.
        with_text: write the class of each box, and draw the tracks.
    """
    if camera.masks is not None:
        image = tint(image, camera.masks[grid])
    left, top, scale = page.panel(x, y, image, tile_px, tile_px)
    if camera.tracks is not None and with_text:
        recent = camera.tracks[max(0, grid - _TRAIL_FRAMES) : grid + 1] * (scale, scale, 1) + (left, top, 0)
        for number in np.flatnonzero(recent[-1, :, 2]):
            colour = class_colour(int(number))
            for before, after in pairwise(recent[:, number]):
                if before[2] and after[2]:
                    page.line(before[0], before[1], after[0], after[1], colour, 2)
            x0, y0, _ = recent[-1, number]
            page.box(x0 - 2, y0 - 2, x0 + 2, y0 + 2, colour)
    if camera.boxes is None:
        return
    for x0, y0, x1, y1, category, *_ in camera.boxes[grid]:
        if category < 0:
            continue
        colour = class_colour(int(category))
        right, bottom = left + x1 * scale - 1, top + y1 * scale - 1
        page.frame(left + x0 * scale, top + y0 * scale, right, bottom, colour, 2)
        if with_text:
            text = f"{int(category)}"
            size = canvas.text_width(text, _TEXT_PT) + 4
            page.box(left + x0 * scale, top + y0 * scale, left + x0 * scale + size, top + y0 * scale + 15, colour)
            page.text(left + x0 * scale + 2, top + y0 * scale + 1, text, size=_TEXT_PT, colour=canvas.PAPER)


_TEXT_PX, _BELOW_PX, _STRIP_PX = 34, 34, 54
_LEAST_STRIP_PX = 490
_LEAST_HEIGHT_PX = 150
_HIGHEST_TILES = 1.75
"""Height of an upright picture, in tiles."""


def overview_width(tile_px: int) -> int:
    """Return how wide a page must be, px."""
    return 2 * PAGE_MARGIN_PX + 2 * (2 * tile_px + GAP_PX) + 3 * GAP_PX + _LEAST_STRIP_PX


def overview_height(whole: Camera, tile_px: int) -> int:
    """Return how much of a page the overview takes, px."""
    return _TEXT_PX + max(_LEAST_HEIGHT_PX, _panel(whole, tile_px)[1]) + _BELOW_PX


def draw_overview(
    page: Canvas, whole: Camera, cameras: Sequence[Camera], top: int, tile_px: int, full: float, highest_rate: float
) -> None:
    """Draw the video's frame with a numbered box for each camera, the events beside it, and the activity.

    Args:
        whole: a camera that sees the whole picture.
        cameras: those of the page; a box shows each one that looks at the same frames.
        top: first row of the overview, px.
        tile_px: a panel is two of these and a gap wide.
        full, highest_rate: see :class:`v2v_pictures.sheet.Scale`.
    """
    (grid,), (width, height) = whole.moments(1), _panel(whole, tile_px)
    bins = whole.voxels.shape[1]
    liveliest = max(range(bins), key=lambda bin_: float(whole.rates[:, grid * bins + bin_].sum()))
    left = [PAGE_MARGIN_PX, PAGE_MARGIN_PX + width + 2 * GAP_PX]
    page.text(left[0], top, "The whole picture", size=canvas.HEADING_PT)
    page.text(left[1], top, "its events", size=canvas.HEADING_PT)
    top += _TEXT_PX
    page.panel(left[0], top, draw_grey(whole.frames[grid]), width, height)
    page.panel(left[1], top, draw_events(whole.voxels[grid, liveliest], full), width, height)
    boxes = [(number, camera) for number, camera in enumerate(cameras, 1) if _same_clip(whole, camera)]
    for _, camera in boxes:
        for x in left:
            _box(page, camera, x, top, width, height)
    numbers: dict[tuple[int, int], list[str]] = {}  # cameras of one box share its label
    for number, camera in boxes:
        across, down, *_ = _place(camera, width, height)
        numbers.setdefault((round(left[0] + across) + 2, round(top + down) + 2), []).append(str(number))
    for (label_x, label_y), names in numbers.items():  # above all boxes
        canvas.label(page, label_x, label_y, ", ".join(names), canvas.MARK)
    x = left[1] + width + 3 * GAP_PX
    strip_width = page.width_px - PAGE_MARGIN_PX - x
    lines = [whole.title, f"shown: bin {liveliest + 1} of voxel grid {grid + 1}"]
    if boxes:
        lines.append("boxes: where the cameras below look")
    if warning := whole.warning([grid]):
        lines.insert(0, warning)
    for number, line in enumerate(lines):
        page.text(
            x, top + 22 * number, canvas.shortened(line, strip_width), colour=canvas.SOFT if number else canvas.INK
        )
    draw_strip(page, whole, x, top + 22 * len(lines) + LABEL_PX + GAP_PX, strip_width, _STRIP_PX, highest_rate, [grid])


def _panel(whole: Camera, tile_px: int) -> tuple[int, int]:
    """Return width and height of a panel, px."""
    return canvas.fitted(whole.frames[0], 2 * tile_px + GAP_PX, _HIGHEST_TILES * tile_px)


def _same_clip(whole: Camera, camera: Camera) -> bool:
    one, other = whole.provenance, camera.provenance
    same = (one.video, one.start_frame) == (other.video, other.start_frame)
    return same and camera.whole is not None


def whole_panel(page: Canvas, camera: Camera, x: int, y: int, width_px: int, height_px: int) -> None:
    """Draw the video's picture, small, and a box around what the camera sees of it."""
    if camera.whole is None:
        return
    size = canvas.fitted(camera.whole, width_px, height_px)
    page.panel(x, y, draw_grey(camera.whole), *size)
    _box(page, camera, x, y, *size)


def _box(page: Canvas, camera: Camera, x: int, y: int, width_px: int, height_px: int) -> None:
    """Draw a box around what the camera sees of the picture that lies in this panel."""
    left, top, right, bottom = _place(camera, width_px, height_px)
    for colour, wider in ((canvas.PAPER, 1), (canvas.MARK, 0)):
        page.frame(x + left - wider, y + top - wider, x + right - 1 + wider, y + bottom - 1 + wider, colour, 2 + wider)


def _place(camera: Camera, width_px: int, height_px: int) -> tuple[float, float, float, float]:
    """Return left, top, right and bottom of the camera's crop in a whole picture of this size, px."""
    assert camera.whole is not None
    height, width = camera.whole.shape
    across, down = width_px / width, height_px / height
    left, top, right, bottom = camera.crop
    return (
        max(0.0, left * across), max(0.0, top * down),
        min(float(width_px), right * across), min(float(height_px), bottom * down),
    )  # fmt: skip


_TITLE_PX, _HEADING_PX, _CAMERA_PX, _LEGEND_PX = 64, 58, 38, 132
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


def events_heading(page: Canvas, x: float, y: float) -> None:
    """Write the heading of events, simulated or recorded, with what red and blue mean."""
    x = page.text(x, y, "events:", size=canvas.HEADING_PT)
    x = page.text(x + 10, y, "brighter", size=canvas.HEADING_PT, colour=BRIGHTER)
    page.text(x + 10, y, "darker", size=canvas.HEADING_PT, colour=DARKER)


def flow_panel(page: Canvas, x: int, y: int, flow: npt.NDArray[np.generic], largest_px: float, tile_px: int) -> None:
    """Draw flow [2, H, W], px, in colour and with arrows, whose length grows with the flow up to ``largest_px``."""
    x0, y0, scale = page.panel(x, y, draw_flow(flow, largest_px), tile_px, tile_px)
    rows, columns = (np.linspace(0, side, _ARROWS + 1).round().astype(int) for side in flow.shape[1:])
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
    labelled_panel(page, camera, pick, left[0], y, draw_grey(camera.picture(pick)), tile_px, with_text=True)
    if camera.blurred is not None:
        label(page, left[0] + 5, y + 5, "sharp | exposed")
    bins = camera.voxels.shape[1]
    for number in range(min(bins, MOST_BINS)):
        events = draw_events(camera.voxels[pick, number], scale.full)
        labelled_panel(page, camera, pick, left[1 + number], y, events, tile_px)
        if camera.paused[pick * bins + number]:
            label(page, left[1 + number] + 5, y + 5, "paused")
    if camera.flow is not None:
        flow_panel(page, left[-1], y, camera.flow[pick], scale.largest_px, tile_px)
        if "flow" in camera.provenance.unlabelled:
            label(page, left[-1] + 5, y + 5, "not known")


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

"""The whole picture of a video: its events, and where in it the cameras of a page look."""

from __future__ import annotations

from collections.abc import Sequence

from v2v_pictures import canvas
from v2v_pictures.camera import Camera
from v2v_pictures.canvas import GAP_PX, PAGE_MARGIN_PX, Canvas
from v2v_pictures.colours import draw_events, draw_grey
from v2v_pictures.strip import LABEL_PX, draw_strip

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
    height, width = whole.frames.shape[1:]
    scale = min((2 * tile_px + GAP_PX) / width, _HIGHEST_TILES * tile_px / height)
    return max(1, round(width * scale)), max(1, round(height * scale))


def _same_clip(whole: Camera, camera: Camera) -> bool:
    one, other = whole.provenance, camera.provenance
    same = (one.video, one.start_frame) == (other.video, other.start_frame)
    return same and camera.whole is not None


def whole_panel(page: Canvas, camera: Camera, x: int, y: int, width_px: int, height_px: int) -> None:
    """Draw the video's picture, small, and a box around what the camera sees of it."""
    if camera.whole is None:
        return
    height, width = camera.whole.shape
    scale = min(width_px / width, height_px / height)
    size = max(1, round(width * scale)), max(1, round(height * scale))
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

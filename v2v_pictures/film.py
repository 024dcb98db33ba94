"""Cameras as a film: the whole picture, then each camera's frame, events bin by bin, flow and place in the clip."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from v2v_pictures import canvas
from v2v_pictures.camera import Camera
from v2v_pictures.canvas import GAP_PX, PAGE_MARGIN_PX, Canvas, label
from v2v_pictures.colours import Image, draw_events, draw_grey
from v2v_pictures.sheet import LABEL_PX, TICKS_PX, Scale, draw_strip, events_heading, flow_panel, labelled_panel

_TITLE_PX, _STRIP_PX = 58, 50
_CAMERA_PX, _NAMES_PX, _BETWEEN_PX = 52, 30, 20
_LEAST_WIDTH_PX = 620
FRAMES_PER_SECOND = 20.0


def draw_film(
    cameras: Sequence[Camera], title: str, *, tile_px: int = 256, whole: Camera | None = None
) -> Iterator[Image]:
    """Draw one picture for each bin.

    Args:
        cameras: at least one, all with equally many voxel grids and bins, all or none with flow.
        title: of the film.
        tile_px: side of a panel.
        whole: a camera that sees the whole picture, as long as the others, to show first; None leaves it out.

    Yields:
        [height, width, 3] uint8 RGB, all of one size.
    """
    scale = Scale.of(cameras if whole is None else [whole, *cameras])
    columns = 2 + (cameras[0].flow is not None)
    width = max(2 * PAGE_MARGIN_PX + columns * (tile_px + GAP_PX) - GAP_PX, 2 * PAGE_MARGIN_PX + _LEAST_WIDTH_PX)
    block = _CAMERA_PX + _NAMES_PX + tile_px + GAP_PX + LABEL_PX + _STRIP_PX + TICKS_PX + _BETWEEN_PX
    grids, bins = cameras[0].voxels.shape[:2]
    first = _TITLE_PX
    if whole is not None:
        first += _NAMES_PX + _whole_size(whole, width, tile_px)[1] + _BETWEEN_PX
    for number in range(grids * bins):
        page = Canvas(width, first + len(cameras) * block)
        page.title(PAGE_MARGIN_PX, 16, title)
        if whole is not None:
            _draw_whole(page, whole, number, scale, tile_px)
        for place, camera in enumerate(cameras):
            _draw_camera(page, camera, place, first + place * block, number, scale, tile_px)
        yield page.image()


def _whole_size(whole: Camera, page_px: int, tile_px: int) -> tuple[int, int]:
    """Width and height of a panel of the whole picture, px: two beside each other."""
    return canvas.fitted(whole.frames[0], (page_px - 2 * PAGE_MARGIN_PX - GAP_PX) / 2, 1.25 * tile_px)


def _draw_whole(page: Canvas, whole: Camera, number: int, scale: Scale, tile_px: int) -> None:
    """Draw the whole picture at one bin of the clip."""
    grid, bin_ = divmod(min(number, len(whole.paused) - 1), whole.voxels.shape[1])
    width, height = _whole_size(whole, page.width_px, tile_px)
    left, top = (PAGE_MARGIN_PX, PAGE_MARGIN_PX + width + GAP_PX), _TITLE_PX
    page.text(left[0], top, "The whole picture", size=canvas.HEADING_PT)
    page.text(left[1], top, f"its events: {whole.title}", size=canvas.HEADING_PT)
    page.panel(left[0], top + _NAMES_PX, draw_grey(whole.frames[grid]), width, height)
    page.panel(left[1], top + _NAMES_PX, draw_events(whole.voxels[grid, bin_], scale.full), width, height)


def _draw_camera(page: Canvas, camera: Camera, place: int, top: int, number: int, scale: Scale, tile_px: int) -> None:
    """Draw one camera at one bin of its clip."""
    grid, bin_ = divmod(number, camera.voxels.shape[1])
    width = page.width_px - 2 * PAGE_MARGIN_PX
    x = page.text(PAGE_MARGIN_PX, top, f"Camera {place + 1}", size=canvas.HEADING_PT)
    page.text(x + 10, top, camera.title, size=canvas.HEADING_PT, colour=canvas.MARK)
    x = float(PAGE_MARGIN_PX)
    if warning := camera.warning(range(len(camera.voxels))):
        x = page.text(x, top + 27, warning) + 18
    page.text(x, top + 27, canvas.beginning(camera.describe(), width + PAGE_MARGIN_PX - x), colour=canvas.SOFT)
    left = [PAGE_MARGIN_PX + column * (tile_px + GAP_PX) for column in range(3)]
    top += _CAMERA_PX
    page.text(left[0], top, "video frame", size=canvas.HEADING_PT)
    events_heading(page, left[1], top)
    top += _NAMES_PX
    labelled_panel(page, camera, grid, left[0], top, draw_grey(camera.picture(grid)), tile_px, with_text=True)
    events = draw_events(camera.voxels[grid, bin_], scale.full)
    labelled_panel(page, camera, grid, left[1], top, events, tile_px)
    if camera.paused[number]:
        label(page, left[1] + 5, top + 5, "paused")
    if camera.flow is not None:
        page.text(left[2], top - _NAMES_PX, "optical flow", size=canvas.HEADING_PT)
        flow_panel(page, left[2], top, camera.flow[grid], scale.largest_px, tile_px)
    draw_strip(
        page,
        camera,
        PAGE_MARGIN_PX,
        top + tile_px + GAP_PX + LABEL_PX,
        width,
        _STRIP_PX,
        scale.highest_rate,
        cursor=number,
    )

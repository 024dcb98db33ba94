"""Cameras as a film: frame, events bin by bin, flow, and where in the clip the film is."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from v2v_pictures import canvas
from v2v_pictures.camera import Camera
from v2v_pictures.canvas import Canvas
from v2v_pictures.colours import Image, draw_events, draw_flow, draw_grey
from v2v_pictures.sheet import GAP_PX, MARGIN_PX, Scale, draw_strip

_TITLE_PX, _LABEL_PX, _STRIP_PX = 56, 46, 46
FRAMES_PER_SECOND = 20.0


def draw_film(cameras: Sequence[Camera], title: str, *, tile_px: int = 256) -> Iterator[Image]:
    """One picture for each bin.

    Args:
        cameras: at least one, all with as many voxel grids and bins, all or none with flow.
        title: of the film.
        tile_px: side of a panel.

    Yields:
        [height, width, 3] uint8 RGB, all of one size.
    """
    scale = Scale.of(cameras)
    with_flow = cameras[0].flow is not None
    names = ["video frame", "simulated events", *(["optical flow"] if with_flow else [])]
    width = max(2 * MARGIN_PX + len(names) * (tile_px + GAP_PX), 2 * MARGIN_PX + 620)
    block = _LABEL_PX + 22 + tile_px + GAP_PX + _STRIP_PX + 24
    grids, bins = cameras[0].voxels.shape[:2]
    for number in range(grids * bins):
        page = Canvas(width, _TITLE_PX + len(cameras) * block)
        page.text(MARGIN_PX, 18, title, size=canvas.TITLE_PT)
        for place, camera in enumerate(cameras):
            top = _TITLE_PX + place * block
            x = page.text(MARGIN_PX, top, f"Camera {place + 1}", size=canvas.HEADING_PT)
            page.text(x + 10, top, camera.title, size=canvas.HEADING_PT, colour=canvas.MARK)
            line = canvas.shortened(camera.describe(), width - 2 * MARGIN_PX)
            page.text(MARGIN_PX, top + 22, line, colour=canvas.SOFT)
            grid, bin_ = divmod(number, bins)
            tiles = [draw_grey(camera.frames[grid]), draw_events(camera.voxels[grid, bin_], scale.full)]
            if camera.flow is not None:
                tiles.append(draw_flow(camera.flow[grid], scale.largest_px))
            for column, (name, tile) in enumerate(zip(names, tiles, strict=True)):
                left = MARGIN_PX + column * (tile_px + GAP_PX)
                page.text(left + tile_px / 2, top + _LABEL_PX, name, colour=canvas.SOFT, anchor="ma")
                page.panel(left, top + _LABEL_PX + 20, tile, tile_px, tile_px)
            below = top + _LABEL_PX + 22 + tile_px + GAP_PX
            draw_strip(page, camera, MARGIN_PX, below, width - 2 * MARGIN_PX, _STRIP_PX, (), cursor=number)
            if camera.paused[number]:
                left = MARGIN_PX + tile_px + GAP_PX
                page.text(left + 8, top + _LABEL_PX + 26, "paused", size=canvas.HEADING_PT, colour=canvas.SOFT)
        yield page.image()

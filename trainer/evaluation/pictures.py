"""Draw a network's input, its reconstruction and the camera's picture side by side.

One line of panels for each window, with headings above and a legend below. Panels from left to right: the events of
the window (positive red, negative blue on white), the reconstruction, the picture of the camera.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from trainer.evaluation.reconstruct import Step
from trainer.pictures import EVENTS, PANEL_GAP_PX, Image, add_header, draw_events, draw_grey
from v2v_pictures import colours
from v2v_pictures.canvas import SOFT, Canvas

CAPTION_PX = 18
_INK = (60, 60, 60)
FONT_SCALE = 0.4
_LEGEND_PX, _LEGEND_WIDTH_PX, _RAMP_PX = 96, 560, 120


def draw_step(step: Step, origin_seconds: float, *, with_camera: bool = True) -> Image:
    """Draw the panels side by side, with a line of text below each.

    Args:
        origin_seconds: origin of the times in the text.
        with_camera: whether to draw the third panel, white before the first picture; False for recordings without
            pictures.
    """
    height, width = step.prediction.shape
    camera = np.ones((height, width)) if step.camera is None else step.camera / 255
    panels = [draw_events(step.voxels), draw_grey(step.prediction), draw_grey(camera)]
    texts = [
        f"{step.events} events, {(step.window.end - step.window.begin) * 1e3:.1f} ms",
        f"reconstruction, {step.window.end - origin_seconds:.3f} s",
        "no picture" if step.camera_time is None else f"camera, {step.camera_time - origin_seconds:.3f} s",
    ]
    shown = len(panels) if with_camera else len(panels) - 1
    tiles = []
    for panel, text in zip(panels[:shown], texts[:shown], strict=True):
        tile = cv2.copyMakeBorder(panel, 0, CAPTION_PX, 0, PANEL_GAP_PX, cv2.BORDER_CONSTANT, value=(255, 255, 255))
        cv2.putText(tile, text, (2, height + 13), cv2.FONT_HERSHEY_SIMPLEX, FONT_SCALE, _INK, 1, cv2.LINE_AA)
        tiles.append(tile)
    return np.hstack(tiles)


def choose_steps(count: int, rows: int) -> frozenset[int]:
    """Choose ``rows`` of ``count`` evenly spaced steps: with the last, without the first (memory is empty there)."""
    rows = min(rows, count)
    return frozenset(int(step) for step in np.linspace(count / rows, count, rows).round() - 1)


def draw_recording(rows: Sequence[Image], name: str, windows_seconds: Sequence[float], *, with_camera: bool) -> Image:
    """Put the lines of a recording below each other, with headings and a legend.

    Args:
        rows: of :func:`draw_step`, at least one.
        name: of the recording.
        windows_seconds: how long each window of the recording lasts.
        with_camera: as they were drawn.

    Returns:
        [height, width, 3] uint8.
    """
    panels = (EVENTS, "reconstruction", "camera")[: 3 if with_camera else 2]
    sheet = add_header(np.vstack(rows), panels, name, time_runs_down=True)
    legend = Canvas(max(sheet.shape[1], _LEGEND_WIDTH_PX), _LEGEND_PX)
    ramp = np.linspace(0.0, 1.0, _RAMP_PX)[None].repeat(14, axis=0)
    for y, image, text in (
        (
            8,
            colours.draw_events(2 * ramp - 1, 1.0),
            "events of a window: darker, none, brighter; a scale for each line",
        ),
        (34, draw_grey(ramp), "grey of reconstruction and camera: 0 is black, 1 is white"),
    ):
        legend.panel(8, y, image, _RAMP_PX, 14)
        legend.text(_RAMP_PX + 20, y - 3, text)
    shortest, longest = (f"{1e3 * seconds:.1f}" for seconds in (min(windows_seconds), max(windows_seconds)))
    lasts = f"lasts {longest} ms" if shortest == longest else f"lasts {shortest} to {longest} ms"
    shown = f"{len(rows)} of {len(windows_seconds)} windows are shown; each {lasts}"
    legend.text(8, 64, f"{shown}; times count from the first", colour=SOFT)
    missing = legend.width_px - sheet.shape[1]
    return np.vstack([np.pad(sheet, ((0, 0), (0, missing), (0, 0)), constant_values=255), legend.image()])

"""Pictures of samples: frames, voxel bins (positive red, negative blue on white), and the thresholds that were drawn.

One row shows one voxel grid: what the camera was, the frame that closes it, and its bins in order of time.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from v2v_protocol.errors import UsageError
from v2v_protocol.sample import Provenance, Sample
from v2v_server.flow.colour import draw_flow

_TILE_PX = 168
_GAP_PX = 6
_LABEL_PX = 250
_LARGEST_THRESHOLD_SHOWN = 3.0
_INK = (60, 60, 60)
_POSITIVE = (40, 40, 214)  # BGR
_NEGATIVE = (200, 96, 30)

Image = npt.NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class Row:
    """One voxel grid and its camera.

    Attributes:
        frame: [H, W] uint8, the frame at the end of the voxel grid.
        bins: [B, H, W], signed event counts.
        provenance: of the sample it is from.
        note: what is particular about this row, e.g. which voxel of the clip it is.
        flow: [2, H, W], px, of this voxel; drawn where there is one.
    """

    frame: npt.NDArray[np.uint8]
    bins: npt.NDArray[Any]
    provenance: Provenance
    note: str
    flow: npt.NDArray[np.float16] | None = None


def check_drawable(arrays: Collection[str]) -> None:
    """Refuses arrays that a picture cannot be made of.

    Raises:
        UsageError: voxels or frames are not among them.
    """
    if not {"voxels", "frames"} <= set(arrays):
        raise UsageError("a picture needs both arrays: --arrays voxels,frames")


def draw_sample(sample: Sample, rows: int = 6) -> Image:
    """The voxel grids of one sample at evenly spaced times.

    Raises:
        UsageError: the sample lacks voxels or frames.
    """
    check_drawable(sample.arrays)
    voxels, frames, flow = sample.arrays["voxels"], sample.arrays["frames"], sample.arrays.get("flow")
    # Lead frames and lead voxels stand in front: the last entries of both belong together.
    count = min(len(array) for array in (voxels, frames, flow) if array is not None)
    picks = np.unique(np.linspace(0, count - 1, rows).round().astype(int))
    return draw_rows(
        [
            Row(
                frames[len(frames) - count + pick, 0],
                voxels[len(voxels) - count + pick],
                sample.provenance,
                f"voxel {pick}",
                None if flow is None else flow[len(flow) - count + pick],
            )
            for pick in picks
        ]
    )


def draw_rows(rows: Sequence[Row]) -> Image:
    """Rows below each other on white.

    Returns:
        [height, width, 3] uint8, BGR.
    """
    return np.vstack([_draw_row(row) for row in rows])


def write_png(path: Path, image: Image) -> None:
    """Writes a picture.

    Raises:
        UsageError: the folder is missing or not writable.
    """
    encoded, data = cv2.imencode(".png", image)
    if not encoded:
        raise UsageError(f"{path}: this picture cannot be encoded as PNG")
    try:
        path.write_bytes(data.tobytes())
    except OSError as error:
        raise UsageError(f"{path}: {error.strerror}") from error


def _draw_row(row: Row) -> Image:
    strongest = float(np.quantile(np.abs(row.bins[row.bins != 0], dtype=np.float32), 0.98)) if np.any(row.bins) else 1.0
    frame = np.repeat(row.frame[..., None], 3, axis=2)
    tiles = [_label(row, strongest), _fit(frame)]
    tiles += [_fit(_red_blue(events, strongest)) for events in row.bins]
    if row.flow is not None:
        tiles.append(_fit(draw_flow(row.flow)))
    return np.hstack([cv2.copyMakeBorder(tile, 0, _GAP_PX, 0, _GAP_PX, cv2.BORDER_CONSTANT, value=(255, 255, 255))
                      for tile in tiles])  # fmt: skip


def _red_blue(events: npt.NDArray[Any], strongest: float) -> Image:
    """Signed counts as colour: white is none; full colour from ``strongest`` events on."""
    share = np.clip(np.abs(events, dtype=np.float32) / strongest, 0.0, 1.0)[..., None]
    # The square root lifts single events out of the white.
    share = np.sqrt(share)
    positive, negative = np.array(_POSITIVE, np.float32), np.array(_NEGATIVE, np.float32)
    colour = np.where((events > 0)[..., None], positive, negative)
    image: Image = (255.0 + share * (colour - 255.0)).round().astype(np.uint8)
    return image


def _label(row: Row, strongest: float) -> Image:
    """Text and two bars whose lengths are the thresholds."""
    image = np.full((_TILE_PX, _LABEL_PX, 3), 255, np.uint8)
    provenance, params = row.provenance, row.provenance.params
    name = provenance.video if len(provenance.video) <= 30 else "..." + provenance.video[-27:]
    lines = (
        name,
        f"from frame {provenance.start_frame}, {row.note}",
        f"noise {params.noise_sigma:.3f}  hot pixels {params.hot_pixel_count}",
        f"full colour: {strongest:.0f}+ events",
    )
    for number, line in enumerate(lines):
        cv2.putText(image, line, (8, 20 + 20 * number), cv2.FONT_HERSHEY_SIMPLEX, 0.42, _INK, 1, cv2.LINE_AA)
    for number, (sign, threshold, colour) in enumerate(
        (("c+", params.threshold_pos, _POSITIVE), ("c-", params.threshold_neg, _NEGATIVE))
    ):
        y = 112 + 26 * number
        length = round(120 * min(1.0, threshold / _LARGEST_THRESHOLD_SHOWN))
        cv2.putText(image, f"{sign} {threshold:.3f}", (8, y), cv2.FONT_HERSHEY_SIMPLEX, 0.42, _INK, 1, cv2.LINE_AA)
        cv2.rectangle(image, (92, y - 10), (92 + max(1, length), y), colour, -1)
        cv2.rectangle(image, (92, y - 10), (212, y), (190, 190, 190), 1)
    return image


def _fit(image: Image) -> Image:
    """The picture in a square tile, its shape kept."""
    height, width = image.shape[:2]
    scale = _TILE_PX / max(height, width)
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    scaled = cv2.resize(image, size, interpolation=cv2.INTER_NEAREST if scale >= 1 else cv2.INTER_AREA)
    below, right = _TILE_PX - scaled.shape[0], _TILE_PX - scaled.shape[1]
    return cv2.copyMakeBorder(scaled, 0, below, 0, right, cv2.BORDER_CONSTANT, value=(235, 235, 235)).astype(np.uint8)

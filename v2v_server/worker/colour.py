"""The delivered frames in colour: what to decode, and how to fill them."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import numpy.typing as npt

from v2v_protocol.errors import VideoError
from v2v_protocol.messages import Lease
from v2v_protocol.sample import SampleParams
from v2v_protocol.spec import StreamSpec
from v2v_server.simulation.view import apply_view, source_window
from v2v_server.video.colour.chroma import ChromaCut
from v2v_server.video.rows import Rows
from v2v_server.worker.arrays import ARRAY_BUILDERS, SampleContext, makes
from v2v_server.worker.cleaning import CleanFrames, usable_window


@makes("frames_rgb")
def frames_rgb(context: SampleContext, out: npt.NDArray[Any]) -> None:
    """Fill in the delivered frames, [T, 3, H, W]: the grey levels of ``frames`` and the colour of the video."""
    if context.clip.colour is None:
        raise VideoError(context.video, None, "was read without its colour")
    (cells, matrix), cut = context.clip.colour
    params, size = context.params, out.shape[2:]
    grey = np.empty((len(out), 1, *size), np.uint8)
    ARRAY_BUILDERS["frames"](context, grey)
    # The cut names the delivered frames in ascending order.
    places = np.unique(context.source[context.target_steps], return_inverse=True)[1]
    chroma = np.ascontiguousarray(cells).view(np.uint8) ^ 128  # the bits of int8 plus 128
    rows, columns = cut.places
    if params.scale == 1.0:
        columns = np.ascontiguousarray(columns[::-1]) if params.flip else columns
    else:
        # Colour differences are not grey levels: the contrast is a factor of them.
        view = dataclasses.replace(params, contrast=0.0)
        chroma = np.stack([apply_view(each[:, rows[:, None], columns], view, context.recipe) for each in chroma])
        rows, columns = (np.arange(side, dtype=np.int64) for side in size)
    # Import lazily: most workers make no colour.
    from v2v_server.video.colour.rgb import add_colour, differences_of

    add_colour(grey[:, 0], chroma, places, rows, columns, differences_of(matrix, params.contrast or 1.0), out)


def chroma_cut(
    lease: Lease, params: SampleParams, spec: StreamSpec, frames: CleanFrames, source: npt.NDArray[np.int64]
) -> ChromaCut:
    """Return which colour to decode: that of the delivered frames, in the crop."""
    delivered = np.unique(source[params.ends(spec.recipe)[spec.recipe.first_frame :]])
    if not frames.stride:
        delivered = frames.numbers[delivered] - frames.numbers[0]
    top, bottom = Rows.parse(lease.rows).bounds(lease.height_px)
    window = source_window(params, spec.recipe, usable_window(lease, frames.sides))
    return ChromaCut(tuple(delivered.tolist()), window, (top, bottom - top))

"""The delivered frames in colour."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import numpy.typing as npt

from v2v_protocol.errors import VideoError
from v2v_server.simulation.view import apply_view
from v2v_server.worker.arrays.context import ARRAY_BUILDERS, SampleContext, makes


@makes("frames_rgb")
def frames_rgb(context: SampleContext, out: npt.NDArray[Any]) -> None:
    """Fill in the delivered frames, [T, 3, H, W]: the grey levels of ``frames`` and the colour of the video.

    Raises:
        VideoError: the clip was read without its colour.
    """
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
    # Import lazily: workers load compiled functions in turn (v2v_server.worker.warm_up).
    from v2v_server.video.levels import add_colour, differences_of

    add_colour(grey[:, 0], chroma, places, rows, columns, differences_of(matrix, params.contrast or 1.0), out)

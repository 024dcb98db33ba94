"""The frames as the camera sees them: 8 bits, as stored, or all that are simulated."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from v2v_server.simulation.intensity import tone_table
from v2v_server.video.picture import SDR
from v2v_server.worker.arrays.context import SampleContext, makes


@makes("frames")
def frames(context: SampleContext, out: npt.NDArray[Any]) -> None:
    """Fill in the frame at the end of each voxel grid, and the lead frame, tone mapped: [T, 1, H, W]."""
    _shown(context, context.source[context.target_steps], out)


@makes("frames_u16")
def frames_u16(context: SampleContext, out: npt.NDArray[Any]) -> None:
    """Fill in the frames of ``frames``, [T, 1, H, W], with the levels that the video stores, 0 .. 65535."""
    white = context.signal.white
    table = ((2 * 65535 * np.arange(white + 1) + white) // (2 * white)).astype(np.uint16)
    np.take(table, context.view[context.source[context.target_steps]], out=out[:, 0], mode="clip")


@makes("frames_all")
def frames_all(context: SampleContext, out: npt.NDArray[Any]) -> None:
    """Fill in the frame at the beginning of the clip and at the end of each step, tone mapped: [steps + 1, 1, H, W]."""
    _shown(context, context.source, out)


def _shown(context: SampleContext, numbers: npt.NDArray[np.int64], out: npt.NDArray[Any]) -> None:
    # The indices are valid; checking them again would cost a copy.
    if context.signal == SDR:
        np.take(context.view, numbers, axis=0, out=out[:, 0], mode="clip")
    else:
        np.take(tone_table(context.recipe.gamma, context.signal), context.view[numbers], out=out[:, 0], mode="clip")

"""Optical flow over each voxel grid, and where it is reliable; tracks, which only photographs have."""

from __future__ import annotations

from typing import Any

import numpy.typing as npt

from v2v_protocol.errors import VideoError
from v2v_server.worker.arrays.context import SampleContext, makes


@makes("tracks")
def tracks(context: SampleContext, out: npt.NDArray[Any]) -> None:
    """Raise an error: the clips of photographs come with tracks, [T + lead_frames, N, 3], and other videos have none.

    Raises:
        VideoError: always.
    """
    raise VideoError(context.video, None, "has no tracks: ask for flow, or serve photographs")


@makes("flow")
def flow(context: SampleContext, out: npt.NDArray[Any]) -> None:
    """Fill in the flow over each voxel grid, [T, 2, H, W], px."""
    if context.flow is not None:
        out[...] = context.flow.flow


@makes("flow_valid")
def flow_valid(context: SampleContext, out: npt.NDArray[Any]) -> None:
    """Fill in where the flow is reliable, [T, 1, H, W]."""
    if context.flow is not None and context.flow.valid is not None:
        out[...] = context.flow.valid

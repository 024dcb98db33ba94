"""The frames as the camera sees them: 8 bits, as stored, exposed for a time, or all that are simulated."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from v2v_server.simulation.intensity import light_table, tone_table, tones_of
from v2v_server.simulation.voxel import frame_times
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


_MOMENTS = 64
"""Moments of an exposure; between two frames, light is linear in time."""


@makes("frames_blurred")
def frames_blurred(context: SampleContext, out: npt.NDArray[Any]) -> None:
    """Fill in the frames of ``frames``, [T, 1, H, W], exposed for the drawn time, half of it before the frame.

    A clip has no light before its first frame and after its last one: near them, an exposure is shorter at both ends.
    """
    assert context.step_seconds is not None  # the array needs them
    times, recipe = frame_times(context.step_seconds), context.recipe
    light, shares = light_table(recipe.gamma, context.signal), (np.arange(_MOMENTS) + 0.5) / _MOMENTS - 0.5
    for target, middle in zip(out[:, 0], times[context.target_steps], strict=True):
        seconds = min(context.params.exposure_seconds, 2.0 * middle, 2.0 * (times[-1] - middle))
        place = np.interp(middle + seconds * shares, times, np.arange(len(times)))
        before = np.minimum(place.astype(np.int64), len(times) - 2)
        share = np.bincount(before, before + 1 - place, len(times))
        share[1:] += np.bincount(before, place - before, len(times))[:-1]
        seen = np.bincount(context.source, share)
        total = sum(light[context.view[frame]] * seen[frame] for frame in np.flatnonzero(seen).tolist())
        target[...] = tones_of(np.asarray(total) / _MOMENTS, recipe.gamma)


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

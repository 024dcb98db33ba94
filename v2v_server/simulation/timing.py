"""How long each step of a clip lasts, for noise that is stated per second."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from v2v_protocol.errors import UsageError


def step_seconds(
    seconds: npt.NDArray[np.float64], source_index: npt.NDArray[np.int64], average_fps: float
) -> tuple[npt.NDArray[np.float64], int]:
    """Durations of the steps of a clip.

    Args:
        seconds: [count] presentation time of each decoded frame; NaN where the file gives none.
        source_index: [steps + 1], which decoded frame each position shows (``SampleParams.source_index``).
        average_fps: frames per second of the video; stands in where two time stamps give no increase. A paused step
            lasts one average frame too.

    Returns:
        durations [steps] float64, all > 0; how many steps that are not paused had to use the average.

    Raises:
        UsageError: fewer time stamps than frames, or an average rate that is no positive finite number.
    """
    if not (np.isfinite(average_fps) and average_fps > 0):
        raise UsageError(f"average_fps = {average_fps}: noise per second needs the video's frame rate")
    if len(seconds) <= int(source_index[-1]):
        raise UsageError(f"{len(seconds)} time stamps for {int(source_index[-1]) + 1} frames: give one per frame")
    shown = np.asarray(seconds, np.float64)[source_index]
    with np.errstate(invalid="ignore"):
        elapsed = shown[1:] - shown[:-1]
    regular = np.isfinite(elapsed) & (elapsed > 0)
    paused = source_index[1:] == source_index[:-1]
    return np.where(regular, elapsed, 1.0 / average_fps), int(np.count_nonzero(~regular & ~paused))

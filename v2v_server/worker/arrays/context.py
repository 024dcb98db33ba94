"""What the arrays of one sample are made from, and the functions that fill them, by name."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from importlib.resources.abc import Traversable
from typing import Any

import numpy as np
import numpy.typing as npt

from v2v_protocol.errors import SidecarError
from v2v_protocol.recipe import Recipe
from v2v_protocol.sample import ARRAYS, SampleParams, sidecar_endings
from v2v_protocol.spec import StreamSpec
from v2v_server.flow import FlowClip
from v2v_server.simulation.clip import RunIn
from v2v_server.simulation.kernels import Voxels
from v2v_server.simulation.view import FrameArray, Window
from v2v_server.simulation.voxel import Levels
from v2v_server.video.picture import Chroma, ChromaCut, Signal


@dataclass(frozen=True, slots=True)
class SourceClip:
    """Where a sample's frames lie in their video, and what lies beside it.

    Attributes:
        start_frame: number of the clip's first frame in the video, in presentation order from 0.
        seconds: [n] float64, presentation time of each frame of the clip; NaN where unknown.
        colour: colour of the delivered frames, and how it was cut; None if no array needs it.
        sidecars: the opened sidecars by ending, see :class:`v2v_protocol.sample.Needs`: a file, or a folder in
            the manner of ``pathlib``; None if the video has none.
        numbers: [steps + 1] int64, number in the video of each frame of the clip and of those that pauses leave out.
        fingerprints: of the sidecars that the video has, by ending.
        picture_px: height and width of the upright picture.
        usable: the part of it that the camera sees, see :mod:`v2v_server.video.rows`.
    """

    start_frame: int
    seconds: npt.NDArray[np.float64]
    colour: tuple[Chroma, ChromaCut] | None
    sidecars: Mapping[str, Traversable | None]
    numbers: npt.NDArray[np.int64]
    fingerprints: Mapping[str, str]
    picture_px: tuple[int, int]
    usable: Window


@dataclass(frozen=True, slots=True)
class SampleContext:
    """Inputs of the functions that fill the arrays of one sample.

    Attributes:
        video: catalogue id.
        clip: the frames' place in the video, their times, and the opened sidecars.
        spec, params: the stream's spec, and the sample's draw.
        source: [steps + 1] int64, which frame of ``view`` each position of the clip shows.
        view: [n, H, W], the decoded frames as the camera sees them.
        signal: what the levels of ``view`` mean.
        step_seconds: [steps] float64, duration of each step; None if recipe and arrays do not use it, or if only an
            array would and the video has no known frame rate.
        flow: flow of the clip; None if it was not requested.
        levels: grey levels between frames (``StreamSpec.levels_per_step``); None if there are none.
        run_in: frames that the pixels start from; None if there are none, or no array needs events.
        simulated: result of the simulation; None if no array needs events.
    """

    video: str
    clip: SourceClip
    spec: StreamSpec
    params: SampleParams
    source: npt.NDArray[np.int64]
    view: FrameArray
    signal: Signal
    step_seconds: npt.NDArray[np.float64] | None
    flow: FlowClip | None
    levels: Levels | None
    run_in: RunIn | None = None
    simulated: Voxels | None = None

    def can_time(self, name: str) -> bool:
        """Return whether the durations of the steps are known, if the array needs them."""
        return self.step_seconds is not None or not ARRAYS[name].needs.seconds

    @property
    def target_steps(self) -> npt.NDArray[np.int64]:
        """Return the positions of the delivered frames in the clip, [T + lead_frames]."""
        return self.params.ends(self.recipe)[self.recipe.first_frame :]

    @property
    def substeps(self) -> int:
        """Return the number of parts of all steps together; 0 if the spec divides no step."""
        levels = 0 if self.levels is None else len(self.levels.at.step)
        return len(self.source) - 1 + levels if self.spec.levels_per_step else 0

    @property
    def recipe(self) -> Recipe:
        """Return the spec's recipe."""
        return self.spec.recipe

    @property
    def target_frames(self) -> list[int]:
        """Number, in the video, of the frame at the end of each voxel, and of the lead frame."""
        return [int(frame) for frame in self.clip.numbers[self.source[self.target_steps]]]


ArrayBuilder = Callable[[SampleContext, npt.NDArray[Any]], int | None]
"""Fill an array; return how many rows did not fit (:func:`fill_rows`), or None."""
ARRAY_BUILDERS: dict[str, ArrayBuilder] = {}
"""The function that fills each array that the kernel does not make, by name."""


def makes(name: str) -> Callable[[ArrayBuilder], ArrayBuilder]:
    """Register a function that fills the array of this name. It gets a C-contiguous output array.

    A function that cannot use a sidecar raises :class:`v2v_protocol.errors.SidecarError`. The sample then states the
    reason and has no labels. So does any other error while an array is made from a sidecar.
    """

    def register(builder: ArrayBuilder) -> ArrayBuilder:
        ARRAY_BUILDERS[name] = builder
        return builder

    return register


def fill_rows(name: str, out: npt.NDArray[Any], frames: Iterable[npt.NDArray[Any]]) -> int:
    """Fill in a label with a number of rows in each frame, and return how many rows did not fit.

    Args:
        name: of the label; ``empty`` of its form fills the other rows.
        out: [frames, most rows, columns].
        frames: [n, columns] of each frame, what matters most first.
    """
    found = list(frames)
    out[...] = ARRAYS[name].empty
    for target, rows in zip(out, found, strict=True):
        target[: len(rows)] = rows[: len(target)]
    return sum(max(0, len(rows) - out.shape[1]) for rows in found)


def only_sidecar(array: str, video: str, sidecars: Mapping[str, Traversable | None]) -> tuple[str, Any]:
    """Return the one sidecar that the array is made from, and its ending.

    Raises:
        SidecarError: there is none, or more than one.
    """
    endings = sidecar_endings((array,))
    found = [(ending, opened) for ending in endings if (opened := sidecars.get(ending)) is not None]
    if len(found) != 1:
        why = f"there are {len(found)}: keep one" if found else "is missing: add it beside the video"
        raise SidecarError(video, " or ".join(ending for ending, _ in found) or " or ".join(endings), why)
    return found[0]

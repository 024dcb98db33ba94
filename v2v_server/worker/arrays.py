"""Fill the arrays of a sample from its decoded clip.

An array is a line in ``v2v_protocol.sample.ARRAYS`` (its dtype and shape) and a function, here or in a file of its own,
that fills it:

    @makes("depth")
    def depth(context: SampleContext, out: npt.NDArray[Any]) -> None:

``v2v_server.worker.produce`` imports the files. ``docs/extending.md`` shows how to add an array.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib.resources.abc import Traversable
from typing import Any

import numpy as np
import numpy.typing as npt

from v2v_protocol.errors import UsageError, VideoError
from v2v_protocol.recipe import Recipe
from v2v_protocol.sample import SampleParams
from v2v_protocol.spec import StreamSpec
from v2v_server.flow import FlowClip
from v2v_server.simulation.clip import simulate_clip
from v2v_server.simulation.kernels import ARRAYS
from v2v_server.simulation.result import Voxels
from v2v_server.simulation.view import Frames
from v2v_server.simulation.voxel import Levels


@dataclass(frozen=True, slots=True)
class SourceClip:
    """Where a sample's frames lie in their video, and what lies beside it.

    Attributes:
        start_frame: number of the clip's first frame in the video, in presentation order from 0. Frame ``n`` of the
            clip is frame ``start_frame + n * recipe.frame_stride`` of the video.
        seconds: [n] float64, presentation time of each frame of the clip; NaN where unknown.
        sidecars: the opened sidecars by ending, see :class:`v2v_protocol.sample.FromSidecar`: a file, or a folder in
            the manner of ``pathlib``; None if the video has none.
    """

    start_frame: int
    seconds: npt.NDArray[np.float64]
    sidecars: Mapping[str, Traversable | None]


@dataclass(slots=True)
class SampleContext:
    """Inputs of the functions that fill the arrays of one sample.

    Attributes:
        video: catalogue id.
        clip: the frames' place in the video, their times, and the opened sidecars.
        spec, params: the stream's spec, and the sample's draw.
        source: [steps + 1] int64, which frame of ``view`` each position of the clip shows.
        view: [n, H, W] uint8, the decoded frames as the camera sees them.
        step_seconds: [steps] float64, duration of each step; None if the recipe does not use it.
        flow: flow of the clip; None if it was not requested.
        levels: grey levels between frames (``substep_px``); None if there are none.
        into: the arrays to fill, by name.
        saturated: number of bins that were clipped, by array; None until the clip is simulated.
        left_out: effects of the draw that were not simulated.
    """

    video: str
    clip: SourceClip
    spec: StreamSpec
    params: SampleParams
    source: npt.NDArray[np.int64]
    view: Frames
    step_seconds: npt.NDArray[np.float64] | None
    flow: FlowClip | None
    levels: Levels | None
    into: Mapping[str, npt.NDArray[Any]]
    saturated: Mapping[str, int] | None = None
    left_out: tuple[str, ...] = ()

    @property
    def target_steps(self) -> npt.NDArray[np.int64]:
        """Return the positions of the delivered frames in the clip, [T + lead_frames]."""
        return self.params.ends(self.recipe)[self.recipe.first_frame :]

    @property
    def recipe(self) -> Recipe:
        """The spec's recipe."""
        return self.spec.recipe


ArrayBuilder = Callable[[SampleContext, npt.NDArray[Any]], None]
ARRAY_BUILDERS: dict[str, ArrayBuilder] = {}
"""The function that fills each array, by name."""


def makes(name: str) -> Callable[[ArrayBuilder], ArrayBuilder]:
    """Register a function that fills the array of this name. It gets a C-contiguous output array.

    A function that cannot use a sidecar raises :class:`v2v_protocol.errors.SidecarError`, which reaches the consumer.
    So does any other error while an array is made from a sidecar.
    """

    def register(builder: ArrayBuilder) -> ArrayBuilder:
        ARRAY_BUILDERS[name] = builder
        return builder

    return register


def simulate(context: SampleContext, out: Mapping[str, npt.NDArray[Any]]) -> Voxels:
    """Simulate the sample into ``out``.

    Raises:
        VideoError: thresholds or time stamps that the corpus states for the video are beyond what can be simulated.
    """
    try:
        return simulate_clip(
            context.view,
            context.params,
            context.recipe,
            context.spec.voxel_dtype,
            context.step_seconds,
            out,
            context.levels,
            context.spec.tolerance,
        )
    except UsageError as error:
        # The recipe was checked before, so the values come from the corpus.
        raise VideoError(context.video, None, f"cannot be simulated: {error}") from error


@makes("voxels")
@makes("event_counts")
@makes("voxels_bilinear")
def simulated(context: SampleContext, out: npt.NDArray[Any]) -> None:
    """Fill in all arrays of the kernel together, the first time."""
    if context.saturated is None:
        asked = {name: context.into[name] for name in ARRAYS if name in context.into}
        made = simulate(context, asked)
        context.saturated = made.saturated
        context.left_out = tuple(name for name in context.params.effects if name not in made.given.params.effects)


@makes("frames")
def frames(context: SampleContext, out: npt.NDArray[Any]) -> None:
    """Fill in the frame at the end of each voxel, and the lead frame."""
    # The indices are valid; checking them again would cost a copy.
    np.take(context.view, context.source[context.target_steps], axis=0, out=out[:, 0], mode="clip")


@makes("flow")
def flow(context: SampleContext, out: npt.NDArray[Any]) -> None:
    """Fill in the flow over each voxel."""
    if context.flow is not None:
        out[...] = context.flow.flow


@makes("flow_valid")
def flow_valid(context: SampleContext, out: npt.NDArray[Any]) -> None:
    """Fill in where the flow is reliable."""
    if context.flow is not None and context.flow.valid is not None:
        out[...] = context.flow.valid

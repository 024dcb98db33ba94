"""Fill the arrays of a sample from its decoded clip.

An array is a line in ``v2v_protocol.sample.ARRAYS`` (its dtype and shape) and a function, here or in a file of its own,
that fills it:

    @makes("depth")
    def depth(context: SampleContext, out: npt.NDArray[Any]) -> None:

``v2v_server.worker.produce`` imports the files. ``docs/extending.md`` shows how to add an array.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from importlib.resources.abc import Traversable
from typing import Any

import numpy as np
import numpy.typing as npt

from v2v_protocol.errors import UsageError, VideoError
from v2v_protocol.recipe import Recipe
from v2v_protocol.sample import SampleParams, empty_value, needs_seconds
from v2v_protocol.spec import StreamSpec
from v2v_server.flow import FlowClip
from v2v_server.simulation.clip import simulate_clip
from v2v_server.simulation.intensity import tone_table
from v2v_server.simulation.kernels import Voxels
from v2v_server.simulation.representations import NAMES
from v2v_server.simulation.view import FrameArray, Window
from v2v_server.simulation.voxel import Levels
from v2v_server.video.picture import SDR, Chroma, ChromaCut, Signal


@dataclass(frozen=True, slots=True)
class SourceClip:
    """Where a sample's frames lie in their video, and what lies beside it.

    Attributes:
        start_frame: number of the clip's first frame in the video, in presentation order from 0.
        seconds: [n] float64, presentation time of each frame of the clip; NaN where unknown.
        colour: colour of the delivered frames, and how it was cut; None if no array needs it.
        sidecars: the opened sidecars by ending, see :class:`v2v_protocol.sample.FromSidecar`: a file, or a folder in
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


@dataclass(slots=True)
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
        levels: grey levels between frames (``substep_px``); None if there are none.
        into: the arrays to fill, by name.
        saturated: number of bins that were clipped, by array; None until the clip is simulated.
        dropped: number of rows that did not fit, by label (:func:`fill_rows`).
        left_out: effects of the draw that were not simulated.
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
    into: Mapping[str, npt.NDArray[Any]]
    saturated: Mapping[str, int] | None = None
    dropped: dict[str, int] = field(default_factory=dict)
    left_out: tuple[str, ...] = ()

    def can_time(self, name: str) -> bool:
        """Return whether the durations of the steps are known, if the array needs them."""
        return self.step_seconds is not None or not needs_seconds((name,))

    @property
    def target_steps(self) -> npt.NDArray[np.int64]:
        """Return the positions of the delivered frames in the clip, [T + lead_frames]."""
        return self.params.ends(self.recipe)[self.recipe.first_frame :]

    @property
    def substeps(self) -> int:
        """Return the number of parts of all steps together; 0 if the spec does not divide steps (``substep_px``)."""
        levels = 0 if self.levels is None else len(self.levels.at.step)
        return len(self.source) - 1 + levels if self.spec.substep_px else 0

    @property
    def recipe(self) -> Recipe:
        """Return the spec's recipe."""
        return self.spec.recipe

    @property
    def target_frames(self) -> list[int]:
        """Number, in the video, of the frame at the end of each voxel, and of the lead frame."""
        return [int(frame) for frame in self.clip.numbers[self.source[self.target_steps]]]


ArrayBuilder = Callable[[SampleContext, npt.NDArray[Any]], None]
ARRAY_BUILDERS: dict[str, ArrayBuilder] = {}
"""The function that fills each array, by name."""


def makes(name: str) -> Callable[[ArrayBuilder], ArrayBuilder]:
    """Register a function that fills the array of this name. It gets a C-contiguous output array.

    A function that cannot use a sidecar raises :class:`v2v_protocol.errors.SidecarError`. The sample then states the
    reason and has no labels. So does any other error while an array is made from a sidecar.
    """

    def register(builder: ArrayBuilder) -> ArrayBuilder:
        ARRAY_BUILDERS[name] = builder
        return builder

    return register


def fill_rows(context: SampleContext, name: str, out: npt.NDArray[Any], frames: Iterable[npt.NDArray[Any]]) -> None:
    """Fill in a label with a number of rows in each frame, and count those that do not fit.

    Args:
        context: of the sample.
        name: of the label; ``empty`` of its form fills the other rows.
        out: [frames, most rows, columns].
        frames: [n, columns] of each frame, what matters most first.
    """
    found = list(frames)
    out[...] = empty_value(name)
    for target, rows in zip(out, found, strict=True):
        target[: len(rows)] = rows[: len(target)]
    context.dropped[name] = sum(max(0, len(rows) - out.shape[1]) for rows in found)


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
            context.signal,
            context.spec.tolerance,
        )
    except UsageError as error:
        # The recipe was checked before, so the values come from the corpus.
        raise VideoError(context.video, None, f"cannot be simulated: {error}") from error


def simulated(context: SampleContext, out: npt.NDArray[Any]) -> None:
    """Fill in all arrays of the kernel together, the first time; ``out`` is one of them, [T, ..., H, W]."""
    if context.saturated is None:
        asked = {name: context.into[name] for name in NAMES if name in context.into and context.can_time(name)}
        made = simulate(context, asked)
        context.saturated = made.saturated
        context.left_out = tuple(name for name in context.params.effects if name not in made.given.params.effects)


ARRAY_BUILDERS.update(dict.fromkeys(NAMES, simulated))


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

"""Fill the arrays of a sample from its decoded clip.

An array is a line in ``v2v_protocol.sample.ARRAYS`` (its dtype and shape) and a function, here or in a file of its own,
that fills it:

    @makes("depth")
    def depth(context: SampleContext, out: npt.NDArray[Any]) -> None:

``v2v_server.worker.produce`` imports the files. ``docs/extending.md`` shows how to add an array. Boxes and masks come
from the sidecars of a video, which a worker opens for each lease.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from functools import lru_cache
from importlib.resources.abc import Traversable
from types import MappingProxyType
from typing import Any, cast

import numpy as np
import numpy.typing as npt

from v2v_protocol.errors import (
    ProtocolError,
    SidecarError,
    UsageError,
    V2VError,
    VideoChanged,
    VideoError,
    VideoUnreadable,
)
from v2v_protocol.messages import Lease
from v2v_protocol.recipe import Recipe
from v2v_protocol.sample import SampleParams, sidecar_endings
from v2v_protocol.spec import StreamSpec
from v2v_server.corpus.sources.sidecar import open_sidecar, sidecar_id
from v2v_server.corpus.sources.source import VideoSource
from v2v_server.flow import FlowClip
from v2v_server.labels.boxes import BoxTable
from v2v_server.labels.formats import READERS, numbered_files
from v2v_server.labels.masks import read_mask
from v2v_server.labels.views import kept_boxes, view_boxes, view_mask
from v2v_server.simulation.clip import simulate_clip
from v2v_server.simulation.intensity import tone_table
from v2v_server.simulation.kernels import ARRAYS
from v2v_server.simulation.result import Voxels
from v2v_server.simulation.view import Frames, Window
from v2v_server.simulation.voxel import Levels
from v2v_server.video.colour.chroma import Chroma, ChromaCut
from v2v_server.video.luma import SDR, Signal


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
        step_seconds: [steps] float64, duration of each step; None if the recipe does not use it.
        flow: flow of the clip; None if it was not requested.
        levels: grey levels between frames (``substep_px``); None if there are none.
        into: the arrays to fill, by name.
        saturated: number of bins that were clipped, by array; None until the clip is simulated.
        boxes_dropped: boxes left out because of ``max_boxes``.
        left_out: effects of the draw that were not simulated.
    """

    video: str
    clip: SourceClip
    spec: StreamSpec
    params: SampleParams
    source: npt.NDArray[np.int64]
    view: Frames
    signal: Signal
    step_seconds: npt.NDArray[np.float64] | None
    flow: FlowClip | None
    levels: Levels | None
    into: Mapping[str, npt.NDArray[Any]]
    saturated: Mapping[str, int] | None = None
    boxes_dropped: int = 0
    left_out: tuple[str, ...] = ()

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
    """Fill in the frame at the end of each voxel, and the lead frame, tone mapped (``intensity.py``)."""
    _shown(context, context.source[context.target_steps], out)


@makes("frames_u16")
def frames_u16(context: SampleContext, out: npt.NDArray[Any]) -> None:
    """Fill in the same frames with the levels that the video stores, 0 .. 65535, without tone mapping."""
    white = context.signal.white
    table = ((2 * 65535 * np.arange(white + 1) + white) // (2 * white)).astype(np.uint16)
    np.take(table, context.view[context.source[context.target_steps]], out=out[:, 0], mode="clip")


@makes("frames_all")
def frames_all(context: SampleContext, out: npt.NDArray[Any]) -> None:
    """Fill in the frame at the beginning of the clip and at the end of each step, tone mapped."""
    _shown(context, context.source, out)


def _shown(context: SampleContext, numbers: npt.NDArray[np.int64], out: npt.NDArray[Any]) -> None:
    # The indices are valid; checking them again would cost a copy.
    if context.signal == SDR:
        np.take(context.view, numbers, axis=0, out=out[:, 0], mode="clip")
    else:
        np.take(tone_table(context.recipe.gamma, context.signal), context.view[numbers], out=out[:, 0], mode="clip")


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


_KEPT = 4
"""Sidecars that stay in memory once they are read: siblings use them one after the other."""


_LONGEST_REASON = 500


def _only_sidecar(array: str, video: str, sidecars: Mapping[str, Traversable | None]) -> tuple[str, Any]:
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


@lru_cache(maxsize=_KEPT)
def _boxes_of(ending: str, fingerprint: str, picture_px: tuple[int, int], opened: Any) -> BoxTable:
    """Read boxes. Equal fingerprints mean equal files; of a folder each clip has a part, which equals itself only."""
    return READERS[ending](opened, picture_px)


def read_ahead(lease: Lease, sidecars: Mapping[str, Traversable | None]) -> None:
    """Read the boxes of a lease, so that they are at hand when its sample is made. Errors come again then."""
    if "boxes" in lease.arrays:
        with suppress(Exception):
            ending, opened = _only_sidecar("boxes", lease.video, sidecars)
            _boxes_of(ending, sidecar_files(lease)[ending][1], (lease.height_px, lease.width_px), opened)


@makes("boxes")
def boxes(context: SampleContext, out: npt.NDArray[Any]) -> None:
    """Fill in the boxes of each delivered frame, [T, max_boxes, 7], the largest first."""
    clip = context.clip
    ending, opened = _only_sidecar("boxes", context.video, clip.sidecars)
    table = _boxes_of(ending, clip.fingerprints[ending], clip.picture_px, opened)
    found = [table.at(frame) for frame in context.target_frames]
    out[...] = -1
    dropped = 0
    for rows, (corners, numbers) in zip(out, found, strict=True):
        seen, share = view_boxes(corners, context.clip.usable, context.params, context.recipe)
        kept = kept_boxes(seen, share)
        dropped += max(0, len(kept) - len(rows))
        kept = kept[: len(rows)]
        rows[: len(kept)] = np.concatenate([seen[kept], numbers[kept], share[kept, None]], axis=1)
    context.boxes_dropped = dropped


@makes("masks")
def masks(context: SampleContext, out: npt.NDArray[Any]) -> None:
    """Fill in the class mask of each delivered frame, [T, 1, H, W]."""
    files = numbered_files(_only_sidecar("masks", context.video, context.clip.sidecars)[1], ".png")
    view: Callable[[int], npt.NDArray[np.uint8]] = lru_cache(maxsize=1)(lambda frame: _mask(context, files, frame))
    for target, frame in zip(out[:, 0], context.target_frames, strict=True):
        target[...] = view(frame)  # a paused camera repeats its frame


def _mask(context: SampleContext, files: dict[int, Traversable], frame: int) -> npt.NDArray[np.uint8]:
    if frame not in files:
        raise ValueError(f"has no file of frame {frame}: add one")
    mask = read_mask(files[frame], context.clip.picture_px)
    return view_mask(mask, context.clip.usable, context.params, context.recipe)


def sidecar_files(lease: Lease) -> dict[str, tuple[str, str]]:
    """Return id and fingerprint of each sidecar that a lease's arrays are made from and that can be used, by ending.

    Raises:
        ProtocolError: the lease is malformed.
    """
    stated = {ending: _stated(lease, ending) for ending in sidecar_endings(lease.arrays)}
    return {
        ending: (sidecar_id(lease.video, ending), fingerprint)
        for ending, (fingerprint, part) in stated.items()
        if fingerprint and not isinstance(part, str)
    }


def refused_sidecars(lease: Lease) -> dict[str, str]:
    """Return, by ending, why the catalogue does not use a sidecar that a lease's arrays are made from."""
    parts = {ending: _stated(lease, ending)[1] for ending in sidecar_endings(lease.arrays)}
    return {ending: part for ending, part in parts.items() if isinstance(part, str)}


def _stated(lease: Lease, ending: str) -> tuple[str, bytes | str]:
    """Return fingerprint and part of a sidecar, see ``Lease.sidecars``."""
    stated = lease.sidecars.get(ending, "")
    fingerprint, part = stated if isinstance(stated, list) and len(stated) == 2 else (stated, b"")
    if not isinstance(fingerprint, str) or not isinstance(part, bytes | str):
        raise ProtocolError(f"lease {lease.lease}: fingerprint {stated!r:.80} of the sidecar {ending}")
    return fingerprint, part


@contextmanager
def open_sidecars(lease: Lease, source: VideoSource) -> Iterator[dict[str, Traversable | None]]:
    """Lend the sidecars that a lease's arrays are made from, by ending, until the end of the context.

    Raises:
        SidecarError: one cannot be read, or differs from the catalogue.
        ProtocolError: the lease is malformed.
    """
    opened: dict[str, Traversable | None] = dict.fromkeys(sidecar_endings(lease.arrays))
    with ExitStack() as stack:
        for ending, (id, fingerprint) in sidecar_files(lease).items():
            try:
                table = cast(bytes, _stated(lease, ending)[1])
                opened[ending] = stack.enter_context(open_sidecar(source, id, fingerprint, table))
            except VideoError as error:
                here = isinstance(error, VideoChanged | VideoUnreadable)
                raise SidecarError(lease.video, ending, error.reason, here) from error
            except MemoryError as error:
                raise SidecarError(lease.video, ending, "reading it takes too much memory") from error
        yield opened


@contextmanager
def errors_of_sidecar(
    video: str,
    array: str,
    sidecars: Mapping[str, Traversable | None],
    refused: Mapping[str, str] = MappingProxyType({}),
) -> Iterator[None]:
    """Turn any error while an array is made from a sidecar into a SidecarError: a malformed file must end no worker.

    Args:
        video: catalogue id.
        array: name of the array.
        sidecars: what :func:`open_sidecars` lends.
        refused: see :func:`refused_sidecars`.

    Raises:
        SidecarError: the array cannot be made from its sidecar.
    """
    endings = sidecar_endings((array,))
    if problems := [refused[ending] for ending in endings if ending in refused]:
        there = [ending for ending in endings if ending in refused or sidecars.get(ending) is not None]
        why = problems[0] if len(there) == 1 else f"there are {len(there)}: keep one"
        raise SidecarError(video, " or ".join(there), why)
    try:
        yield
    except V2VError:
        raise
    except Exception as error:
        for ending in endings:
            if sidecars.get(ending) is not None:
                plain = "" if isinstance(error, ValueError) else f"{type(error).__name__}: "
                reason = f"{plain}{error}"[:_LONGEST_REASON]
                # A read error is this host's; any other repeats wherever the sidecar is read.
                here = isinstance(error, OSError) and not isinstance(error, FileNotFoundError)
                raise SidecarError(video, ending, reason, here) from error
        raise

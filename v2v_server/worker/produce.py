"""Make the sample of a job: decode, view, simulate.

Server workers and `v2v-simulate` both use this module, so they make equal samples.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from functools import lru_cache
from importlib.resources.abc import Traversable
from types import MappingProxyType
from typing import Any

import numpy as np
import numpy.typing as npt

from v2v_protocol import NUMERICS_VERSION
from v2v_protocol.errors import (
    SidecarError,
    UsageError,
    V2VError,
    VideoChanged,
    VideoError,
    VideoUnreadable,
)
from v2v_protocol.events import EventList
from v2v_protocol.sample import (
    ARRAYS,
    Needs,
    Provenance,
    Sample,
    SampleId,
    SampleParams,
    needs_of,
    new_arrays,
    sidecar_endings,
)
from v2v_protocol.spec import MARGIN_PX, MOST_SUBSTEPS, StreamSpec
from v2v_server.corpus.sources.source import VideoSource, open_sidecar, sidecar_id
from v2v_server.flow import FlowSettings, flow_for
from v2v_server.motion import cells_of, levels_of
from v2v_server.simulation.clip import simulate_clip
from v2v_server.simulation.draw import choose_crop, draw
from v2v_server.simulation.intensity import eight_bits
from v2v_server.simulation.kernels import Voxels, list_events
from v2v_server.simulation.precision import Variant, variants
from v2v_server.simulation.representations import NAMES
from v2v_server.simulation.view import apply_view, source_window, without_margin
from v2v_server.simulation.voxel import step_seconds
from v2v_server.store.cache import Cache, Cached
from v2v_server.store.pixels import kind_of
from v2v_server.store.verified import read_unchanged
from v2v_server.video.decode import ClipRequest, Cut, DecodedClip, SampleView
from v2v_server.video.picture import MIXED, MOST_BITS, SDR, ChromaCut
from v2v_server.worker.arrays.context import ARRAY_BUILDERS, SampleContext, SourceClip
from v2v_server.worker.job import ClipJob, SampleJob
from v2v_server.worker.scene_choice import (
    CleanFrames,
    FlowPlan,
    crop_weight,
    frame_times,
    most_frames,
    plan_flow,
    usable_window,
    within_rows,
)

_LISTED = ("listing",)
"""What arrays that are not made by the kernel may take of it: the events one by one, by the general kernel."""
_LONGEST_REASON = 500


def chroma_cut(clip: ClipJob, params: SampleParams, frames: CleanFrames, source: npt.NDArray[np.int64]) -> ChromaCut:
    """Return which colour to decode: that of the delivered frames, in the crop. ``source``: [steps + 1]."""
    recipe = clip.spec.recipe
    delivered = np.unique(source[params.ends(recipe)[recipe.first_frame :]])
    if not frames.stride:
        delivered = frames.numbers[delivered] - frames.numbers[0]
    top, bottom = clip.rows.bounds(clip.height_px)
    window = source_window(params, recipe, usable_window(clip, frames.sides))
    return ChromaCut(tuple(delivered.tolist()), window, (top, bottom - top))


@dataclass(frozen=True, slots=True)
class SamplePlan:
    """What one sample needs of its clip.

    Attributes:
        params: the sample's draw.
        source: [steps + 1] int64, which decoded frame each position of the clip shows.
        frames: the frames of the sequence, and the part of the picture that is used.
        cut: the frames to decode after pauses are removed, cropped as far as possible before the resize.
        margin_px: margin around the crop that the clip has, for flow and sub-steps; None: the whole picture.
        flow: settings of the flow if an array needs it.
        flow_plan: flow methods chosen from the statistics of the scene; None if the spec does not use them.
    """

    params: SampleParams
    source: npt.NDArray[np.int64]
    frames: CleanFrames
    cut: Cut
    margin_px: int | None
    flow: FlowSettings | None
    flow_plan: FlowPlan | None


@dataclass(frozen=True, slots=True)
class Decoded:
    """The decoded clip of a sample, with its plan."""

    plan: SamplePlan
    clip: DecodedClip


def plan_sample(clip: ClipJob, index: int) -> SamplePlan:
    """Draw the camera of one sample of a clip, and plan what to decode.

    Raises:
        VideoError: the recipe needs time stamps that are unknown, or the index or the scene is damaged.
    """
    spec, scene, seed, epoch = clip.spec, clip.scene, clip.seed, clip.epoch
    recipe = spec.recipe
    frames = CleanFrames.of(scene, clip.start_frame, spec, most_frames(clip))
    picture = usable_window(clip, frames.sides)
    params = draw(
        recipe,
        seed=seed,
        epoch=epoch,
        index=index,
        picture_height_px=picture.height_px,
        picture_width_px=picture.width_px,
        video_id=clip.video,
        video_thresholds=clip.thresholds,
        times=frame_times(clip, frames) if recipe.is_timed else None,
    )
    place = ""
    if scene is not None and spec.moving_share:
        drawn = choose_crop(
            params,
            recipe,
            seed=seed,
            epoch=epoch,
            index=index,
            share=spec.moving_share,
            picture_height_px=picture.height_px,
            picture_width_px=picture.width_px,
            weigh=crop_weight(scene, frames, params.scale, recipe, picture),
        )
        params, place = drawn, f"crop drawn {'uniformly' if drawn is params else 'by motion'}"
    source = params.source_index(int(params.ends(recipe)[-1]))
    flow: FlowSettings | None = None
    still_px: int | None = 0
    flow_plan = None if scene is None else plan_flow(scene, frames, params, spec, picture, place)
    is_rendered, needs = kind_of(clip.video) == "photographs", needs_of(clip.arrays)
    if not is_rendered and needs.flow:
        flow = FlowSettings.of(spec)
        if flow_plan is not None and flow_plan.still:
            flow = replace(flow, margin_px=0)
        still_px = flow.margin_px
    has_motion = spec.substep_px > 0 and not is_rendered
    margin_px = max(still_px, MARGIN_PX) if has_motion and still_px is not None else still_px
    window, still = (source_window(params, recipe, picture, margin) for margin in (margin_px, still_px))
    chroma = chroma_cut(clip, params, frames, source) if needs.colour else None
    cells = cells_of(params, recipe, within_rows(clip, frames.sides)) if has_motion else None
    cut = Cut(frames.count(int(source[-1]) + 1), window, chroma, cells, still)
    return SamplePlan(params, source, frames, cut, margin_px, flow, flow_plan)


def decode_for(
    clip: ClipJob, indices: Sequence[int], source: VideoSource, cache: Cache | None = None
) -> tuple[Decoded, ...]:
    """Decode, in one pass, exactly the frames that some samples of a clip need.

    Args:
        clip: what to decode.
        indices: of the samples.
        source: where the videos come from.
        cache: cache of decoded pieces for later epochs; None stores nothing.

    Raises:
        VideoError: the file is not the catalogued one, or cannot deliver the expected frames.
    """
    plans = [plan_sample(clip, index) for index in indices]
    frames = plans[0].frames
    try:
        request = ClipRequest(
            clip.frame_index(frames.span), clip.start_frame, tuple(plan.cut for plan in plans), frames.stride or 1,
            clip.rows.bounds(clip.height_px), _most_bits(clip.spec),
            tuple((clip.seed, clip.epoch, index) for index in indices),
            tuple(SampleView(clip.spec, plan.params, clip.arrays) for plan in plans),
        )  # fmt: skip
        source.expect(clip.video, clip.state)
        with source.open_pixels(clip.video, clip.fingerprint) as pixels:
            if cache is not None and not pixels.is_stored:
                pixels = Cached(pixels, cache, clip.video, clip.fingerprint)
            clips = read_unchanged(pixels, clip.fingerprint, request)
    except VideoError as error:
        # Consumer and log identify videos by id; a path of this host means nothing elsewhere.
        raise type(error)(clip.video, error.frame, error.reason) from error
    if clips[0].signal.transfer == MIXED:
        why = "states different transfer characteristics within a clip: re-encode it with one, or set light to sdr"
        raise VideoError(clip.video, clip.start_frame, why)
    return tuple(
        Decoded(_with_its_margin(plan, read), frames.pick(read, int(plan.source[-1]) + 1))
        for plan, read in zip(plans, clips, strict=True)
    )


def _with_its_margin(plan: SamplePlan, clip: DecodedClip) -> SamplePlan:
    """Return the plan with the margin that was read: a still clip has none for sub-steps."""
    if plan.cut.still is None or clip.frames.shape[1:] != plan.cut.still[2:]:
        return plan
    return replace(plan, margin_px=0 if plan.flow is None else plan.flow.margin_px)


def make_sample(
    job: SampleJob,
    decoded: Decoded,
    into: Mapping[str, npt.NDArray[Any]] | None = None,
    sidecars: Mapping[str, Traversable | None] = MappingProxyType({}),
) -> Sample:
    """Make a sample from its decoded clip: view, flow, simulation.

    Args:
        job: which sample.
        decoded: its decoded clip.
        into: C-contiguous arrays of the job's layout to fill; None allocates them.
        sidecars: what :func:`open_sidecars` lends; needed if an array is made from one.

    Raises:
        SidecarError: this host cannot read a sidecar.
        VideoError: the video's frame rate is unknown and the recipe needs it, or its stated thresholds or time stamps
            are beyond what can be simulated.
    """
    plan, clip, stamp = decoded.plan, job.clip, job.stamp
    arrays = new_arrays(clip.layout) if into is None else into
    context, irregular = sample_context(clip, decoded, needs_of(arrays), sidecars)
    unlabelled = {
        name: f"{clip.video}: its frame rate is unknown, and {name} needs it"
        for name in arrays
        if not context.can_time(name)
    }
    if any(ARRAYS[name].needs.events for name in arrays if name not in unlabelled):
        of_kernel = {name: arrays[name] for name in NAMES if name in arrays and name not in unlabelled}
        context = replace(context, simulated=simulate(context, of_kernel))
    dropped = dict[str, int]()
    for name, array in arrays.items():
        if name in decoded.clip.arrays:
            array[...] = decoded.clip.arrays[name]
        elif name not in NAMES and name not in unlabelled:
            try:
                with errors_of_sidecar(clip.video, name, sidecars, clip.refused_sidecars):
                    dropped[name] = ARRAY_BUILDERS[name](context, array) or 0
            except SidecarError as error:
                if error.here:
                    raise
                unlabelled[name] = str(error)
    for name in unlabelled:
        arrays[name][...] = ARRAYS[name].empty
    made = context.simulated
    saturated = {} if made is None else dict(made.saturated)
    saturated_bins = saturated.pop("voxels", 0)
    return Sample(
        arrays=arrays,
        provenance=Provenance(
            id=SampleId(stamp.spec_digest, stamp.catalogue_digest, NUMERICS_VERSION, clip.seed, clip.epoch, job.index),
            video=clip.video,
            fingerprint=clip.fingerprint,
            start_frame=clip.start_frame,
            candidate=stamp.candidate,
            refusals=stamp.refusals,
            params=plan.params,
            saturated_bins=saturated_bins,
            irregular_timestamps=irregular,
            decoder=_decoder(decoded.clip),
            quarantine=stamp.quarantine,
            scene="" if plan.flow_plan is None else plan.flow_plan.reason,
            sidecars=dict(context.clip.fingerprints),
            unlabelled=unlabelled,
            boxes_dropped=dropped.pop("boxes", 0),
            dropped={name: count for name, count in dropped.items() if count},
            saturated={name: count for name, count in saturated.items() if count},
            grid_seconds=_grid_seconds(context),
            substeps=0 if made is None else context.substeps,
            remark=stamp.remark,
        ),
    )


def list_sample_events(clip: ClipJob, decoded: Decoded) -> EventList:
    """List the events of a sample with their times, which are those of the video's frames.

    Raises:
        VideoError: as :func:`make_sample`; or the video's frame rate is unknown.
    """
    context, _ = sample_context(clip, decoded, Needs(events=True, seconds="must"))
    made = simulate(context, {})
    return list_events(made.given, made.real, 1e6 * made.given.step_seconds)


def sample_context(
    clip: ClipJob,
    decoded: Decoded,
    needs: Needs,
    sidecars: Mapping[str, Traversable | None] = MappingProxyType({}),
) -> tuple[SampleContext, int]:
    """Return what arrays with these needs are made from, and the number of irregular time stamps; no simulation.

    Raises:
        VideoError: the video's frame rate is unknown, and the recipe or an array must have it.
    """
    plan, read, spec, recipe = decoded.plan, decoded.clip, clip.spec, clip.spec.recipe
    params, frames, signal, flow, levels = plan.params, read.frames, read.signal, None, read.levels
    if plan.flow is not None and needs.flow and "flow" not in read.arrays:
        methods = () if plan.flow_plan is None else plan.flow_plan.methods
        part = without_margin(frames, params, recipe, plan.margin_px, plan.flow.margin_px)
        flow = flow_for(
            eight_bits(part, signal), params, recipe, plan.flow, validity=needs.flow == "checked", plan=methods
        )
    if read.motion is not None and read.motion.any() and (needs.events or needs.levels):
        part = without_margin(frames, params, recipe, plan.margin_px, MARGIN_PX)
        picture = within_rows(clip, plan.frames.sides)
        levels = levels_of(part, params, recipe, plan.source, spec.substep_px, read.motion, picture)
    # An array must not make a video unusable for the others: without a rate, it is left empty.
    is_timed = recipe.needs_seconds or needs.seconds == "must" or (bool(clip.frames_per_second and needs.seconds))
    seconds, irregular = _step_seconds(clip, decoded) if is_timed else (None, 0)
    view = frames
    if not read.is_view:
        view = apply_view(without_margin(frames, params, recipe, plan.margin_px), params, recipe, signal)
    origin = SourceClip(
        clip.start_frame,
        read.seconds,
        None if plan.cut.chroma is None or read.chroma is None else (read.chroma, plan.cut.chroma),
        sidecars,
        fingerprints={ending: sidecar.fingerprint for ending, sidecar in clip.sidecars.items()},
        numbers=plan.frames.numbers,
        picture_px=(clip.height_px, clip.width_px),
        usable=usable_window(clip, plan.frames.sides),
    )
    return SampleContext(clip.video, origin, spec, params, plan.source, view, signal, seconds, flow, levels), irregular


def simulate(context: SampleContext, out: Mapping[str, npt.NDArray[Any]]) -> Voxels:
    """Simulate the sample into ``out``, arrays that the kernel makes, such as voxels [T, bins, H, W], by name.

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
        )
    except UsageError as error:
        # The recipe was checked before, so the values come from the corpus.
        raise VideoError(context.video, None, f"cannot be simulated: {error}") from error


def _grid_seconds(context: SampleContext) -> tuple[float, ...]:
    """Return the actual duration of each voxel grid if the recipe states one."""
    if not context.recipe.is_timed or context.step_seconds is None:
        return ()
    return tuple(np.add.reduceat(context.step_seconds, context.params.ends(context.recipe)[:-1]).tolist())


def _step_seconds(clip: ClipJob, decoded: Decoded) -> tuple[npt.NDArray[np.float64], int]:
    """Call :func:`step_seconds` for a clip."""
    if not clip.frames_per_second:
        why = "the recipe needs seconds" if clip.spec.recipe.needs_seconds else "events need times"
        raise VideoError(clip.video, None, f"its frame rate is unknown, and {why}")
    rate = clip.frames_per_second / clip.spec.recipe.frame_stride
    return step_seconds(decoded.clip.seconds, decoded.plan.source, rate)


def _most_bits(spec: StreamSpec) -> int | None:
    """Return ``most_bits`` of a :class:`ClipRequest`. Pictures between frames are made from 8 bits."""
    if spec.recipe.light == "sdr":
        return None
    return SDR.bits if spec.substep_px else MOST_BITS


def _decoder(clip: DecodedClip) -> str:
    """Describe the source of the pixels for the provenance."""
    signal = "" if clip.signal == SDR else f", {clip.signal}"
    host = "" if clip.bit_exact else " (host-dependent)"
    return f"{clip.codec}{host}{signal}" + (f", from the {clip.origin}" if clip.origin else "")


def kernels_of(clip: ClipJob) -> frozenset[Variant]:
    """Return the compiled kernels that the samples of a clip may need."""
    made = tuple(name for name in NAMES if name in clip.arrays)
    others = [name for name in clip.arrays if name not in NAMES and needs_of([name]).events]
    found = frozenset[Variant]()
    for arrays in filter(None, (made, _LISTED if others else ())):
        found |= _variants(clip.spec, clip.frames_per_second or 1.0, clip.thresholds, arrays, kind_of(clip.video))
    return found


@lru_cache(maxsize=64)
def _variants(
    spec: StreamSpec,
    frames_per_second: float,
    thresholds: tuple[float, float] | None,
    arrays: tuple[str, ...],
    kind: str,
) -> frozenset[Variant]:
    step_seconds = spec.recipe.frame_stride / frames_per_second
    levels_per_step = MOST_SUBSTEPS - 1 if spec.substep_px else 0
    found = variants(spec.recipe, spec.voxel_dtype, step_seconds, thresholds, arrays, levels_per_step)
    if kind == "photographs":
        found = frozenset(variant._replace(is_divided=False, bits=MOST_BITS, is_rendered=True) for variant in found)
    return found


@contextmanager
def open_sidecars(clip: ClipJob, source: VideoSource) -> Iterator[dict[str, Traversable | None]]:
    """Lend the sidecars that a clip's arrays are made from, by ending, until the end of the context.

    Raises:
        SidecarError: one cannot be read, or differs from the catalogue.
    """
    opened: dict[str, Traversable | None] = dict.fromkeys(sidecar_endings(clip.arrays))
    with ExitStack() as stack:
        for ending, (fingerprint, table) in clip.sidecars.items():
            try:
                id = sidecar_id(clip.video, ending)
                opened[ending] = stack.enter_context(open_sidecar(source, id, fingerprint, table))
            except VideoError as error:
                here = isinstance(error, VideoChanged | VideoUnreadable)
                raise SidecarError(clip.video, ending, error.reason, here) from error
            except MemoryError as error:
                raise SidecarError(clip.video, ending, "reading it takes too much memory") from error
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
        refused: see :class:`v2v_server.worker.job.ClipJob`.

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

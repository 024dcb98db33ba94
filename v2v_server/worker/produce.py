"""Make the samples of a lease: decode, view, simulate.

Server workers and `v2v-simulate` both use this module, so they make equal samples.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from functools import lru_cache
from importlib.resources.abc import Traversable
from pathlib import PurePosixPath
from types import MappingProxyType
from typing import Any, cast

import numpy as np
import numpy.typing as npt

from v2v_protocol import NUMERICS_VERSION
from v2v_protocol.errors import (
    ProtocolError,
    SidecarError,
    UsageError,
    V2VError,
    VideoChanged,
    VideoError,
    VideoUnreadable,
)
from v2v_protocol.events import EventList
from v2v_protocol.messages import Lease
from v2v_protocol.persisted import parse_json
from v2v_protocol.sample import (
    ARRAYS,
    Layout,
    Needs,
    Provenance,
    Refusal,
    Sample,
    SampleId,
    SampleParams,
    array_layout,
    needs_of,
    new_arrays,
    sidecar_endings,
)
from v2v_protocol.spec import MARGIN_PX, MOST_SUBSTEPS, StreamSpec
from v2v_server.corpus.scenes.scene import Scene
from v2v_server.corpus.sources.sidecars import open_sidecar, sidecar_id
from v2v_server.corpus.sources.source import VideoSource
from v2v_server.flow import FlowSettings, flow_for
from v2v_server.kinds.registry import kind_of
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
from v2v_server.store.verified import read_unchanged
from v2v_server.video.decode import ClipRequest, Cut, DecodedClip, SampleView
from v2v_server.video.picture import MIXED, MOST_BITS, SDR, ChromaCut
from v2v_server.video.rows import Rows
from v2v_server.worker.arrays import boxes
from v2v_server.worker.arrays.context import ARRAY_BUILDERS, SampleContext, SourceClip
from v2v_server.worker.scene_choice import (
    CleanFrames,
    FlowPlan,
    crop_weight,
    frame_index,
    frame_times,
    most_frames,
    plan_flow,
    usable_window,
    within_rows,
)

_LISTED = ("listing",)
"""What arrays that are not made by the kernel may take of it: the events one by one, by the general kernel."""
_LONGEST_REASON = 500


def chroma_cut(
    lease: Lease, params: SampleParams, spec: StreamSpec, frames: CleanFrames, source: npt.NDArray[np.int64]
) -> ChromaCut:
    """Return which colour to decode: that of the delivered frames, in the crop. ``source``: [steps + 1]."""
    delivered = np.unique(source[params.ends(spec.recipe)[spec.recipe.first_frame :]])
    if not frames.stride:
        delivered = frames.numbers[delivered] - frames.numbers[0]
    top, bottom = Rows.parse(lease.rows).bounds(lease.height_px)
    window = source_window(params, spec.recipe, usable_window(lease, frames.sides))
    return ChromaCut(tuple(delivered.tolist()), window, (top, bottom - top))


@dataclass(frozen=True, slots=True)
class SamplePlan:
    """What one sample needs of its clip.

    Attributes:
        spec: the stream's spec.
        params: the sample's draw.
        source: [steps + 1] int64, which decoded frame each position of the clip shows.
        frames: the frames of the sequence, and the part of the picture that is used.
        cut: the frames to decode after pauses are removed, cropped as far as possible before the resize.
        margin_px: margin around the crop that the clip has, for flow and sub-steps; None: the whole picture.
        flow: settings of the flow if the lease asks for it.
        flow_plan: flow methods chosen from the statistics of the scene; None if the spec does not use them.
    """

    spec: StreamSpec
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


def plan_sample(lease: Lease, index: int) -> SamplePlan:
    """Draw the camera for one of a lease's indices, and plan what to decode.

    Raises:
        ProtocolError: the lease is malformed.
        VideoError: the recipe needs time stamps that the lease does not state.
    """
    spec = _spec(lease.spec)
    recipe = spec.recipe
    scene = None if spec.scene == "off" else Scene.from_bytes(lease.scene)
    frames = CleanFrames.of(scene, lease.start_frame, spec, most_frames(lease, spec))
    picture = usable_window(lease, frames.sides)
    params = draw(
        recipe,
        seed=lease.seed,
        epoch=lease.epoch,
        index=index,
        picture_height_px=picture.height_px,
        picture_width_px=picture.width_px,
        video_id=lease.video,
        video_thresholds=_pair(lease.thresholds),
        times=frame_times(lease, spec, frames) if recipe.is_timed else None,
    )
    place = ""
    if scene is not None and spec.moving_share:
        drawn = choose_crop(
            params,
            recipe,
            seed=lease.seed,
            epoch=lease.epoch,
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
    is_view, needs = kind_of(lease.video).is_view, needs_of(lease.arrays)
    if not is_view and needs.flow:
        flow = FlowSettings.of(spec)
        if flow_plan is not None and flow_plan.still:
            flow = replace(flow, margin_px=0)
        still_px = flow.margin_px
    has_motion = spec.substep_px > 0 and not is_view
    margin_px = max(still_px, MARGIN_PX) if has_motion and still_px is not None else still_px
    window, still = (source_window(params, recipe, picture, margin) for margin in (margin_px, still_px))
    chroma = chroma_cut(lease, params, spec, frames, source) if needs.colour else None
    cells = cells_of(params, recipe, within_rows(lease, frames.sides)) if has_motion else None
    cut = Cut(frames.count(int(source[-1]) + 1), window, chroma, cells, still)
    return SamplePlan(spec, params, source, frames, cut, margin_px, flow, flow_plan)


def decode_for(
    lease: Lease, indices: Sequence[int], source: VideoSource, cache: Cache | None = None
) -> tuple[Decoded, ...]:
    """Decode, in one pass, exactly the frames that some of a lease's indices need.

    Args:
        lease: the work.
        indices: a subset of ``lease.indices``.
        source: where the videos come from.
        cache: cache of decoded pieces for later epochs; None stores nothing.

    Raises:
        VideoError: the file is not the catalogued one, or cannot deliver the expected frames.
        ProtocolError: the lease is malformed.
    """
    plans = [plan_sample(lease, index) for index in indices]
    frames = plans[0].frames
    _refuse_outside(lease.video)
    try:
        request = ClipRequest(
            frame_index(lease, frames.span), lease.start_frame, tuple(plan.cut for plan in plans), frames.stride or 1,
            Rows.parse(lease.rows).bounds(lease.height_px), _most_bits(plans[0].spec),
            tuple((lease.seed, lease.epoch, index) for index in indices),
            tuple(SampleView(plan.spec, plan.params, lease.arrays) for plan in plans),
        )  # fmt: skip
        source.expected = lease.video, lease.notes.state
        with source.open_pixels(lease.video, lease.fingerprint) as pixels:
            if cache is not None and not pixels.is_stored:
                pixels = Cached(pixels, cache, lease.video, lease.fingerprint)
            clips = read_unchanged(pixels, lease.fingerprint, request)
    except VideoError as error:
        # Consumer and log identify videos by id; a path of this host means nothing elsewhere.
        raise type(error)(lease.video, error.frame, error.reason) from error
    if clips[0].signal.transfer == MIXED:
        why = "states different transfer characteristics within a clip: re-encode it with one, or set light to sdr"
        raise VideoError(lease.video, lease.start_frame, why)
    return tuple(
        Decoded(_with_its_margin(plan, clip), frames.pick(clip, int(plan.source[-1]) + 1))
        for plan, clip in zip(plans, clips, strict=True)
    )


def _with_its_margin(plan: SamplePlan, clip: DecodedClip) -> SamplePlan:
    """Return the plan with the margin that was read: a still clip has none for sub-steps."""
    if plan.cut.still is None or clip.frames.shape[1:] != plan.cut.still[2:]:
        return plan
    return replace(plan, margin_px=0 if plan.flow is None else plan.flow.margin_px)


def sample_layout(lease: Lease) -> Layout:
    """Return dtype and shape of each array of a lease's sample.

    Raises:
        ProtocolError: the lease asks for an unknown array.
    """
    try:
        return _layout(lease.spec, lease.arrays)
    except UsageError as error:
        raise ProtocolError(f"lease {lease.lease}: {error}") from error


def make_sample(
    lease: Lease,
    decoded: Decoded,
    into: Mapping[str, npt.NDArray[Any]] | None = None,
    sidecars: Mapping[str, Traversable | None] = MappingProxyType({}),
) -> Sample:
    """Make a lease's sample from its decoded clip: view, flow, simulation.

    Args:
        lease: the work.
        decoded: its decoded clip.
        into: C-contiguous arrays of :func:`sample_layout` to fill; None allocates them.
        sidecars: what :func:`open_sidecars` lends; needed if an array is made from one.

    Raises:
        SidecarError: this host cannot read a sidecar.
        VideoError: the video's frame rate is unknown and the recipe needs it, or its stated thresholds or time stamps
            are beyond what can be simulated.
        ProtocolError: the lease is malformed.
    """
    plan, index = decoded.plan, lease.indices[0]
    arrays = new_arrays(sample_layout(lease)) if into is None else into
    context, irregular = sample_context(lease, decoded, needs_of(arrays), sidecars)
    unlabelled = {
        name: f"{lease.video}: its frame rate is unknown, and {name} needs it"
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
                with errors_of_sidecar(lease.video, name, sidecars, refused_sidecars(lease)):
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
            id=SampleId(lease.spec_digest, lease.catalogue_digest, NUMERICS_VERSION, lease.seed, lease.epoch, index),
            video=lease.video,
            fingerprint=lease.fingerprint,
            start_frame=lease.start_frame,
            candidate=lease.candidate,
            refusals=_refusals(lease),
            params=plan.params,
            saturated_bins=saturated_bins,
            irregular_timestamps=irregular,
            decoder=_decoder(decoded.clip),
            quarantine=lease.quarantine,
            scene="" if plan.flow_plan is None else plan.flow_plan.reason,
            sidecars=dict(context.clip.fingerprints),
            unlabelled=unlabelled,
            boxes_dropped=dropped.pop("boxes", 0),
            dropped={name: count for name, count in dropped.items() if count},
            saturated={name: count for name, count in saturated.items() if count},
            grid_seconds=_grid_seconds(context),
            substeps=0 if made is None else context.substeps,
            remark=lease.remark,
        ),
    )


def list_sample_events(lease: Lease, decoded: Decoded) -> EventList:
    """List the events of a lease's sample with their times, which are those of the video's frames.

    Raises:
        VideoError: as :func:`make_sample`; or the video's frame rate is unknown.
    """
    context, _ = sample_context(lease, decoded, Needs(events=True, seconds="must"))
    made = simulate(context, {})
    return list_events(made.given, made.real, 1e6 * made.given.step_seconds)


def sample_context(
    lease: Lease,
    decoded: Decoded,
    needs: Needs,
    sidecars: Mapping[str, Traversable | None] = MappingProxyType({}),
) -> tuple[SampleContext, int]:
    """Return what arrays with these needs are made from, and the number of irregular time stamps; no simulation.

    Raises:
        VideoError: the video's frame rate is unknown, and the recipe or an array must have it.
    """
    plan = decoded.plan
    params, recipe = plan.params, plan.spec.recipe
    frames, signal, flow, levels = decoded.clip.frames, decoded.clip.signal, None, decoded.clip.levels
    if plan.flow is not None and needs.flow and "flow" not in decoded.clip.arrays:
        methods = () if plan.flow_plan is None else plan.flow_plan.methods
        part = without_margin(frames, params, recipe, plan.margin_px, plan.flow.margin_px)
        flow = flow_for(
            eight_bits(part, signal), params, recipe, plan.flow, validity=needs.flow == "checked", plan=methods
        )
    motion = decoded.clip.motion
    if motion is not None and motion.any() and (needs.events or needs.levels):
        part = without_margin(frames, params, recipe, plan.margin_px, MARGIN_PX)
        picture = within_rows(lease, plan.frames.sides)
        levels = levels_of(part, params, recipe, plan.source, plan.spec.substep_px, motion, picture)
    # An array must not make a video unusable for the others: without a rate, it is left empty.
    is_timed = recipe.needs_seconds or needs.seconds == "must" or (bool(lease.frames_per_second and needs.seconds))
    seconds, irregular = _step_seconds(lease, decoded) if is_timed else (None, 0)
    view = frames
    if not decoded.clip.is_view:
        view = apply_view(without_margin(frames, params, recipe, plan.margin_px), params, recipe, signal)
    clip = SourceClip(
        lease.start_frame,
        decoded.clip.seconds,
        None if plan.cut.chroma is None or decoded.clip.chroma is None else (decoded.clip.chroma, plan.cut.chroma),
        sidecars,
        fingerprints={ending: fingerprint for ending, (_, fingerprint) in sidecar_files(lease).items()},
        numbers=plan.frames.numbers,
        picture_px=(lease.height_px, lease.width_px),
        usable=usable_window(lease, plan.frames.sides),
    )
    return SampleContext(
        lease.video, clip, plan.spec, params, plan.source, view, signal, seconds, flow, levels
    ), irregular


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


def _step_seconds(lease: Lease, decoded: Decoded) -> tuple[npt.NDArray[np.float64], int]:
    """Call :func:`step_seconds` for a clip."""
    plan = decoded.plan
    if not lease.frames_per_second:
        why = "the recipe needs seconds" if plan.spec.recipe.needs_seconds else "events need times"
        raise VideoError(lease.video, None, f"its frame rate is unknown, and {why}")
    return step_seconds(decoded.clip.seconds, plan.source, lease.frames_per_second / plan.spec.recipe.frame_stride)


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


def kernels_of(lease: Lease) -> frozenset[Variant]:
    """Return the compiled kernels that a lease's sample may need."""
    made = tuple(name for name in NAMES if name in lease.arrays)
    others = [name for name in lease.arrays if name not in NAMES and needs_of([name]).events]
    found = frozenset[Variant]()
    for arrays in filter(None, (made, _LISTED if others else ())):
        found |= _variants(lease.spec, lease.frames_per_second or 1.0, lease.thresholds, arrays)
    return kind_of(lease.video).variants(found)


@lru_cache(maxsize=64)
def _variants(
    canonical: bytes, frames_per_second: float, thresholds: tuple[float, ...], arrays: tuple[str, ...]
) -> frozenset[Variant]:
    spec = _spec(canonical)
    step_seconds = spec.recipe.frame_stride / frames_per_second
    levels_per_step = MOST_SUBSTEPS - 1 if spec.substep_px else 0
    return variants(spec.recipe, spec.voxel_dtype, step_seconds, _pair(thresholds), arrays, levels_per_step)


@lru_cache(maxsize=16)
def _spec(canonical: bytes) -> StreamSpec:
    try:
        return StreamSpec.from_dict(parse_json(canonical))
    except ValueError as error:
        raise ProtocolError(f"lease.spec is not JSON: {error}") from error


@lru_cache(maxsize=16)
def _layout(canonical: bytes, arrays: tuple[str, ...]) -> Layout:
    spec = _spec(canonical)
    return array_layout(spec.recipe, spec.voxel_dtype, arrays)


def _pair(thresholds: tuple[float, ...]) -> tuple[float, float] | None:
    return (thresholds[0], thresholds[1]) if thresholds else None


def _refusals(lease: Lease) -> tuple[Refusal, ...]:
    return tuple(map(Refusal.from_dict, lease.refusals["refusals"]))


def _refuse_outside(video: str) -> None:
    """Reject a catalogue id that leads out of the root."""
    relative = PurePosixPath(video)
    if relative.is_absolute() or ".." in relative.parts:
        raise ProtocolError(f"video id {video!r} leads out of the corpus folder")


def read_ahead(lease: Lease, sidecars: Mapping[str, Traversable | None]) -> None:
    """Read the boxes of a lease, so that they are at hand when its sample is made."""
    if "boxes" in lease.arrays:
        fingerprints = {ending: fingerprint for ending, (_, fingerprint) in sidecar_files(lease).items()}
        boxes.read_ahead(lease.video, sidecars, fingerprints, (lease.height_px, lease.width_px))


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

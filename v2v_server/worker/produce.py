"""Make the samples of a lease: decode, view, simulate.

Server workers and `v2v-simulate` both use this module, so they make equal samples.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
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
    Layout,
    Provenance,
    Refusal,
    Sample,
    SampleId,
    SampleParams,
    array_layout,
    empty_value,
    needs_seconds,
    new_arrays,
    sidecar_endings,
)
from v2v_protocol.spec import MARGIN_PX, MOST_SUBSTEPS, StreamSpec
from v2v_server.corpus.scenes.scene import Scene
from v2v_server.corpus.sources.source import VideoSource, open_sidecar, sidecar_id
from v2v_server.flow import FlowSettings, flow_for
from v2v_server.labels import READERS, BoxTable, kept_boxes, numbered_files, read_mask, view_boxes, view_mask
from v2v_server.motion import cells_of, levels_of
from v2v_server.simulation.draw import choose_crop, draw
from v2v_server.simulation.intensity import eight_bits
from v2v_server.simulation.kernels import list_events
from v2v_server.simulation.precision import Variant, variants
from v2v_server.simulation.representations import NAMES
from v2v_server.simulation.view import apply_view, source_window, without_margin
from v2v_server.simulation.voxel import step_seconds
from v2v_server.store.cache import Cache, Cached
from v2v_server.store.pixels import kind_of
from v2v_server.store.verified import read_unchanged
from v2v_server.video.decode import ClipRequest, Cut, DecodedClip, SampleView
from v2v_server.video.picture import MIXED, MOST_BITS, SDR, ChromaCut
from v2v_server.video.rows import Rows
from v2v_server.worker.arrays import ARRAY_BUILDERS, SampleContext, SourceClip, fill_rows, makes, simulate
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

_KEPT = 4
"""Sidecars that stay in memory once they are read: siblings use them one after the other."""
_LONGEST_REASON = 500


@makes("frames_rgb")
def frames_rgb(context: SampleContext, out: npt.NDArray[Any]) -> None:
    """Fill in the delivered frames, [T, 3, H, W]: the grey levels of ``frames`` and the colour of the video.

    Raises:
        VideoError: the clip was read without its colour.
    """
    if context.clip.colour is None:
        raise VideoError(context.video, None, "was read without its colour")
    (cells, matrix), cut = context.clip.colour
    params, size = context.params, out.shape[2:]
    grey = np.empty((len(out), 1, *size), np.uint8)
    ARRAY_BUILDERS["frames"](context, grey)
    # The cut names the delivered frames in ascending order.
    places = np.unique(context.source[context.target_steps], return_inverse=True)[1]
    chroma = np.ascontiguousarray(cells).view(np.uint8) ^ 128  # the bits of int8 plus 128
    rows, columns = cut.places
    if params.scale == 1.0:
        columns = np.ascontiguousarray(columns[::-1]) if params.flip else columns
    else:
        # Colour differences are not grey levels: the contrast is a factor of them.
        view = dataclasses.replace(params, contrast=0.0)
        chroma = np.stack([apply_view(each[:, rows[:, None], columns], view, context.recipe) for each in chroma])
        rows, columns = (np.arange(side, dtype=np.int64) for side in size)
    # Import lazily: most workers make no colour.
    from v2v_server.video.rgb import add_colour, differences_of

    add_colour(grey[:, 0], chroma, places, rows, columns, differences_of(matrix, params.contrast or 1.0), out)


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
    is_rendered = kind_of(lease.video) == "photographs"
    if not is_rendered and not {"flow", "flow_valid"}.isdisjoint(lease.arrays):
        flow = FlowSettings.of(spec)
        if flow_plan is not None and flow_plan.still:
            flow = replace(flow, margin_px=0)
        still_px = flow.margin_px
    has_motion = spec.substep_px > 0 and not is_rendered
    margin_px = max(still_px, MARGIN_PX) if has_motion and still_px is not None else still_px
    window, still = (source_window(params, recipe, picture, margin) for margin in (margin_px, still_px))
    chroma = chroma_cut(lease, params, spec, frames, source) if "frames_rgb" in lease.arrays else None
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
        source.expect(lease.video, lease.state)
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
    context, irregular = sample_context(lease, decoded, arrays, sidecars)
    unlabelled = dict[str, str]()
    for name, array in context.into.items():
        if not context.can_time(name):
            array[...] = empty_value(name)
            unlabelled[name] = f"{lease.video}: its frame rate is unknown, and {name} needs it"
            continue
        try:
            if name in decoded.clip.arrays:
                array[...] = decoded.clip.arrays[name]
                continue
            with errors_of_sidecar(lease.video, name, sidecars, refused_sidecars(lease)):
                ARRAY_BUILDERS[name](context, array)
        except SidecarError as error:
            if error.here:
                raise
            array[...] = empty_value(name)
            unlabelled[name] = str(error)
    saturated = dict(context.saturated or {})
    saturated_bins = saturated.pop("voxels", 0)
    return Sample(
        arrays=context.into,
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
            boxes_dropped=context.dropped.pop("boxes", 0),
            dropped={name: count for name, count in context.dropped.items() if count},
            saturated={name: count for name, count in saturated.items() if count},
            grid_seconds=_grid_seconds(context),
            left_out=context.left_out,
            substeps=0 if context.saturated is None else context.substeps,
            remark=lease.remark,
        ),
    )


def list_sample_events(lease: Lease, decoded: Decoded) -> EventList:
    """List the events of a lease's sample with their times, which are those of the video's frames.

    Raises:
        VideoError: as :func:`make_sample`; or the video's frame rate is unknown.
    """
    context, _ = sample_context(lease, decoded, {})
    made, (seconds, _) = simulate(context, {}), _step_seconds(lease, decoded)
    return list_events(made.given, made.real, 1e6 * seconds)


def sample_context(
    lease: Lease,
    decoded: Decoded,
    into: Mapping[str, npt.NDArray[Any]],
    sidecars: Mapping[str, Traversable | None] = MappingProxyType({}),
) -> tuple[SampleContext, int]:
    """Return what the arrays are made from, and the number of irregular time stamps.

    Without arrays in ``into``, there is all that a simulation needs, and no flow.
    """
    plan = decoded.plan
    params, recipe = plan.params, plan.spec.recipe
    frames, signal, flow, levels = decoded.clip.frames, decoded.clip.signal, None, decoded.clip.levels
    if plan.flow is not None and into and "flow" not in decoded.clip.arrays:  # events need no flow
        methods = () if plan.flow_plan is None else plan.flow_plan.methods
        part = without_margin(frames, params, recipe, plan.margin_px, plan.flow.margin_px)
        flow = flow_for(
            eight_bits(part, signal), params, recipe, plan.flow, validity="flow_valid" in lease.arrays, plan=methods
        )
    motion = decoded.clip.motion
    if motion is not None and motion.any() and not (into and into.keys().isdisjoint(NAMES)):
        part = without_margin(frames, params, recipe, plan.margin_px, MARGIN_PX)
        picture = within_rows(lease, plan.frames.sides)
        levels = levels_of(part, params, recipe, plan.source, plan.spec.substep_px, motion, picture)
    # An array must not make a video unusable for the others: without a rate, it is left empty.
    is_timed = recipe.needs_seconds or (bool(lease.frames_per_second) and needs_seconds(into))
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
        lease.video, clip, plan.spec, params, plan.source, view, signal, seconds, flow, levels, into
    ), irregular


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
    kind = kind_of(lease.video)
    return _variants(lease.spec, lease.frames_per_second or 1.0, lease.thresholds, made, kind) if made else frozenset()


@lru_cache(maxsize=64)
def _variants(
    canonical: bytes, frames_per_second: float, thresholds: tuple[float, ...], arrays: tuple[str, ...], kind: str
) -> frozenset[Variant]:
    spec = _spec(canonical)
    step_seconds = spec.recipe.frame_stride / frames_per_second
    levels_per_step = MOST_SUBSTEPS - 1 if spec.substep_px else 0
    found = variants(spec.recipe, spec.voxel_dtype, step_seconds, _pair(thresholds), arrays, levels_per_step)
    if kind == "photographs":
        found = frozenset(variant._replace(is_divided=False, bits=MOST_BITS, is_rendered=True) for variant in found)
    if not spec.tolerance:
        return found
    return found | {variant._replace(is_general=False, is_divided=False) for variant in found}


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

    def seen(frame: int) -> npt.NDArray[np.float64]:
        corners, numbers = table.at(frame)
        inside, share = view_boxes(corners, clip.usable, context.params, context.recipe)
        kept = kept_boxes(inside, share)
        return np.concatenate([inside[kept], numbers[kept], share[kept, None]], axis=1)

    fill_rows(context, "boxes", out, map(seen, context.target_frames))


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

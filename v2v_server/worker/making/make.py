"""Make a sample from its decoded clip: view, flow, simulation, arrays and provenance."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from importlib.resources.abc import Traversable
from types import MappingProxyType
from typing import Any

import numpy as np
import numpy.typing as npt

from v2v_protocol import NUMERICS_VERSION
from v2v_protocol.errors import SidecarError, UsageError, V2VError, VideoError
from v2v_protocol.events import EventList, whole_edges
from v2v_protocol.recipe import FRAMES
from v2v_protocol.sample import ARRAYS, Needs, Provenance, Sample, SampleId, needs_of, new_arrays, sidecar_endings
from v2v_protocol.spec import MARGIN_PX
from v2v_server.flow import flow_for
from v2v_server.kinds.registry import kind_of
from v2v_server.motion import levels_of
from v2v_server.simulation.clip import RunIn, simulate_clip
from v2v_server.simulation.intensity import eight_bits
from v2v_server.simulation.kernels import Voxels, list_events
from v2v_server.simulation.representations import NAMES
from v2v_server.simulation.view import FrameArray, apply_view, without_margin
from v2v_server.simulation.voxel import step_seconds
from v2v_server.video.decode import DecodedClip
from v2v_server.video.picture import SDR
from v2v_server.worker.arrays.context import ARRAY_BUILDERS, SampleContext, SourceClip
from v2v_server.worker.job import ClipJob, SampleJob
from v2v_server.worker.making.read import Decoded
from v2v_server.worker.scene_choice import usable_window, within_rows

_LONGEST_REASON = 500


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
    known, unlabelled = (
        decoded.clip.arrays,
        {name: f"{clip.video}: {why}" for name, why in decoded.clip.unlabelled.items() if name in arrays},
    )
    context, irregular = sample_context(clip, decoded, needs_of(set(arrays) - unlabelled.keys()), sidecars)
    unlabelled |= {
        name: f"{clip.video}: its frame rate is unknown, and {name} needs it"
        for name in arrays
        if not context.can_time(name)
    }
    left = [name for name in arrays if name not in known and name not in unlabelled]
    if any(ARRAYS[name].needs.events for name in left):
        of_kernel = {name: arrays[name] for name in NAMES if name in left}
        context = replace(context, simulated=simulate(context, of_kernel))
    dropped = dict[str, int]()
    for name, array in arrays.items():
        if name in known:
            array[...] = known[name]
        elif name in left and name not in NAMES:
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
    saturated = dict(decoded.clip.saturated if made is None else made.saturated)
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
            run_in=plan.run_in if clip.spec.recipe.start == FRAMES else None,
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


def span_ends_us(clip: ClipJob, decoded: Decoded) -> npt.NDArray[np.int64]:
    """Return the times between which a sample's spans lie, [recipe.spans + 1], microseconds as of its events.

    Raises:
        VideoError: the video's frame rate is unknown.
    """
    seconds, _ = _step_seconds(clip, decoded.clip.seconds, decoded.plan.source)
    times_us = whole_edges(1e6 * np.concatenate([[0.0], np.cumsum(seconds)]))
    return times_us[decoded.plan.params.ends(clip.spec.recipe)]


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
    seconds, irregular = _step_seconds(clip, read.seconds, plan.source) if is_timed else (None, 0)
    view, run_in = _seen(clip, decoded, frames), None
    if decoded.before is not None and needs.events:
        earlier = (
            None if seconds is None else _step_seconds(clip, decoded.before.seconds, np.arange(plan.run_in + 1))[0]
        )
        run_in = RunIn(_seen(clip, decoded, decoded.before.frames), earlier)
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
    return SampleContext(
        clip.video, origin, spec, params, plan.source, view, signal, seconds, flow, levels, run_in
    ), irregular


def _seen(clip: ClipJob, decoded: Decoded, frames: FrameArray) -> FrameArray:
    """Return decoded frames, [n, h, w], as the camera sees them, [n, H, W]."""
    plan, recipe = decoded.plan, clip.spec.recipe
    if decoded.clip.is_view:
        return frames
    part = without_margin(frames, plan.params, recipe, plan.margin_px)
    return apply_view(part, plan.params, recipe, decoded.clip.signal)


def simulate(context: SampleContext, out: Mapping[str, npt.NDArray[Any]]) -> Voxels:
    """Simulate the sample into ``out``, arrays that the kernel makes, such as voxels [T, bins, H, W], by name.

    Raises:
        VideoError: thresholds or time stamps that the corpus states for the video are beyond what can be simulated; or
            it is a recording.
    """
    if not kind_of(context.video).is_simulated:
        raise VideoError(
            context.video, None, "has events of its own, so none are simulated: take them from its raw file"
        )
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
            context.run_in,
        )
    except UsageError as error:
        # The recipe was checked before, so the values come from the corpus.
        raise VideoError(context.video, None, f"cannot be simulated: {error}") from error


def _grid_seconds(context: SampleContext) -> tuple[float, ...]:
    """Return the actual duration of each voxel grid if the recipe states one."""
    if not context.recipe.is_timed or context.step_seconds is None:
        return ()
    return tuple(np.add.reduceat(context.step_seconds, context.params.ends(context.recipe)[:-1]).tolist())


def _step_seconds(
    clip: ClipJob, seconds: npt.NDArray[np.float64], source: npt.NDArray[np.int64]
) -> tuple[npt.NDArray[np.float64], int]:
    """Call :func:`step_seconds` for frames of a clip."""
    if not clip.frames_per_second:
        why = "the recipe needs seconds" if clip.spec.recipe.needs_seconds else "events need times"
        raise VideoError(clip.video, None, f"its frame rate is unknown, and {why}")
    rate = clip.frames_per_second / clip.spec.recipe.frame_stride
    return step_seconds(seconds, source, rate)


def _decoder(clip: DecodedClip) -> str:
    """Describe the source of the pixels for the provenance."""
    signal = "" if clip.signal == SDR else f", {clip.signal}"
    host = "" if clip.bit_exact else " (host-dependent)"
    return f"{clip.codec}{host}{signal}" + (f", from the {clip.origin}" if clip.origin else "")


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

"""Draw the camera of a sample, and plan what it needs of its clip. Pure: nothing is read."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from v2v_protocol.sample import SampleParams, needs_of
from v2v_protocol.spec import MARGIN_PX, StreamSpec
from v2v_server.flow import FlowSettings
from v2v_server.kinds.registry import kind_of
from v2v_server.motion import cells_of
from v2v_server.simulation.draw import choose_crop, draw
from v2v_server.simulation.precision import Variant, variants
from v2v_server.simulation.representations import NAMES
from v2v_server.simulation.view import source_window
from v2v_server.video.decode import Cut
from v2v_server.video.picture import ChromaCut
from v2v_server.worker.job import ClipJob
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


@dataclass(frozen=True, slots=True)
class SamplePlan:
    """What one sample needs of its clip.

    Attributes:
        params: the sample's draw.
        source: [steps + 1] int64, which decoded frame each position of the clip shows.
        frames: the frames of the sequence, and the part of the picture that is used.
        cut: the frames to decode after pauses are removed, cropped as far as possible before the resize.
        run_in: frames of them before the clip, which the pixels start from.
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
    run_in: int = 0


def plan_sample(clip: ClipJob, index: int) -> SamplePlan:
    """Draw the camera of one sample of a clip, and plan what to decode.

    Raises:
        VideoError: the recipe needs time stamps that are unknown, or the index or the scene is damaged.
    """
    spec, scene, seed, epoch = clip.spec, clip.scene, clip.seed, clip.epoch
    recipe = spec.recipe
    is_view, run_in = kind_of(clip.video).is_view, int(recipe.run_in_at(clip.frames_per_second))
    # A rendered scene has a past of its own.
    frames = CleanFrames.of(scene, clip.start_frame, spec, most_frames(clip), 0 if is_view else run_in)
    run_in = run_in // recipe.frame_stride if is_view else len(frames.before)
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
    needs = needs_of(clip.arrays)
    if not is_view and needs.flow:
        flow = FlowSettings.of(spec)
        if flow_plan is not None and flow_plan.still:
            flow = replace(flow, margin_px=0)
        still_px = flow.margin_px
    has_motion = spec.substep_px > 0 and not is_view
    margin_px = max(still_px, MARGIN_PX) if has_motion and still_px is not None else still_px
    window, still = (source_window(params, recipe, picture, margin) for margin in (margin_px, still_px))
    chroma = chroma_cut(clip, params, frames, source) if needs.colour else None
    cells = cells_of(params, recipe, within_rows(clip, frames.sides)) if has_motion else None
    cut = Cut(frames.count(int(source[-1]) + 1), window, chroma, cells, still)
    return SamplePlan(params, source, frames, cut, margin_px, flow, flow_plan, run_in)


def chroma_cut(clip: ClipJob, params: SampleParams, frames: CleanFrames, source: npt.NDArray[np.int64]) -> ChromaCut:
    """Return which colour to decode: that of the delivered frames, in the crop. ``source``: [steps + 1]."""
    recipe = clip.spec.recipe
    delivered = frames.places(np.unique(source[params.ends(recipe)[recipe.first_frame :]]))
    top, bottom = clip.rows.bounds(clip.height_px)
    window = source_window(params, recipe, usable_window(clip, frames.sides))
    return ChromaCut(tuple(delivered.tolist()), window, (top, bottom - top))


def kernels_of(clip: ClipJob) -> frozenset[Variant]:
    """Return the compiled kernels that the samples of a clip may need."""
    made = tuple(name for name in NAMES if name in clip.arrays)
    others = [name for name in clip.arrays if name not in NAMES and needs_of([name]).events]
    found = frozenset[Variant]()
    for arrays in filter(None, (made, _LISTED if others else ())):
        found |= _variants(clip.spec, clip.frames_per_second or 1.0, clip.thresholds, arrays)
    return kind_of(clip.video).variants(found)


@lru_cache(maxsize=64)
def _variants(
    spec: StreamSpec,
    frames_per_second: float,
    thresholds: tuple[float, float] | None,
    arrays: tuple[str, ...],
) -> frozenset[Variant]:
    step_seconds = spec.recipe.frame_stride / frames_per_second
    return variants(spec.recipe, spec.voxel_dtype, step_seconds, thresholds, arrays, spec.levels_per_step)

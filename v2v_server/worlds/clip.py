"""The clip of a sample: its frames and the levels between them as its camera sees them, with what is known exactly."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt

from v2v_protocol.recipe import preset
from v2v_protocol.sample import array_layout, new_arrays
from v2v_protocol.spec import MOST_SUBSTEPS, StreamSpec
from v2v_server.simulation.clip import intensity_of
from v2v_server.simulation.draw import draw
from v2v_server.simulation.intensity import light_table, log_table, tones_of
from v2v_server.simulation.view import apply_view, contrast_table
from v2v_server.video.decode import BIT_EXACT_CODECS, DecodedClip, SampleView
from v2v_server.video.picture import Signal
from v2v_server.worlds.render import (
    PhotoPyramid,
    flow_of,
    levels_between,
    masks_of,
    parts_by_change,
    parts_by_motion,
    pyramid_of,
    render,
    tracks_of,
)
from v2v_server.worlds.world import Doubles, World, draw_world

_FLOW = "flow", "flow_valid"
BLURRED = "frames_blurred"
_PIECE_SECONDS, _PIECE_PX, _MOST_MOMENTS, _AT_ONCE = 1 / 200, 1 / 8, 8192, 64
"""An exposure is rendered at moments between which nothing moves farther; motion is judged by pieces of the clip."""
TRUTH = (*_FLOW, "masks", "tracks")
"""Arrays of a sample that are known exactly."""


def render_clip(
    pyramid: PhotoPyramid,
    picture_px: tuple[int, int],
    times: Doubles,
    sample: tuple[int, int, int],
    view: SampleView,
    codec: str = "",
) -> DecodedClip:
    """Render what the camera of a sample sees, and the requested arrays that are known.

    Before the clip, nothing shakes or changes its pace.

    Args:
        pyramid, picture_px: the usable part of the photograph; its height and width.
        times: [n] presentation times of the frames of the clip.
        sample: (seed, epoch, index).
        view: of the sample.
        codec: the format of the photograph's file.
    """
    spec, params, recipe = view.spec, view.params, view.spec.recipe
    seed, epoch, index = sample
    seconds = times - times[0]
    world = draw_world(
        recipe, params, seed=seed, epoch=epoch, index=index, picture_px=picture_px, seconds=(0.0, seconds[-1])
    )  # fmt: skip
    ends = params.ends(recipe)
    source = params.source_index(int(ends[-1]))
    signal, seen = Signal(recipe.world_bits), replace(params, scale=1.0)
    shown = contrast_table(params.contrast, signal.white) if params.contrast else None
    parts = np.ones(len(seconds) - 1, np.int64)
    if spec.substep_px:
        parts = parts_by_motion(world, seconds, spec.substep_px, MOST_SUBSTEPS)
    if recipe.world_change_share:
        logs = log_table(*intensity_of(params, recipe, signal))
        changes = np.stack([logs / np.float32(each) for each in (params.threshold_pos, params.threshold_neg)])
        changes = changes if shown is None else changes[:, shown]
        by_change = parts_by_change(pyramid, world, seconds, changes, recipe.world_change_share, MOST_SUBSTEPS)
        parts = np.maximum(parts, by_change)
    levels = levels_between(pyramid, world, seconds, source, parts)
    if levels is not None and shown is not None:
        levels = levels._replace(grey=np.stack([shown[level] for level in levels.grey]))
    before = np.array(view.before)
    frames = apply_view(render(pyramid, world, np.concatenate((before, seconds))), seen, recipe, signal)
    known = tuple(name for name in TRUTH if name in view.arrays)
    arrays = _truth(world, seconds[source[ends]], spec, known) if known else {}
    if BLURRED in view.arrays:
        light = light_table(recipe.gamma, signal)
        light = light if shown is None else light[shown]
        middles = ends[recipe.first_frame :]
        total = _exposed(pyramid, world, seconds, source, middles, params.exposure_seconds, light)
        arrays[BLURRED] = tones_of(total[:, None, :, :: -1 if world.flip else 1], recipe.gamma)
    return DecodedClip(
        frames, np.concatenate((times[0] + before, times)), codec, codec in BIT_EXACT_CODECS, signal=signal,
        arrays=arrays, is_view=True, levels=levels,
    )  # fmt: skip


def _exposed(
    pyramid: PhotoPyramid,
    world: World,
    seconds: Doubles,
    source: npt.NDArray[np.int64],
    middles: npt.NDArray[np.int64],
    exposure_seconds: float,
    light: Doubles,
) -> Doubles:
    """Return the mean light of some exposures, [n, H, W], not mirrored. Nothing moves while the camera pauses.

    Args:
        pyramid, world: the photograph and the draw.
        seconds: moment of each frame, evenly spaced.
        source: [steps + 1], which frame each position of the clip shows.
        middles: [n], the positions in the middle of the exposures.
        exposure_seconds: of each.
        light: of each level.
    """
    step, last = float(seconds[-1]) / (len(seconds) - 1) if len(seconds) > 1 else 1.0, len(source) - 1
    pieces = np.arange(0.0, seconds[-1] + 2 * _PIECE_SECONDS, _PIECE_SECONDS)
    most = int(parts_by_motion(world, pieces, _PIECE_PX, _MOST_MOMENTS).max())
    count = min(max(1, math.ceil(most * exposure_seconds / _PIECE_SECONDS)), _MOST_MOMENTS)
    found = np.zeros((len(middles), *world.crop[2:]))
    for total, middle in zip(found, (middles * step).tolist(), strict=True):
        since = middle + exposure_seconds * ((np.arange(count) + 0.5) / count - 0.5)
        moments = np.interp(since, np.arange(last + 1) * step, seconds[source])
        moments += np.minimum(since, 0.0) + np.maximum(since - last * step, 0.0)
        for first in range(0, count, _AT_ONCE):
            for picture in render(pyramid, world, moments[first : first + _AT_ONCE]):
                total += light[picture]
    return found / count


def _truth(world: World, ends: Doubles, spec: StreamSpec, names: tuple[str, ...]) -> dict[str, npt.NDArray[Any]]:
    """Return arrays of :data:`TRUTH`.

    Args:
        ends: [spans + 1] moments from one delivered frame to the next, the first of all included.
    """
    arrays, shown = new_arrays(array_layout(spec.recipe, spec.voxel_dtype, names)), ends[spec.recipe.first_frame :]
    if "tracks" in arrays:
        arrays["tracks"][:] = tracks_of(world, shown)
    if "masks" in arrays:
        arrays["masks"][:] = [masks_of(world, moment) for moment in shown]
    if not arrays.keys().isdisjoint(_FLOW):
        order = 1 if spec.flow_direction == "forward" else -1
        for voxel, span in enumerate(pairwise(ends[spec.recipe.lead_voxels :].tolist())):
            found = dict(zip(_FLOW, flow_of(world, *span[::order]) if voxel >= spec.flow_from else (0, 0), strict=True))
            for name in arrays.keys() & found.keys():
                arrays[name][voxel] = found[name]
    return arrays


def load() -> None:
    """Load from numba's cache, or compile, what renders photographs."""
    fields = {"voxels_per_clip": 1, "bins": 1, "crop_height_px": 16, "crop_width_px": 16, "track_points": 1}
    recipe = preset("worlds").replace(**fields, flip_probability=0.0, pause_probability=0.0)
    params = draw(recipe, seed=0, epoch=0, index=0, picture_height_px=16, picture_width_px=16, video_id="")
    grey = np.zeros((16, 16), np.uint8)
    view = SampleView(StreamSpec(recipe), params, TRUTH)
    render_clip(pyramid_of(grey), grey.shape, np.array([0.0, 1.0]), (0, 0, 0), view)

"""Word what is wrong with a corpus: with its videos, with those that give no sequence under a spec, and what to change.

The server's log, ``v2v-doctor`` and ``v2v-preview`` say the same of a corpus, because they ask here.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from v2v_protocol.errors import UsageError
from v2v_protocol.programs import counted
from v2v_protocol.recipe import LARGEST_SCALE, MOST_STEPS_PER_GRID, Recipe
from v2v_protocol.sample import Refusal, RefusalKind
from v2v_protocol.spec import StreamSpec
from v2v_recordings.time_stamps import PLAUSIBLE_HZ
from v2v_server.corpus.scenes.runs import Runs
from v2v_server.corpus.scenes.scene import MOST_ANALYSED_FRAMES, NO_BARS, Sides
from v2v_server.corpus.sources.listing import format_problems
from v2v_server.corpus.videos import SplitVideos, VideoEntry
from v2v_server.kinds.kind import LEAST_EXPOSED
from v2v_server.kinds.registry import kind_of
from v2v_server.lease_memory import MOST_CLIP_BYTES, MOST_LEASE_BYTES, frame_bytes, most_steps
from v2v_server.simulation.draw import admits, smallest_scale
from v2v_server.video.rows import Rows

if TYPE_CHECKING:  # the schedule asks here, and opens no catalogue
    from v2v_server.corpus.catalogue import Catalogue

_SHOWN = 5


def notes_of(catalogue: Catalogue) -> list[str]:
    """Return what the user ought to know of a corpus, whatever the recipe: what opening it noted, and what is wrong
    with its videos.
    """
    videos, (low, high) = catalogue.videos, PLAUSIBLE_HZ
    ids, rates = videos.ids, videos.frames_per_second
    woven, lacking = np.flatnonzero(videos.interlaced), catalogue.lacking
    shorter, crashing = catalogue.shorter, catalogue.crashing
    remarks = {ids[at]: videos.remark[at] for at in np.flatnonzero(videos.remark).tolist()}
    is_odd = (rates > 0) & ((rates < low) | (rates > high))
    odd = {ids[at]: f"{rates[at]:.3g}" for at in np.flatnonzero(is_odd).tolist()}
    found = (
        (
            len(lacking),
            f"{counted(len(lacking), 'video has', 'videos have')} no prepared file, so others stand in for them"
            f"{format_problems(lacking)}",
        ),
        (
            len(woven),
            f"{counted(len(woven), 'video is', 'videos are')} interlaced ({ids[int(woven[0])] if len(woven) else ''}): "
            "the frames are served as they are stored, two fields taken at different times woven together, so that "
            "what moves is combed and makes false events. Deinterlace such videos once (ffmpeg -i IN -vf "
            "bwdif=send_field OUT), or leave them out",
        ),
        (
            len(remarks),
            f"{counted(len(remarks), 'video is', 'videos are')} served in part, or with wrong grey levels or times"
            f"{format_problems(remarks)}",
        ),
        (
            len(odd),
            f"{counted(len(odd), 'video has a rate', 'videos have rates')} outside of {low:g} to {high:g} frames a "
            f"second{format_problems(odd)}: check the unit of their time stamps, or --rate",
        ),
        (len(catalogue.left_out), catalogue.left_out),
        (
            len(shorter),
            f"{counted(len(shorter), 'video is', 'videos are')} shorter than the list states: {''.join(shorter[:1])}",
        ),
        (
            len(crashing),
            f"{counted(len(crashing), 'video crashes', 'videos crash')} the decoder that analyses scenes: "
            f"{''.join(crashing[:1])}",
        ),
    )
    return [*(text for count, text in found if count), *catalogue.notes]


def longest_clip(frames: int, steps: int, recipe: Recipe) -> int:
    """Return the largest ``voxels_per_clip`` that this number of frames is enough for; 0 if it is not enough for
    any.

    Args:
        steps: from one delivered frame to the next.
    """
    return max(0, (frames - 1) // (steps * recipe.frame_stride) - recipe.lead_voxels)


def why_unsuited(video: VideoEntry, rows: Rows, spec: StreamSpec) -> Refusal:
    """Return why a video that gives no sequence under a spec gives none, and which setting would admit it."""
    recipe = spec.recipe
    if recipe.is_timed and (refusal := _unsuited_rate(video, recipe)) is not None:
        return refusal
    rate, least_hz = video.frames_per_second, kind_of(video.id).least_hz(spec)
    if least_hz and not rate >= least_hz * (1.0 - 1e-6):
        reason = (
            f"{rate:g} frames/s, an exposure of {recipe.exposure_seconds[0]:g} s at frame_stride {recipe.frame_stride} "
            f"needs {least_hz:.6g}: at least {LEAST_EXPOSED} frames are averaged"
        )
        return _unsuited(video, reason, "a longer exposure_seconds, none (0), or videos of a higher rate")
    if video.frames <= recipe.sequence_at(video.frames_per_second):
        return _too_short(video, recipe)
    return too_small(video, rows, recipe) or _too_large(video, rows, spec) or _all_cut(video, rows, spec)


def _unsuited(video: VideoEntry, reason: str, remedy: str) -> Refusal:
    return Refusal(video.id, None, reason, RefusalKind.UNSUITED, remedy=remedy)


def _too_short(video: VideoEntry, recipe: Recipe) -> Refusal:
    most = longest_clip(video.frames, int(recipe.steps_at(video.frames_per_second)), recipe)
    shorter = "shorter voxel_seconds" if recipe.is_timed else "fewer bins, frames_per_bin"
    remedy = _shorter(most) if most else f"{shorter} or frame_stride, no lead_voxels"
    if video.frames < 2:
        remedy = "none: a voxel grid needs two frames"
    return _unsuited(video, f"{video.frames} frames, {_needs(video, recipe)}", remedy)


def _shorter(most: int) -> str:
    return f"voxels_per_clip at most {most} (--set voxels_per_clip={most})"


def _needs(video: VideoEntry, recipe: Recipe) -> str:
    needed = f"the recipe needs {recipe.sequence_at(video.frames_per_second) + 1}"
    return f"{needed} at {video.frames_per_second:g} frames/s" if recipe.is_timed else needed


def _unsuited_rate(video: VideoEntry, recipe: Recipe) -> Refusal | None:
    """Return a refusal if the number of steps in a grid of ``voxel_seconds`` is unknown or too large."""
    steps = int(recipe.steps_at(video.frames_per_second))
    if not steps:
        return _unsuited(video, "its frame rate is unknown, and voxel_seconds needs it", "voxel_seconds 0")
    if steps <= MOST_STEPS_PER_GRID:
        return None
    reason = (
        f"a voxel grid of {recipe.voxel_seconds[1]:g} s spans {steps} steps at {video.frames_per_second:g} frames/s"
    )
    return _unsuited(video, f"{reason}, the limit is {MOST_STEPS_PER_GRID}", "shorter voxel_seconds, or frame_stride")


def _all_cut(video: VideoEntry, rows: Rows, spec: StreamSpec) -> Refusal:
    recipe, runs = spec.recipe, Runs(SplitVideos.of([video.pieces or b""]), spec)
    longest, needed = max(runs.frames.tolist(), default=0), int(recipe.sequence_at(video.frames_per_second)) + 1
    if longest < needed:
        most = longest_clip(longest, int(recipe.steps_at(video.frames_per_second)), recipe)
        reason = f"at most {longest} frames in a row without a defect, {_needs(video, recipe)}"
        return _unsuited(video, reason, f"{_shorter(most)}, or scene off" if most else "scene off")
    for sides in runs.sides[runs.frames >= needed].tolist():
        if (refusal := too_small(video, rows, recipe, Sides(*sides))) is not None:
            return refusal
    return _unsuited(video, "all its sequences are still or quiet", "still_share 1 and quiet_share 1")


def _too_large(video: VideoEntry, rows: Rows, spec: StreamSpec) -> Refusal | None:
    steps = int(spec.recipe.held_at(video.frames_per_second)) // spec.recipe.frame_stride
    if steps <= most_steps(video, rows, spec):
        return None
    read, taken = (size * (steps + 1) for size in frame_bytes(video, rows, spec))
    reason = f"one sample takes up to {taken >> 20} MiB of memory, the limit is {MOST_LEASE_BYTES >> 20} MiB"
    if read > MOST_CLIP_BYTES:
        reason = f"one sample takes {read >> 20} MiB of decoded frames, the limit is {MOST_CLIP_BYTES >> 20} MiB"
    remedy = "fewer voxels_per_clip or samples_per_decode, a smaller flow_margin_px, substep_px 0, or resize_scale 1"
    return _unsuited(video, reason, remedy)


def too_small(video: VideoEntry, rows: Rows, recipe: Recipe, sides: Sides = NO_BARS) -> Refusal | None:
    try:
        top, bottom = rows.bounds(video.height_px)
    except UsageError as error:
        return _unsuited(video, str(error), "other rows")
    height, width = bottom - top - sides.top - sides.bottom, video.width_px - sides.left - sides.right
    if admits(recipe, height, width):
        return None
    bars = " and without its bars" if any(sides) else ""
    if min(height, width) <= 0:
        return _unsuited(video, f"nothing is left of the picture after rows {rows}{bars}", "other rows")
    # Round up; otherwise the picture would be a fraction of a pixel too small.
    scale = math.ceil(smallest_scale(recipe, height, width) * 1000) / 1000
    reason = (
        f"picture {width}x{height} after rows {rows}{bars}, the crop is {recipe.crop_width_px}x{recipe.crop_height_px}"
    )
    larger = f"resize_scale up to {scale:g}, or a smaller crop" if scale <= LARGEST_SCALE else "a smaller crop"
    return _unsuited(video, reason, larger)


def corpus_summary(catalogue: Catalogue, spec: StreamSpec, table: Any, *, list_refused: bool = False) -> list[str]:
    """Return lines that say how many sequences there are, which videos give none, and which setting would admit them.

    Args:
        catalogue, spec: of the server.
        table: its :class:`v2v_server.schedule.SequenceTable`.
        list_refused: whether to name all of those videos, not only the first few.
    """
    span, lines = sequence_span(catalogue, spec.recipe)
    lines = [
        f"{counted(len(catalogue.videos), 'video')} in {catalogue.source}, {table.videos} of use: "
        f"{counted(table.count, 'sequence')} of {span} (at most {spec.max_sequences_per_video} a video), "
        f"rows {catalogue.rows}",
        *lines,
    ]
    if spec.scene != "off":
        split = 0 if catalogue.videos.split is None else len(catalogue.videos.split)
        lines.append(
            f"scene {spec.scene}: {counted(split, 'video has', 'videos have')} shot boundaries or empty parts; "
            f"{counted(table.spoilt, 'sequence is', 'sequences are')} left out or moved"
        )
        if long := int(np.count_nonzero(catalogue.videos.frames > MOST_ANALYSED_FRAMES)):
            lines.append(
                f"{counted(long, 'video is', 'videos are')} longer than the {MOST_ANALYSED_FRAMES} frames that are "
                "analysed: later frames are served only of videos without defects; split long videos to use all of them"
            )
    if refusals := table.refusals:
        lines.append(f"{counted(len(refusals), 'video gives', 'videos give')} none under the server's own recipe:")
        lines += _listed(refusals, list_refused)
        lines += _shorter_clips(table)
    if catalogue.refusals:
        lines.append(f"{counted(len(catalogue.refusals), 'file')} cannot be used at all:")
        lines += _listed(catalogue.refusals, list_refused)
    return lines


def sequence_span(catalogue: Catalogue, recipe: Recipe) -> tuple[str, list[str]]:
    """Return what a sequence consists of, and a warning if frames are too far apart for the recipe's grids."""
    if not recipe.is_timed:
        return f"{recipe.frames_needed} frames", []
    rates = catalogue.videos.frames_per_second
    steps = recipe.frame_stride / rates[rates > 0.0]  # of videos without a rate there are no sequences
    if not len(steps):
        return f"{recipe.spans} grids", []
    # A grid has the number of steps that comes nearest to its duration, and at least one.
    made = [np.maximum(np.rint(wanted / steps), 1.0) * steps for wanted in recipe.voxel_seconds]
    shortest, longest = f"{made[0].min():.3g}", f"{made[1].max():.3g}"
    span = f"{recipe.spans} grids of {shortest if shortest == longest else f'{shortest} to {longest}'} s"
    coarse = np.count_nonzero(steps > recipe.voxel_seconds[1])
    warning = (
        f"warning: voxel_seconds = {recipe.voxel_seconds[1]:g} is shorter than the time between frames of {coarse} "
        f"videos (at most {steps.max():.3g} s), so each of their grids lasts from frame to frame: raise voxel_seconds, "
        "or serve videos with more frames a second"
    )
    return span, [warning] if coarse else []


def _listed(refused: Sequence[Refusal], all_of_them: bool) -> list[str]:
    shown = refused if all_of_them else refused[:_SHOWN]
    rest = len(refused) - len(shown)
    return [f"  {line}" for line in shown] + ([f"  ... and {rest} more: --list-refused names all"] if rest else [])


def _shorter_clips(table: Any) -> list[str]:
    """Say how many of the videos that are too short a shorter clip would admit: half of them, and all."""
    longest = sorted(table.longest_clips, reverse=True)
    if not longest:
        return []
    choices = dict.fromkeys((longest[(len(longest) - 1) // 2], longest[-1]))
    each = (f"--set voxels_per_clip={n} admits {sum(voxels >= n for voxels in longest)} of them" for n in choices)
    return [f"  The longest clip that fits has {longest[0]} voxel grids. Shorter clips: {', '.join(each)}"]

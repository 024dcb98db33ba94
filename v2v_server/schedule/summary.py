"""Summarize for the operator what a corpus gives under a spec."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from v2v_protocol.recipe import Recipe
from v2v_protocol.sample import Refusal
from v2v_protocol.spec import StreamSpec
from v2v_server.corpus.catalogue import Catalogue
from v2v_server.corpus.scenes.scene import MOST_FRAMES
from v2v_server.schedule.sequences import SequenceTable

_SHOWN = 5


def corpus_summary(
    catalogue: Catalogue, spec: StreamSpec, table: SequenceTable, *, list_refused: bool = False
) -> list[str]:
    """Return lines that say how many sequences there are, which videos give none, and which setting would admit them.

    Args:
        catalogue, spec, table: of the server.
        list_refused: whether to name all of those videos, not only the first few.
    """
    span, lines = _span(catalogue, spec.recipe)
    lines = [
        f"{len(catalogue.videos)} videos in {catalogue.source}: {table.videos} give {table.count} sequences of "
        f"{span} (at most {spec.max_sequences_per_video} a video), rows {catalogue.rows}",
        *lines,
    ]
    if spec.scene != "off":
        split = 0 if catalogue.videos.split is None else len(catalogue.videos.split)
        lines.append(
            f"scene {spec.scene}: {split} videos have shot boundaries or empty parts; {table.spoilt} sequences are "
            "left out or moved"
        )
        if long := int(np.count_nonzero(catalogue.videos.frames > MOST_FRAMES)):
            lines.append(
                f"{long} videos are longer than the {MOST_FRAMES} frames that are analysed: later frames are served "
                "only of videos without defects; split long videos to use all of them"
            )
    if refusals := table.refusals:
        lines.append(f"{len(refusals)} videos give none under the server's own recipe:")
        lines += _listed(refusals, list_refused)
        lines += _shorter_clips(table)
    if catalogue.refusals:
        lines.append(f"{len(catalogue.refusals)} files cannot be used at all:")
        lines += _listed(catalogue.refusals, list_refused)
    return lines


def _span(catalogue: Catalogue, recipe: Recipe) -> tuple[str, list[str]]:
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


def _shorter_clips(table: SequenceTable) -> list[str]:
    """Say how many of the videos that are too short a shorter clip would admit: half of them, and all."""
    longest = sorted(table.longest_clips, reverse=True)
    if not longest:
        return []
    choices = dict.fromkeys((longest[(len(longest) - 1) // 2], longest[-1]))
    each = (f"--set voxels_per_clip={n} admits {sum(voxels >= n for voxels in longest)} of them" for n in choices)
    return [f"  The longest clip that fits has {longest[0]} voxel grids. Shorter clips: {', '.join(each)}"]

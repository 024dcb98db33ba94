"""Summarize for the operator what a corpus gives under a spec."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from v2v_protocol.refusal import Refusal
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
    recipe = spec.recipe
    span = (
        f"{recipe.spans} grids of {recipe.voxel_seconds[1]:g} s"
        if recipe.is_timed
        else f"{recipe.frames_needed} frames"
    )
    lines = [
        f"{len(catalogue.videos)} videos in {catalogue.source}: {table.videos} give {table.count} sequences of "
        f"{span} (at most {spec.max_sequences_per_video} a video), rows {catalogue.rows}"
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

"""The corpus check of `v2v-doctor`: which videos can be used, why others cannot, and whether they suit a recipe."""

from __future__ import annotations

import errno
import os
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import suppress
from itertools import islice

import numpy as np
import numpy.typing as npt

from v2v_protocol.errors import CorpusError, V2VError
from v2v_protocol.programs import counted
from v2v_protocol.recipe import FRAMES, Recipe
from v2v_protocol.sample import DEFAULT_ARRAYS, array_layout, layout_bytes
from v2v_protocol.spec import StreamSpec
from v2v_protocol.spec_flags import recipe_setting
from v2v_server.corpus.catalogue import Catalogue
from v2v_server.corpus.scenes.picture_check import look_at_pictures, name_all
from v2v_server.corpus.sources.sidecars import open_sidecar, sidecar_id
from v2v_server.corpus_words import notes_of
from v2v_server.kinds.kind import VideosKind
from v2v_server.labels import READERS
from v2v_server.lease_memory import lease_bytes
from v2v_server.schedule import SequenceTable
from v2v_server.system.process import memory_limit
from v2v_server.video.rows import Rows
from v2v_tools.doctor.motion import look_at_motion
from v2v_tools.motion import describe_start, start_events
from v2v_tools.remake import Remaker, open_shown

Line = tuple[str, str, str, str]
"""(level, about, text, change)"""

_VIDEOS_OPENED = 10_000
"""Most videos of which more is read than their line of the index."""


def check_corpus(videos: str, recipe: str, rows: str, cache_dir: str | None, kind: VideosKind) -> Iterator[Line]:
    """Check a corpus and yield lines of the report.

    Args:
        videos, rows, cache_dir, kind: as of :func:`v2v_server.corpus.catalogue.open_catalogue`.
        recipe: name of a recipe, or a YAML file.

    Raises:
        UsageError: wrong recipe or rows.
    """
    spec = StreamSpec.from_dict({"recipe": recipe_setting(recipe, [])})
    Rows.parse(rows)  # before any work
    try:
        catalogue = open_shown(videos, list_file=None, rows=rows, cache_dir=cache_dir, kind=kind)
    except CorpusError as error:
        yield "bad", "corpus", str(error), "give a folder, a video or a list file that this user can read"
        return
    try:
        yield from _lines(catalogue, spec, recipe)
    finally:
        catalogue.close()


def _lines(catalogue: Catalogue, spec: StreamSpec, recipe: str) -> Iterator[Line]:
    found = catalogue.videos
    codecs = Counter(video.codec for video in found)
    kinds = ", ".join(f"{count} {codec}" for codec, count in codecs.most_common())
    yield "ok", "corpus", f"{counted(len(found), 'video')}: {kinds}; {int(found.frames.sum())} frames that decode", ""
    if catalogue.refusals:
        text = f"{counted(len(catalogue.refusals), 'file')} cannot be used: {name_all(catalogue.refusals)}"
        change = "they are skipped: repair them, or leave them out of --videos"
        if any(os.strerror(errno.EACCES) in refusal.reason for refusal in catalogue.refusals):
            change += "; where permission is denied, let this user read the file and its folders (chmod, chown)"
        yield "note", "corpus", text, change
    for note in notes_of(catalogue):
        yield "note", "corpus", note, ""
    for what, values in (
        ("interlaced", found.interlaced),
        ("served in part, or with wrong grey levels or times", found.remark),
    ):
        named = [f"{found.ids[at]} {values[at]}".removesuffix(" True") for at in np.flatnonzero(values).tolist()]
        if len(named) > 1:  # the notes name the first ones
            yield "note", "corpus", f"{what}: {name_all(named)}", ""
    yield from _how_videos_are_stored(catalogue)
    yield from _labels(catalogue)
    frames_needed = int(np.median(spec.recipe.sequence_at(found.frames_per_second))) + 1
    defects = yield from look_at_pictures(catalogue, frames_needed)
    if catalogue.kind.has_motion:
        yield from look_at_motion(catalogue, defects)
    yield from _rates(found.frames_per_second, spec.recipe)
    table = SequenceTable(found, catalogue.rows, spec)
    useless = len(found) - table.videos
    if useless:
        change = _remedy(table.longest_clips, spec.recipe.voxels_per_clip)
        why = name_all(table.refusals)
        level = "note" if table.count else "bad"
        yield (
            level,
            "corpus",
            f"{counted(useless, 'video gives', 'videos give')} no sequence of the recipe {recipe}: {why}",
            change,
        )
    if not table.count:
        return
    yield from _memory(catalogue, spec, table, memory_limit())
    remaker = Remaker(catalogue, spec, DEFAULT_ARRAYS)
    try:
        starts = sum(start_events(remaker.made(0, 0, at)) for at in range(min(4, remaker.count)))  # with compiling
        began = time.perf_counter()
        remaker.sample(0, 0, min(1, remaker.count - 1))
    except V2VError as error:
        yield "bad", "corpus", f"a sample could not be made: {error}", "run v2v-simulate on that video"
        return
    text = f"{counted(table.count, 'sample')} an epoch; one took {time.perf_counter() - began:.2f} s on one core"
    yield "ok", "corpus", text, ""
    yield (
        "ok", "start", f"{describe_start(np.asarray(starts))}; {counted(min(4, remaker.count), 'sample')}",
        "" if spec.recipe.start in ("triangular", FRAMES) else "start: triangular begins as a running camera does",
    )  # fmt: skip


def _memory(catalogue: Catalogue, spec: StreamSpec, table: SequenceTable, limit_bytes: int) -> Iterator[Line]:
    """Name the videos whose samples need more memory than a worker of this host may use."""
    arrays = layout_bytes(array_layout(spec.recipe, spec.voxel_dtype, DEFAULT_ARRAYS))
    useless = {refusal.video for refusal in table.refusals}
    shown = (video for video in islice(catalogue.videos, _VIDEOS_OPENED) if video.id not in useless)
    needs = {video.id: lease_bytes(video, catalogue.rows, spec, arrays) for video in shown}
    large = [id for id, needed in needs.items() if needed > limit_bytes]
    if large:
        text = (
            f"samples of {len(large)} videos need up to {max(needs.values()) / 1e9:.2f} GB of memory, a worker of this "
            f"host may use {limit_bytes / 1e9:.2f}: {name_all(large)}"
        )
        yield "bad", "memory", text, "raise the limit, leave them out, or --set resize_scale=1, fewer voxels_per_clip"


def _rates(rates: npt.NDArray[np.float64], recipe: Recipe) -> Iterator[Line]:
    """Advise ``voxel_seconds`` where a twentieth of the videos has a rate a tenth above or below the median."""
    rates = rates[(rates > 0) & np.isfinite(rates)]
    if recipe.is_timed or recipe.grids_per_frame or not len(rates):
        return
    seconds = recipe.steps_per_frame * recipe.frame_stride / rates
    middle = float(np.median(seconds))
    others = int(np.count_nonzero(np.abs(seconds / middle - 1) > 0.1))
    if 20 * others <= len(rates):
        return
    text = (
        f"frame rates differ ({rates.min():.3g} to {rates.max():.3g} frames/s): a voxel grid lasts {seconds.min():.2g} "
        f"to {seconds.max():.2g} s"
    )
    also = "" if recipe.frames_per_bin == 1 else " --set frames_per_bin=1"
    yield "note", "rates", text, f"--set voxel_seconds={middle:.2g}{also} gives all grids like durations"


def _how_videos_are_stored(catalogue: Catalogue) -> Iterator[Line]:
    if catalogue.prepared is not None or not catalogue.kind.seeks_by_time:
        return
    ids = [video.id for video in islice(catalogue.videos, _VIDEOS_OPENED)]
    unnamed = [id for id in ids if not catalogue.frame_index(id).seekable]
    if unnamed:
        text = (
            f"{counted(len(unnamed), 'video has', 'videos have')} no time stamps that name their frames "
            f"({name_all(unnamed)}): every clip of them is decoded from the beginning of its file"
        )
        yield "note", "corpus", text, "run v2v-prepare once: all frames of a prepared corpus are quick to read"


def _labels(catalogue: Catalogue) -> Iterator[Line]:
    """Count the labels in the sidecars of a local corpus."""
    for ending, reader in READERS.items() if catalogue.source.is_local else ():
        read, labelled, boxes = 0, 0, 0
        marks = catalogue.sidecars[ending].fingerprints
        for id, mark in islice(marks.items(), _VIDEOS_OPENED):
            index = catalogue.frame_index(id)
            with suppress(Exception), open_sidecar(catalogue.source, sidecar_id(id, ending), mark) as opened:
                table = reader(opened, (index.height_px, index.width_px))
                labelled += len(set(table.frames.tolist()).union(table.annotated or ()))
                read, boxes = read + 1, boxes + len(table.frames)
        if marks:
            text = f"{read} of {len(marks)} sidecars {ending} can be read: {labelled} frames have labels, {boxes} boxes"
            yield "ok" if read == len(marks) else "note", "labels", text, ""


def _remedy(longest: Sequence[int], wanted: int) -> str:
    """Say what to do about videos that are too short; "" if no clip length admits any.

    Args:
        longest: largest ``voxels_per_clip`` of each of them.
        wanted: that of the recipe.
    """
    if not longest:
        return ""
    least, for_all = (wanted + 1) // 2, min(longest)
    if for_all >= least:
        return (
            f"leave them out, or --set voxels_per_clip={for_all} admits all that are only too short; a recurrent "
            "network then learns from shorter clips"
        )
    text = (
        f"leave the short ones out: clips of {for_all} voxel grids, the most that the shortest gives, are too short to "
        f"train a recurrent network (the recipe has {wanted})"
    )
    return text + (f"; --set voxels_per_clip={least} admits some" if max(longest) >= least else "")

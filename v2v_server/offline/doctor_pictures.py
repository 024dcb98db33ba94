"""The picture check of `v2v-doctor`: defects in a sample of a corpus, and what can be done about each kind."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

from v2v_protocol.errors import V2VError
from v2v_server.corpus.catalogue import Catalogue
from v2v_server.corpus.probe import LARGEST_MEMORY_BYTES
from v2v_server.defects.defect import BARS, BLACK, CUTS, DUPLICATES, STILL, Defect
from v2v_server.store.clips import pictures_of
from v2v_server.store.format import is_store_file
from v2v_server.system.compile_cache import compile_cache
from v2v_server.system.isolate import Died, run_isolated
from v2v_server.system.process import usable_cores
from v2v_server.video.decode import stream_luma
from v2v_server.video.frame_index import FrameIndex
from v2v_server.video.orientation import Window

MOST_VIDEOS = 12
SECONDS_OF_EACH = 8
_MOST_FRAMES = 400
_ASSUMED_RATE = 30.0
"""Frames a second where the rate is unknown."""
_LONGEST_SECONDS = 60.0
"""After this time no other video is begun."""
_LONGEST_VIDEO_SECONDS = 30.0
_SHOWN = 3
_EFFECTS = {
    DUPLICATES: "duplicated frames",
    CUTS: "hard cuts or jumps",
    BARS: "bars at the sides of the picture",
    STILL: "still stretches",
    BLACK: "black stretches",
}
_CHANGES = {
    DUPLICATES: "a repeated frame makes no events, and the next step those of two: leave such videos out, or re-encode "
    "them once without repeats (ffmpeg -i IN -vf mpdecimate -fps_mode vfr OUT)",
    CUTS: "a cut, or a jump over missing frames, fills the picture with false events: v2v-serve --scene auto "
    "lets no sequence cross one",
    STILL: "only noise makes events there: leave videos out that are still all along",
    BLACK: "v2v-serve --scene auto leaves black stretches out",
}


@dataclass(frozen=True, slots=True)
class _Excerpt:
    """The part of a video that is looked at, in the rows that are used."""

    id: str
    path: Path
    index: FrameIndex
    start: int
    count: int
    window: Window


_Found = tuple[_Excerpt, int, tuple[Defect, ...]]
"""An excerpt, its frames that decode, and their defects."""


def look_at_pictures(catalogue: Catalogue, frames_needed: int) -> Iterator[tuple[str, str, str, str]]:
    """Look for defects in some videos of a local corpus, in bounded time, and yield lines of the report.

    Args:
        frames_needed: frames of a sequence.
    """
    if not catalogue.source.is_local:
        yield "ok", "pictures", "not looked at: these videos lie on another host", ""
        return
    results = sorted(_found(catalogue), key=lambda each: each[0].id)
    found = [each for each in results if each[1]]
    sequences = [(each, span) for each in found for span in _sequences(each[1], frames_needed)]
    text = f"looked at {len(found)} of {len(catalogue.videos)} videos, at most {SECONDS_OF_EACH} s and "
    text += f"{_MOST_FRAMES} frames of each: {len(sequences)} sequences"
    if failed := len(results) - len(found):
        text += f"; {failed} more did not decode within {_LONGEST_VIDEO_SECONDS:.0f} s"
    yield "ok", "pictures", text, ""
    for kind, effect in _EFFECTS.items():
        having = [(excerpt, each) for excerpt, _, defects in found for each in defects if each.kind == kind]
        count = sum(
            any(each.kind == kind and each.touches(*span) for each in defects) for (_, _, defects), span in sequences
        )
        if count:
            named = "; ".join(f"{excerpt.id}: {each.text}" for excerpt, each in having[:_SHOWN])
            more = f"; and {len(having) - _SHOWN} more" if len(having) > _SHOWN else ""
            text = f"{count} of {len(sequences)} sequences ({100 * count // len(sequences)}%) have {effect} ({named}"
            yield "note", "pictures", f"{text}{more})", _CHANGES.get(kind) or _without_bars(having)


def _found(catalogue: Catalogue) -> Iterator[_Found]:
    """Yield what was found in each video; no frames where it does not decode in time."""
    begun = time.monotonic()

    def excerpts() -> Iterator[_Excerpt]:
        videos = catalogue.videos
        many = min(MOST_VIDEOS, len(videos))
        for video in (videos[at * len(videos) // many] for at in range(many)):
            if time.monotonic() - begun > _LONGEST_SECONDS:
                return
            try:
                index = catalogue.frame_index(video.id)
                top, bottom = catalogue.rows.bounds(index.height_px)
            except V2VError:
                continue  # reported with the other checks of this corpus
            rate = video.frames_per_second
            rate = rate if rate and math.isfinite(rate) else _ASSUMED_RATE
            count = max(1, min(len(index), _MOST_FRAMES, round(SECONDS_OF_EACH * rate)))
            start = (len(index) - count) // 2 if index.seekable else 0
            window = top, 0, bottom - top, index.width_px
            yield _Excerpt(video.id, catalogue.path(video.id), index, start, count, window)

    results = run_isolated(
        _look_at, excerpts(), usable_cores(), lambda job: _LONGEST_VIDEO_SECONDS, 2 * LARGEST_MEMORY_BYTES,
        compile_cache(),
    )  # fmt: skip
    for excerpt, result in results:
        yield (excerpt, 0, ()) if isinstance(result, Died) else (excerpt, *result)


def _look_at(excerpt: _Excerpt) -> tuple[int, tuple[Defect, ...]]:
    """Return the number of frames and their defects; no frames where they do not decode."""
    # Import lazily: the process that draws up the report needs no OpenCV.
    from v2v_server.defects.finder import find_defects

    try:
        if is_store_file(excerpt.path):
            return find_defects(islice(pictures_of(excerpt.path, excerpt.index, excerpt.window), excerpt.count))
        return find_defects(stream_luma(excerpt.path, excerpt.index, excerpt.start, excerpt.count, excerpt.window))
    except V2VError:
        return 0, ()


def _sequences(frames: int, needed: int) -> list[tuple[int, int]]:
    """Return the sequences of an excerpt; an excerpt shorter than a sequence counts as one."""
    needed = min(frames, needed)
    return [(first, first + needed) for first in range(0, frames - needed + 1, needed)]


def _without_bars(having: list[tuple[_Excerpt, Defect]]) -> str:
    """Return what to do about bars, with the rows that no bar of these videos touches."""
    top, bottom, at_sides = 0.0, 1.0, False
    for excerpt, defect in having:
        if (sides := defect.sides) is not None:
            first, _, rows, _ = excerpt.window
            height = excerpt.index.height_px
            top = max(top, (first + sides.top) / height if sides.top else 0.0)
            bottom = min(bottom, (first + rows - sides.bottom) / height if sides.bottom else 1.0)
            at_sides = at_sides or bool(sides.left or sides.right)
    remedies = []
    if top or bottom < 1:
        remedies.append(f"--rows {math.ceil(100 * top) / 100:g}:{math.floor(100 * bottom) / 100:g} leaves them out")
    if at_sides:
        remedies.append("crop bars at the left and right once (ffmpeg -i IN -vf crop=W:H:X:Y OUT)")
    return "bars make no events: " + "; ".join(remedies)

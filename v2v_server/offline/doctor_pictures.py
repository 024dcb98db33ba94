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
from v2v_server.corpus.scenes.findings import (
    BARS,
    BLACK,
    COMBED,
    CUTS,
    DUPLICATES,
    FADES,
    NOISY,
    STILL,
    WHITE,
    Defect,
    defects_of,
)  # fmt: skip
from v2v_server.store.clips import pictures_of, signal_of
from v2v_server.store.format import is_store_file
from v2v_server.system.compile_cache import compile_cache
from v2v_server.system.isolate import Died, run_isolated
from v2v_server.system.process import usable_cores
from v2v_server.video.decode import stream_luma
from v2v_server.video.frame_index import FrameIndex
from v2v_server.video.luma import SDR, Signal
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
    FADES: "fades to or from black",
    BARS: "bars at the sides of the picture",
    COMBED: "combed pictures",
    STILL: "still stretches",
    BLACK: "black stretches",
    WHITE: "white stretches",
    NOISY: "still stretches with much noise",
}
_AUTO = "v2v-serve --scene auto"
_CHANGES = {
    DUPLICATES: f"a repeated frame makes no events, and the next step those of two: {_AUTO} drops repeats",
    CUTS: "a cut, or a jump over missing frames, fills the picture with false events: "
    f"{_AUTO} lets no sequence cross one",
    FADES: f"a fade changes every pixel, as no scene does: {_AUTO} lets no sequence cross one",
    BARS: f"bars make no events: {_AUTO} leaves them out of the picture",
    COMBED: f"rows of two times make false events: {_AUTO} leaves such pictures out; deinterlacing keeps them "
    "(ffmpeg -i IN -vf bwdif=send_field OUT)",
    STILL: f"only noise makes events there: {_AUTO} serves a tenth of still sequences (still_share)",
    BLACK: f"{_AUTO} leaves black stretches out",
    WHITE: f"{_AUTO} leaves white stretches out",
    NOISY: f"a coder or sensor makes the events there: {_AUTO} serves a tenth of still sequences (still_share)",
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


_Found = tuple[_Excerpt, int, tuple[Defect, ...], Signal]
"""An excerpt, its frames that decode, their defects, and what the levels of the video mean."""


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
        having = [(excerpt, each) for excerpt, _, defects, _ in found for each in defects if each.kind == kind]
        count = sum(
            any(each.kind == kind and each.touches(*span) for each in defects) for (_, _, defects, _), span in sequences
        )
        if count:
            named = "; ".join(f"{excerpt.id}: {each.text}" for excerpt, each in having[:_SHOWN])
            more = f"; and {len(having) - _SHOWN} more" if len(having) > _SHOWN else ""
            text = f"{count} of {len(sequences)} sequences ({100 * count // len(sequences)}%) have {effect} ({named}"
            yield "note", "pictures", f"{text}{more})", _CHANGES[kind]
    if stated := [(excerpt.id, signal) for excerpt, _, _, signal in found if signal != SDR]:
        named = "; ".join(f"{id}: {signal}" for id, signal in stated[:_SHOWN])
        more = f"; and {len(stated) - _SHOWN} more" if len(stated) > _SHOWN else ""
        text = f"{len(stated)} of {len(found)} videos have other levels than {SDR} ({named}{more})"
        yield "note", "pictures", text, "v2v-serve --set light=declared uses them; otherwise they are read as 8-bit SDR"


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
        yield (excerpt, 0, (), SDR) if isinstance(result, Died) else (excerpt, *result)


def _look_at(excerpt: _Excerpt) -> tuple[int, tuple[Defect, ...], Signal]:
    """Return the number of frames, their defects, and what their levels mean; no frames where they do not decode."""
    # Import lazily: the process that draws up the report needs no OpenCV.
    from v2v_server.corpus.scenes.analysis import analyse

    path, index, window = excerpt.path, excerpt.index, excerpt.window
    try:
        if is_store_file(path):
            scene = analyse(islice(pictures_of(path, index, window), excerpt.count))
        else:
            scene = analyse(stream_luma(path, index, excerpt.start, excerpt.count, window))
        signal = signal_of(path, index)
    except V2VError:
        return 0, (), SDR
    return scene.end, defects_of(scene), signal


def _sequences(frames: int, needed: int) -> list[tuple[int, int]]:
    """Return the sequences of an excerpt; an excerpt shorter than a sequence counts as one."""
    needed = min(frames, needed)
    return [(first, first + needed) for first in range(0, frames - needed + 1, needed)]

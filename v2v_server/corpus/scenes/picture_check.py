"""Defects in a sample of a corpus, and what can be done about each kind: said by `v2v-doctor`, and once by a server."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple, TypeVar

import numpy as np

from v2v_protocol.errors import V2VError
from v2v_protocol.persisted import Persisted
from v2v_protocol.programs import counted
from v2v_protocol.progress import Progress
from v2v_protocol.spec import StreamSpec
from v2v_server.corpus.catalogue import Catalogue
from v2v_server.corpus.probe import LARGEST_PROBE_BYTES
from v2v_server.corpus.scenes.scene import NOISE, SEGMENT_FRAMES, Flag, Scene, Sides, firsts_of, sides_of
from v2v_server.corpus.scenes.stretches import Spans, pattern_of, runs_of
from v2v_server.corpus.sources.source import VideoSource
from v2v_server.corpus.videos import VideoEntry
from v2v_server.store.pixels import signal_of
from v2v_server.system.compile_cache import compile_cache
from v2v_server.system.isolate import Died, run_isolated
from v2v_server.system.process import usable_cores
from v2v_server.video.decode import ClipRequest, Cut
from v2v_server.video.frame_index import FrameIndex
from v2v_server.video.picture import SDR, PixelRect, Signal
from v2v_server.video.probe import DOLBY_VISION

DUPLICATES, CUTS, FADES, BARS, STILL, BLACK, WHITE, COMBED, NOISY = FINDING_KINDS = (
    "duplicates", "cuts", "fades", "bars", "still", "black", "white", "combed", "noise",
)  # fmt: skip
_FLAGS = {
    FADES: (Flag.FADE, "fade to or from black"),
    STILL: (Flag.STILL, "are still"),
    BLACK: (Flag.BLACK, "are black"),
    WHITE: (Flag.WHITE, "are white"),
    COMBED: (Flag.COMBED, "hold two fields of different times"),
}
_NOISY_LEVELS = 1.5
"""Noise of one pixel that fires events at common thresholds, grey levels."""


@dataclass(frozen=True, slots=True)
class Defect(Persisted):
    """A defect of the frames that were analysed.

    Attributes:
        kind: one of :data:`FINDING_KINDS`.
        spans: the frames that are affected: of a duplicate or a cut, the two frames of its step.
        per_mille: of duplicates and cuts, the share of the steps from frame to frame; otherwise of the frames.
        text: what was found, for the user.
        sides: the widest bars; None for other kinds.
    """

    kind: str
    spans: Spans
    per_mille: int
    text: str
    sides: Sides | None = None

    def touches(self, first: int, end: int) -> bool:
        """Return whether one of the frames first .. end - 1 is affected; of a step, both its frames."""
        if self.kind in (DUPLICATES, CUTS):
            return any(first <= low and high <= end for low, high in self.spans)
        return any(low < end and high > first for low, high in self.spans)


def defects_of(scene: Scene) -> tuple[Defect, ...]:
    """Return at most one defect of each kind, from the analysis of a video from its first frame on."""
    firsts, ends, flags = firsts_of(scene.pieces, 0), scene.pieces["end"], scene.pieces["flags"]
    found = []
    repeats = np.repeat((flags & Flag.REPEAT) != 0, ends - firsts)
    if pairs := _steps(np.flatnonzero(repeats)):
        share = 1000 * len(pairs) // (scene.end - 1)
        text = f"{_percent(share)} of the frames repeat the one before ({pattern_of(repeats[1:])})"
        found.append(Defect(DUPLICATES, pairs, share, text))
    if cuts := _steps(np.array(scene.shot_boundaries, np.int64)):
        found.append(Defect(CUTS, cuts, 1000 * len(cuts) // (scene.end - 1), f"hard cuts or jumps: {len(cuts)}"))
    sides = sides_of(scene.pieces)
    if spans := runs_of(np.repeat(sides.any(axis=1), ends - firsts), 1):
        widest = Sides(*sides.max(axis=0).tolist())
        found.append(_stretch(scene, BARS, spans, f"have bars: {_sides(widest)}", widest))
    for kind, (flag, effect) in _FLAGS.items():
        if spans := runs_of(np.repeat((flags & flag) != 0, ends - firsts), 1):
            found.append(_stretch(scene, kind, spans, effect))
    still = np.repeat((flags & Flag.STILL) != 0, ends - firsts)
    noise = np.repeat(scene.values(0, scene.end)[:, NOISE], SEGMENT_FRAMES)[: scene.end]
    if noisy := runs_of(still & (noise >= _NOISY_LEVELS), 1):
        found.append(_stretch(scene, NOISY, noisy, "are still, with noise that fires events"))
    return tuple(found)


def _steps(later: np.ndarray[tuple[int], np.dtype[np.int64]]) -> Spans:
    return tuple((at - 1, at + 1) for at in later.tolist())


def _stretch(scene: Scene, kind: str, spans: Spans, effect: str, sides: Sides | None = None) -> Defect:
    share = 1000 * sum(end - first for first, end in spans) // scene.end
    return Defect(kind, spans, share, f"{_percent(share)} of the frames {effect}", sides)


def _percent(per_mille: int) -> str:
    return f"{(per_mille + 5) // 10}%"


def _sides(sides: Sides) -> str:
    return ", ".join(f"{name} {depth} px" for name, depth in zip(Sides._fields, sides, strict=True) if depth)


_MOST_VIDEOS = 12
SECONDS_OF_EACH = 8
_MOST_FRAMES = 400
_ASSUMED_RATE = 30.0
"""Frames a second where the rate is unknown."""
_LONGEST_SECONDS = 60.0
"""After this time no other video is begun."""
_LONGEST_VIDEO_SECONDS = 30.0
_MOST_NAMED = 100
_HIDING = frozenset({DUPLICATES, COMBED})
"""Defects from which no motion can be told."""
_SERVED_VIDEOS = 4
"""Videos that a server looks at."""
_SERVER_WAITS_SECONDS = 20.0
"""Time from the start of a server, which its first samples have for themselves."""
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
T = TypeVar("T")
_AUTO = "v2v-serve --scene auto"
CHANGES = {
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
class Excerpt(Persisted):
    """The part of a video that is looked at, in the rows that are used."""

    id: str
    index: FrameIndex
    start: int
    count: int
    window: PixelRect
    remark: str

    @property
    def request(self) -> ClipRequest:
        """Return what reads its frames."""
        return ClipRequest(self.index, self.start, (Cut(self.count, self.window),))


class _Found(NamedTuple):
    """An excerpt: its frames that decode, their defects, what the video's levels mean; or why no frame decodes."""

    excerpt: Excerpt
    frames: int = 0
    defects: tuple[Defect, ...] = ()
    signal: Signal = SDR
    problem: str = ""


def name_all(items: Sequence[object]) -> str:
    """Return the texts of the first hundred items in one line, and the number of the others."""
    more = len(items) - _MOST_NAMED
    return "; ".join(map(str, items[:_MOST_NAMED])) + (f"; and {more} more" if more > 0 else "")


def hides_motion(defects: Iterable[Defect], can_be_followed: bool = True) -> bool:
    """Return whether defects are what changes between frames, so that what moves cannot be told.

    Args:
        can_be_followed: whether motion explains the frames all the same.
    """
    hiding = _HIDING if can_be_followed else _HIDING | {CUTS, FADES}
    return any(each.kind in hiding for each in defects)


def defects_of_video(catalogue: Catalogue, id: str) -> tuple[Defect, ...]:
    """Return the defects in the middle of a video, in this process; none where it does not decode."""
    (video,) = (video for video in catalogue.videos if video.id == id)
    _, defects, _, _ = _look_at(catalogue.source, excerpt_of(catalogue, video))
    return defects


def look_at_pictures(
    catalogue: Catalogue, frames_needed: int
) -> Generator[tuple[str, str, str, str], None, dict[str, tuple[Defect, ...]]]:
    """Look for defects in some videos of a local corpus, in bounded time, and yield lines of the report.

    Args:
        frames_needed: frames of a sequence.

    Returns:
        the defects that were found, by id.
    """
    if not (catalogue.source.is_local and catalogue.kind.has_scenes):
        why = (
            f"{catalogue.kind.name} have no such defects"
            if catalogue.source.is_local
            else "these videos lie on another host"
        )
        yield "ok", "pictures", f"not looked at: {why}", ""
        return {}
    looked = _found(catalogue.source, spread_excerpts(catalogue, _MOST_VIDEOS, _LONGEST_SECONDS), usable_cores())
    looked = Progress.over("looking at pictures", "videos", looked, min(_MOST_VIDEOS, len(catalogue.videos)))
    results = sorted(looked, key=lambda each: each.excerpt.id)
    found, sequences = [each for each in results if each.frames], _sequences_of(results, frames_needed)
    text = f"looked at {len(found)} of {len(catalogue.videos)} videos, at most {SECONDS_OF_EACH} s and "
    text += f"{_MOST_FRAMES} frames of each: {counted(len(sequences), 'sequence')}"
    if failed := [f"{each.excerpt.id}: {each.problem}" for each in results if not each.frames]:
        text += f"; {len(failed)} more did not decode ({name_all(failed)})"
    yield "ok", "pictures", text, ""
    for kind, effect in _EFFECTS.items():
        named = [
            f"{each.excerpt.id}: {defect.text}" for each in found for defect in each.defects if defect.kind == kind
        ]
        count = _affected(sequences, kind)
        if count:
            share = f"{count} of {len(sequences)} sequences ({100 * count // len(sequences)}%)"
            yield "note", "pictures", f"{share} have {effect} ({name_all(named)})", CHANGES[kind]
    if varying := [each.excerpt.id for each in found if _has_variable_rate(each.excerpt)]:
        text = f"{len(varying)} of {len(found)} videos have a variable rate ({name_all(varying)})"
        change = "recipes that state times use the time stamps; a bin of frames then lasts differently long"
        yield "note", "pictures", text, change
    if stated := [
        f"{each.excerpt.id}: {each.signal}"
        for each in found
        if each.signal != SDR and DOLBY_VISION not in each.excerpt.remark
    ]:
        text = f"{len(stated)} of {len(found)} videos have other levels than {SDR} ({name_all(stated)})"
        yield (
            "note",
            "pictures",
            text,
            "v2v-serve --set light=declared uses them, up to 12 bits; otherwise they are read as 8-bit SDR",
        )
    return {each.excerpt.id: each.defects for each in found}


def check_in_background(
    catalogue: Catalogue, spec: StreamSpec, stop: threading.Event, say: Callable[[str], object], processes: int = 1
) -> threading.Thread | None:
    """Look for defects in a few videos of a local corpus while a server serves it, and say once what is found.

    Args:
        spec: of the server; nothing is looked at with scene "auto".
        stop: set when the server ends.
        say: called in the thread with a line of text; not called if nothing is found.
        processes: of :func:`v2v_server.system.isolate.run_isolated`.

    Returns:
        the thread; None where nothing is looked at, as for a corpus on another host.
    """
    if spec.scene != "off" or not (catalogue.source.is_local and catalogue.kind.has_scenes):
        return None
    excerpts = list(
        spread_excerpts(catalogue, _SERVED_VIDEOS, _LONGEST_SECONDS)
    )  # here: the index is open in this thread only

    def check() -> None:
        if stop.wait(_SERVER_WAITS_SECONDS):
            return
        results = list[_Found]()
        try:
            for each in _found(catalogue.source, excerpts, processes):
                if stop.is_set():
                    return
                results.append(each)
        except (OSError, V2VError) as error:
            say(f"pictures: not looked at: {error}")
            return
        sequences = _sequences_of(results, spec.recipe.frames_needed)
        shares = [
            f"{100 * count // len(sequences)}% have {effect}"
            for kind, effect in _EFFECTS.items()
            if (count := _affected(sequences, kind))
        ]
        if shares:
            say(
                f"pictures: of {counted(len(sequences), 'sequence')} of {counted(len(results), 'video')}, "
                f"{', '.join(shares)}: "
                "--scene auto leaves these out; v2v-doctor --videos names the videos"
            )

    thread = threading.Thread(target=check, name="picture check", daemon=True)
    thread.start()
    return thread


def spread_excerpts(catalogue: Catalogue, most: int, seconds: float, frames: int | None = None) -> Iterator[Excerpt]:
    """Yield the middle of some videos, spread over the catalogue, for a limited time.

    Args:
        frames: see :func:`excerpt_of`.
    """
    begun, videos = time.monotonic(), catalogue.videos
    many = min(most, len(videos))
    for video in (videos[at * len(videos) // many] for at in range(many)):
        if time.monotonic() - begun > seconds:
            return
        with suppress(V2VError):  # reported with the other checks of this corpus
            yield excerpt_of(catalogue, video, frames)


def excerpt_of(catalogue: Catalogue, video: VideoEntry, frames: int | None = None) -> Excerpt:
    """Return the middle of a video.

    Args:
        frames: most frames; None takes those of some seconds.
    """
    index, rate = catalogue.frame_index(video.id), video.frames_per_second
    rate = rate if rate and math.isfinite(rate) else _ASSUMED_RATE
    count = max(1, min(len(index), frames or min(_MOST_FRAMES, round(SECONDS_OF_EACH * rate))))
    start = (len(index) - count) // 2 if index.seekable else 0
    top, bottom = catalogue.rows.bounds(index.height_px)
    return Excerpt(video.id, index, start, count, (top, 0, bottom - top, index.width_px), video.remark)


def examine(
    look: Callable[[VideoSource, Excerpt], T],
    source: VideoSource,
    excerpts: Iterable[Excerpt],
    processes: int,
    seconds: float,
) -> Iterator[tuple[Excerpt, T | Died]]:
    """Yield what ``look`` returns of each excerpt, in processes that a video may take down, for at most ``seconds``."""
    return run_isolated(
        partial(look, source), excerpts, processes, lambda job: seconds, 2 * LARGEST_PROBE_BYTES, compile_cache()
    )


def _found(source: VideoSource, excerpts: Iterable[Excerpt], processes: int) -> Iterator[_Found]:
    """Yield what was found in each video; no frames where it does not decode in time."""
    for excerpt, result in examine(_look_at, source, excerpts, processes, _LONGEST_VIDEO_SECONDS):
        yield _Found(excerpt, problem=result.how) if isinstance(result, Died) else _Found(excerpt, *result)


def _look_at(source: VideoSource, excerpt: Excerpt) -> tuple[int, tuple[Defect, ...], Signal, str]:
    """Return the number of frames, their defects, and what their levels mean; why where they do not decode."""
    # Import lazily: the process that draws up the report needs no OpenCV.
    from v2v_server.corpus.scenes.analysis import analyse

    try:
        with source.open_pixels(excerpt.id, "") as pixels:
            scene = analyse(picture.grey for picture in pixels.pictures(excerpt.request))
            signal = signal_of(pixels, excerpt.index)
    except V2VError as error:
        return 0, (), SDR, getattr(error, "reason", str(error))
    return scene.end, defects_of(scene), signal, ""


def _has_variable_rate(excerpt: Excerpt) -> bool:
    """Return whether a twentieth of the steps lasts a tenth longer or shorter than the median."""
    steps = np.diff(excerpt.index.seconds(excerpt.start, excerpt.count))
    if not len(steps) or np.isnan(steps).any():
        return False
    return bool(20 * np.count_nonzero(np.abs(steps / np.median(steps) - 1) > 0.1) > len(steps))


def _sequences_of(results: Iterable[_Found], needed: int) -> list[tuple[_Found, tuple[int, int]]]:
    """Return the sequences of the excerpts that decode; an excerpt shorter than a sequence counts as one."""
    return [
        (each, (first, first + min(each.frames, needed)))
        for each in results
        if each.frames
        for first in range(0, each.frames - min(each.frames, needed) + 1, min(each.frames, needed))
    ]


def _affected(sequences: list[tuple[_Found, tuple[int, int]]], kind: str) -> int:
    """Return the number of sequences with a defect of a kind."""
    return sum(any(each.kind == kind and each.touches(*span) for each in found.defects) for found, span in sequences)

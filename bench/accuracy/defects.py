"""Measure which defects of videos scene "auto" finds, and which it finds where there are none.

    python -m bench defects --videos DIR --json defects.json

Twelve defects are made of clean clips of the videos, 320 px wide, and coded at two bit rates; so are the clean clips
themselves. Clips that are dark, or in which little moves (median below 0.4 px a frame), are left out: a bar, a field or
a frame more makes no difference there. Short ones are played to and fro. A defect is found if its kind is, at the right
place: four fifths of the repeats (half of the random ones), each cut or jump, most frames of a fade or still stretch,
bars to 2 px.

The clips' sequences of 16 frames are simulated (c = 0.2, no noise) with scene "off" and "auto", and compared with the
film before defects and coding, in each pixel and step. A converted rate or twos are compared with evenly paced
pictures, a fade with the film at full light, a cut with none. "false": events that the film lacks, as a share of all;
"missing": those of the film that the clip lacks. The row "clean" is what the coder does.

At last, the paper's cameras (8 voxel grids) look at the videos with growing shares of crops drawn by motion.

Bar: at least 95 % of the defects are found. A jump over 50 frames of a shot and a single repeat do not count: where
little moves, the pixels do not show them.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from bench.accuracy.false_events import SCENES, Film, between, compared, noisy_samples, sequences
from bench.frame import Column, Report, add_videos, add_whole, progress
from tests.clips import write_clip
from tests.oracles.decoded import stream_luma
from tests.oracles.rendered import Reals
from v2v_protocol.command import Parser
from v2v_protocol.errors import UsageError, VideoError
from v2v_server.corpus.scenes.analysis import analyse
from v2v_server.corpus.scenes.picture_check import BARS, COMBED, CUTS, DUPLICATES, FADES, STILL, Defect, defects_of
from v2v_server.corpus.scenes.scene import MOTION, Scene
from v2v_server.video.probe import probe
from v2v_server.worker.scene_choice import CleanFrames

LEAST_FOUND = 0.95
FRAMES = 120
_WIDTH = 320
_LEAST_MOTION_PX = 0.4
_LEAST_LEVEL = 16
_MOST_FRAMES = 300
"""Frames of each video that are read."""
_BIT_RATES = {"fine": ({"crf": "20"}, 2), "coarse": ({"crf": "34"}, 0)}
"""Options of the encoder, and B-frames."""
_BARS = {"letterbox": (24, 24, 0, 0), "pillarbox": (0, 0, 40, 40)}
_STILL = 40, 80
_STILL_SOURCE = np.r_[:40, [40] * 40, 40:80]


def _dropped(film: Film, seed: int) -> npt.NDArray[np.int64]:
    """Return the frames of a camera that drops eight and repeats the ones before."""
    at = np.arange(FRAMES)
    at[np.random.default_rng(seed).choice(np.arange(2, FRAMES - 2, 3), 8, replace=False)] -= 1
    return at


def _faded(film: Film, seed: int) -> Film:
    """Fade out and in again, in half a second to two at 30 frames a second."""
    length = (15, 30, 45)[seed % 3]
    gain = np.interp(np.arange(FRAMES), (55 - length, 55, 65, 65 + length), (1, 0, 0, 1))
    return np.rint(film * gain[:, None, None]).astype(np.uint8)


def _within(film: Film, sides: tuple[int, int, int, int]) -> Film:
    """Return a film without its sides: top, bottom, left and right."""
    top, bottom, left, right = sides
    return film[:, top : film.shape[1] - bottom, left : film.shape[2] - right]


def _boxed(film: Film, sides: tuple[int, int, int, int]) -> Film:
    return np.pad(_within(film, sides), ((0, 0), sides[:2], sides[2:]))


def _woven(film: Film) -> Film:
    woven = film[:-2].copy()
    woven[:, 1::2] = film[2:, 1::2]
    return woven[::2]


class Made(NamedTuple):
    """A defect.

    Attributes:
        kind: what is to be found.
        change: returns the clip from a clean one, one of another scene, and a seed.
        source: which frame of the film each frame of the clip is taken for.
    """

    kind: str
    change: Callable[[Film, Film, int], Film]
    source: npt.NDArray[np.int64] = np.arange(FRAMES)

    @classmethod
    def repeats(cls, source: npt.NDArray[np.int64]) -> Made:
        """Return the repeats of a converted rate."""
        return cls(DUPLICATES, lambda film, other, seed: film[source], source)


_CUTS = {"cuts": (50, 90), "jump": (35,)}
_JUMP = np.r_[:35, 85:FRAMES]
_UNSURE = frozenset({"jump", "single repeat"})
"""Defects that do not count for the bar."""
_RATES = ("24 in 30", "3:2 pulldown", "twos")
MADE = {
    "clean": Made("", lambda film, other, seed: film),
    "24 in 30": Made.repeats(np.arange(FRAMES) * 4 // 5),
    "3:2 pulldown": Made.repeats(np.arange(FRAMES) * 2 // 5),
    "twos": Made.repeats(np.arange(FRAMES) // 2),
    "random drops": Made(DUPLICATES, lambda film, other, seed: film[_dropped(film, seed)]),
    "cuts": Made(CUTS, lambda film, other, seed: np.concatenate((film[:50], other[:40], film[90:]))),
    "jump": Made(CUTS, lambda film, other, seed: film[_JUMP], _JUMP),
    "single repeat": Made.repeats(np.r_[:60, 59 : FRAMES - 1]),
    "fades": Made(FADES, lambda film, other, seed: _faded(film, seed)),
    "letterbox": Made(BARS, lambda film, other, seed: _boxed(film, _BARS["letterbox"])),
    "pillarbox": Made(BARS, lambda film, other, seed: _boxed(film, _BARS["pillarbox"])),
    "still": Made(STILL, lambda film, other, seed: film[_STILL_SOURCE], _STILL_SOURCE),
    "combing": Made(COMBED, lambda film, other, seed: _woven(film), np.arange(0, FRAMES, 2)),
}


def _is_there(name: str, film: Film, seed: int, found: Defect | None) -> bool:
    """Return whether a defect is found where it was made."""
    if found is None:
        return False
    if found.kind == BARS:
        return found.sides is not None and np.abs(np.subtract(found.sides, _BARS[name])).max() <= 2
    if found.kind == CUTS:
        return {at + 1 for at, _ in found.spans} == set(_CUTS[name])
    frames = {frame for first, end in found.spans for frame in range(first, end)}
    if found.kind == DUPLICATES:
        source = _dropped(film, seed) if name == "random drops" else MADE[name].source
        made, said = set(np.flatnonzero(np.diff(source) == 0).tolist()), {at for at, _ in found.spans}
        return len(made & said) >= (0.5 if name == "random drops" else 0.8) * len(made | said)
    expected = {STILL: set(range(*_STILL)), FADES: set(range(50, 54)) | set(range(67, 71))}.get(found.kind, set())
    return 5 * len(frames & expected) >= 4 * len(expected)


def coded(film: Film, rate: str, folder: Path) -> Film:
    """Return a film after coding."""
    options, b_frames = _BIT_RATES[rate]
    path = write_clip(
        folder / "clip.mp4", film, gop=48, b_frames=b_frames, options={**options, "preset": "veryfast"}, rate=30,
        full_range=True,
    )  # fmt: skip
    return np.stack(list(stream_luma(path, probe(path).index, 0, len(film))))


def _original(name: str, film: Film, made: Film, frames: CleanFrames) -> Reals:
    """Return the log intensities that frames of a clip have in the clean film."""
    numbers = frames.numbers
    positions = MADE[name].source[numbers].astype(np.float64)
    if name in _RATES:
        positions = np.linspace(positions[0], positions[-1], len(positions))
    levels = between(_within(made if name == "cuts" else film, frames.sides), positions)
    for cut in _CUTS.get(name, ()):
        if 0 < (first := int(numbers.searchsorted(cut))) < len(numbers):
            levels[first:] -= levels[first] - levels[first - 1]
    return levels


def _false_events(
    name: str, films: Sequence[Film], made: Sequence[Film], clips: Sequence[Film], scenes: Sequence[Scene]
) -> dict[str, Any]:
    """Return the events that clips have and lack beside their originals, with scene "off" and "auto"."""
    record: dict[str, Any] = {}
    for scene in SCENES:
        counts, served = np.zeros(4), 0
        for number, frames in sequences(clips, scenes, scene):
            shown = _within(clips[number][frames.numbers], frames.sides)
            counts += compared(np.ascontiguousarray(shown), _original(name, films[number], made[number], frames))
            served += 1
        events, false, wanted, missing = counts.tolist()
        record |= {f"sequences_{scene}": served, f"false_{scene}_share": false / events if events else None,
                   f"missing_{scene}_share": missing / wanted if wanted else None}  # fmt: skip
    return record


def _resized(film: Film, like: Film) -> Film:
    return cv2.resize(film.transpose(1, 2, 0), like.shape[:0:-1]).transpose(2, 0, 1).astype(np.uint8)


def films(folder: Path) -> Iterator[tuple[str, list[Film]]]:
    """Yield name and small films without defects of each video that decodes."""
    for path in sorted(folder.iterdir()):
        try:
            index = probe(path).index
            pictures = np.stack(list(stream_luma(path, index, 0, min(len(index), _MOST_FRAMES))))
        except VideoError as error:
            progress(f"left out: {error}")
            continue
        height = _WIDTH * pictures.shape[1] // pictures.shape[2] // 2 * 2
        small = [cv2.resize(picture, (_WIDTH, height), interpolation=cv2.INTER_AREA) for picture in pictures]
        rounds = FRAMES // len(small) + 1
        to_and_fro = np.array(small if len(small) >= FRAMES else [*small, *small[-2:0:-1]] * rounds, np.uint8)
        parts = [to_and_fro[:FRAMES], *([to_and_fro[-FRAMES:]] if len(small) >= 2 * FRAMES else [])]
        yield path.name, [part for part in parts if _is_suited(part)]


def _is_suited(film: Film) -> bool:
    scene = analyse(film)
    moves = np.nanmedian(scene.values(0, FRAMES)[:, MOTION]) >= _LEAST_MOTION_PX
    return bool(not defects_of(scene) and moves and film.mean() >= _LEAST_LEVEL)


_CASES: tuple[Column, ...] = (
    ("made", "defect", "{}", 1),
    ("cases", "cases", "{:.0f}", 1),
    ("found", "found", "{:.0f}", 1),
    ("others_found", "others found", "{}", 1),
    ("missed", "missed in", "{}", 1),
)
_EVENTS: tuple[Column, ...] = (
    ("made", "events", "{}", 1),
    ("bit_rate", "bits", "{}", 1),
    ("false_off_share", "false: off", "{:.1%}", 1),
    ("false_auto_share", "auto", "{:.1%}", 1),
    ("missing_off_share", "missing: off", "{:.1%}", 1),
    ("missing_auto_share", "auto", "{:.1%}", 1),
    ("sequences_off", "sequences: off", "{}", 1),
    ("sequences_auto", "auto", "{}", 1),
)
_NOISE: tuple[Column, ...] = (
    ("moving_share", "moving_share", "{:g}", 1),
    ("quiet_share", "quiet_share", "{:g}", 1),
    ("samples", "samples", "{}", 1),
    ("noisy_share", "mostly noise", "{:.1%}", 1),
)


def add_flags(parser: Parser) -> None:
    """Add the bench's flags."""
    add_videos(parser, "real videos")
    add_whole(parser, "--clips", 10, "clips to make defects of; 0: look for noise only", least=0)
    add_whole(parser, "--samples", 120, "samples of the videos to look for noise in; 0: none", least=0)
    parser.add_argument("--only-find", action="store_true", help="count what is found, and simulate nothing")


def measure(asked: argparse.Namespace) -> Report:
    """Run the bench.

    Raises:
        UsageError: fewer than four clips are clean and move.
    """
    named = films(asked.videos) if asked.clips else ()
    parts_of = [(number, name, film) for name, parts in named for number, film in enumerate(parts)]
    clips = [(name, film) for _, name, film in sorted(parts_of, key=lambda each: each[:2])[: asked.clips]]
    if asked.clips > 0 and len(clips) < 4:
        raise UsageError(f"--videos {asked.videos}: {len(clips)} videos are clean and move; give four")
    records: list[dict[str, Any]] = []
    false: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as folder:
        for name, (kind, change, _) in MADE.items() if clips else ():
            said, missed = list[str](), list[str]()
            made = [change(film, _resized(clips[seed - 3][1], film), seed) for seed, (_, film) in enumerate(clips)]
            for rate in _BIT_RATES:
                pictures = [coded(each, rate, Path(folder)) for each in made]
                scenes = [analyse(each) for each in pictures]
                for seed, ((video, film), scene) in enumerate(zip(clips, scenes, strict=True)):
                    found = {each.kind: each for each in defects_of(scene)}
                    said += [f"{each} {video} {rate}" for each in found.keys() - {kind}]
                    if kind and not _is_there(name, film, seed, found.get(kind)):
                        missed.append(f"{video} {rate}")
                if not asked.only_find:
                    events = _false_events(name, [film for _, film in clips], made, pictures, scenes)
                    false.append({"measure": "events", "made": name, "bit_rate": rate} | events)
            cases = len(clips) * len(_BIT_RATES)
            records.append(
                {"measure": "made", "made": name, "cases": cases, "found": cases - len(missed) if kind else None,
                 "others_found": len(said), "others": ", ".join(said), "missed": ", ".join(missed)}
            )  # fmt: skip
            progress(f"{name}: missed {len(missed)} of {cases}; others {said}; {missed}; {false[-2:]}")
    counted = [each for each in records if each["found"] is not None and each["made"] not in _UNSURE]
    share = sum(each["found"] for each in counted) / sum(each["cases"] for each in counted) if clips else 1.0
    lines = [f"{share:.1%} of the defects are found"] if clips else []
    bars = [] if share >= LEAST_FOUND else [f"{share:.1%} of the defects are found; the bar is {LEAST_FOUND:.0%}"]
    noise = noisy_samples(asked.videos, asked.samples) if asked.samples and not asked.only_find else []
    tables = [(records, _CASES), (false, _EVENTS), (noise, _NOISE)]
    return Report([*records, *false, *noise], tables, lines, bars)

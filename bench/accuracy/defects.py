"""Measure which defects of videos scene "auto" finds, and which it finds where there are none.

    python -m bench defects --videos DIR --json defects.json

Ten defects are made of clean clips of the videos, 320 px wide, and coded at two bit rates; so are the clean clips
themselves. Clips that are dark, or in which little moves (median below 0.4 px a frame), are left out: a bar, a field or
a frame more makes no difference there. Short ones are played to and fro. A defect is found if its kind is, at the right
place: four fifths of the repeats (half of the random ones), each cut, most frames of a fade or still stretch, bars to
2 px. Then the first frames of the videos as they are are analysed, and what is found is listed, to be checked by eye.

Bar: at least 95 % of the defects are found.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from bench.frame import Column, Report, add_videos, add_whole, progress
from tests.clips import write_clip
from v2v_protocol.command import Parser
from v2v_protocol.errors import UsageError, VideoError
from v2v_server.corpus.scenes.analysis import analyse
from v2v_server.corpus.scenes.findings import BARS, COMBED, CUTS, DUPLICATES, FADES, STILL, Defect, defects_of
from v2v_server.corpus.scenes.scene import MOTION
from v2v_server.video.decode import stream_luma
from v2v_server.video.probe import probe

LEAST_FOUND = 0.95
FRAMES = 120
_WIDTH = 320
_LEAST_MOTION_PX = 0.4
_LEAST_LEVEL = 16
_LOOKED_AT = 300
"""Frames of each video as it is."""
_BIT_RATES = {"fine": ({"crf": "20"}, 2), "coarse": ({"crf": "34"}, 0)}
"""Options of the encoder, and B-frames."""
_BARS = {"letterbox": (24, 24, 0, 0), "pillarbox": (0, 0, 40, 40)}
_STILL = 40, 80
Film = npt.NDArray[np.uint8]


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


def _boxed(film: Film, sides: tuple[int, int, int, int]) -> Film:
    top, bottom, left, right = sides
    return np.pad(film[:, top : film.shape[1] - bottom, left : film.shape[2] - right], ((0, 0), sides[:2], sides[2:]))


def _woven(film: Film) -> Film:
    woven = film[:-2].copy()
    woven[:, 1::2] = film[2:, 1::2]
    return woven[::2]


MADE: dict[str, tuple[str, Callable[[Film, Film, int], Film]]] = {
    "24 in 30": (DUPLICATES, lambda film, other, seed: film[np.arange(FRAMES) * 4 // 5]),
    "3:2 pulldown": (DUPLICATES, lambda film, other, seed: film[np.arange(FRAMES) * 2 // 5]),
    "twos": (DUPLICATES, lambda film, other, seed: film[np.arange(FRAMES) // 2]),
    "random drops": (DUPLICATES, lambda film, other, seed: film[_dropped(film, seed)]),
    "cuts": (CUTS, lambda film, other, seed: np.concatenate((film[:50], other[:40], film[80:]))),
    "fades": (FADES, lambda film, other, seed: _faded(film, seed)),
    "letterbox": (BARS, lambda film, other, seed: _boxed(film, _BARS["letterbox"])),
    "pillarbox": (BARS, lambda film, other, seed: _boxed(film, _BARS["pillarbox"])),
    "still": (STILL, lambda film, other, seed: film[np.r_[:40, [40] * 40, 40:80]]),
    "combing": (COMBED, lambda film, other, seed: _woven(film)),
}
"""By name: the kind to find, and how it is made of a clip, a clip of another scene, and a seed."""


def _is_there(name: str, film: Film, seed: int, found: Defect | None) -> bool:
    """Return whether a defect is found where it was made."""
    if found is None:
        return False
    if found.kind == BARS:
        return found.sides is not None and np.abs(np.subtract(found.sides, _BARS[name])).max() <= 2
    if found.kind == CUTS:
        return {at for at, _ in found.spans} == {49, 89}
    frames = {frame for first, end in found.spans for frame in range(first, end)}
    if found.kind == DUPLICATES:
        source = {"24 in 30": np.arange(FRAMES) * 4 // 5, "3:2 pulldown": np.arange(FRAMES) * 2 // 5,
                  "twos": np.arange(FRAMES) // 2}.get(name, _dropped(film, seed))  # fmt: skip
        made, said = set(np.flatnonzero(np.diff(source) == 0).tolist()), {at for at, _ in found.spans}
        return len(made & said) >= (0.5 if name == "random drops" else 0.8) * len(made | said)
    expected = {STILL: set(range(*_STILL)), FADES: set(range(50, 54)) | set(range(67, 71))}.get(found.kind, set())
    return 5 * len(frames & expected) >= 4 * len(expected)


def coded(film: Film, rate: str, folder: Path) -> tuple[Defect, ...]:
    """Return the defects that are found in a film after coding."""
    options, b_frames = _BIT_RATES[rate]
    path = write_clip(
        folder / "clip.mp4", film, gop=48, b_frames=b_frames, options={**options, "preset": "veryfast"}, rate=30,
        full_range=True,
    )  # fmt: skip
    return defects_of(analyse(stream_luma(path, probe(path).index, 0, len(film))))


def films(folder: Path) -> Iterator[tuple[str, list[Film], tuple[Defect, ...]]]:
    """Yield name, small films without defects, and the defects as it is of each video that decodes."""
    for path in sorted(folder.iterdir()):
        try:
            index = probe(path).index
            pictures = np.stack(list(stream_luma(path, index, 0, min(len(index), _LOOKED_AT))))
        except VideoError as error:
            progress(f"left out: {error}")
            continue
        height = _WIDTH * pictures.shape[1] // pictures.shape[2] // 2 * 2
        small = [cv2.resize(picture, (_WIDTH, height), interpolation=cv2.INTER_AREA) for picture in pictures]
        rounds = FRAMES // len(small) + 1
        to_and_fro = np.array(small if len(small) >= FRAMES else [*small, *small[-2:0:-1]] * rounds, np.uint8)
        parts = [to_and_fro[:FRAMES], *([to_and_fro[-FRAMES:]] if len(small) >= 2 * FRAMES else [])]
        yield path.name, [part for part in parts if _is_suited(part)], defects_of(analyse(pictures))


def _is_suited(film: Film) -> bool:
    scene = analyse(film)
    moves = np.nanmedian(scene.values(0, FRAMES)[:, MOTION]) >= _LEAST_MOTION_PX
    return bool(not defects_of(scene) and moves and film.mean() >= _LEAST_LEVEL)


_CASES: tuple[Column, ...] = (
    ("made", "defect", "{}", 1),
    ("cases", "cases", "{:.0f}", 1),
    ("found", "found", "{:.0f}", 1),
    ("others", "others found", "{}", 1),
    ("missed", "missed in", "{}", 1),
)
_REAL: tuple[Column, ...] = (("video", "video as it is", "{}", 1), ("kind", "kind", "{}", 1), ("text", "", "{}", 1))


def add_flags(parser: Parser) -> None:
    """Add the bench's flags."""
    add_videos(parser, "real videos")
    add_whole(parser, "--clips", 10, "clips to make defects of")


def measure(asked: argparse.Namespace) -> Report:
    """Run the bench.

    Raises:
        UsageError: fewer than two videos are clean and long enough.
    """
    parts_of, real = list[tuple[int, str, Film]](), list[dict[str, Any]]()
    for name, parts, defects in films(asked.videos):
        real += [{"measure": "real", "video": name, "kind": each.kind, "text": each.text} for each in defects]
        parts_of += [(number, name, film) for number, film in enumerate(parts)]
    clips = [(name, film) for _, name, film in sorted(parts_of, key=lambda each: each[:2])[: asked.clips]]
    if len(clips) < 4:
        raise UsageError(f"--videos {asked.videos}: {len(clips)} videos are clean and move; give four")
    records: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as folder:
        for made in ("clean", *MADE):
            kind, make = MADE.get(made, ("", lambda film, other, seed: film))
            said, missed = list[str](), list[str]()
            for seed, (name, film) in enumerate(clips):
                other = cv2.resize(clips[seed - 3][1].transpose(1, 2, 0), film.shape[:0:-1]).transpose(2, 0, 1)
                for rate in _BIT_RATES:
                    found = {each.kind: each for each in coded(make(film, other, seed), rate, Path(folder))}
                    said += [f"{each} {name} {rate}" for each in found.keys() - {kind}]
                    if kind and not _is_there(made, film, seed, found.get(kind)):
                        missed.append(f"{name} {rate}")
            cases = len(clips) * len(_BIT_RATES)
            records.append(
                {"measure": "made", "made": made, "cases": cases, "found": cases - len(missed) if kind else None,
                 "others": ", ".join(said), "missed": ", ".join(missed)}
            )  # fmt: skip
            progress(f"{made}: missed {len(missed)} of {cases}; others {said}; {missed}")
    share = sum(each["found"] or 0 for each in records) / (len(MADE) * len(clips) * len(_BIT_RATES))
    lines = [f"{share:.1%} of the defects are found"]
    bars = [] if share >= LEAST_FOUND else [f"{share:.1%} of the defects are found; the bar is {LEAST_FOUND:.0%}"]
    return Report([*records, *real], [(records, _CASES), (real, _REAL)], lines, bars)

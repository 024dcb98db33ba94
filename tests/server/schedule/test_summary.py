"""Test what the operator reads of a corpus."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from tests.server.named_corpus import SMALL, SMALL_SPEC, NamedCorpus, corpus, video
from v2v_protocol.sample import Refusal
from v2v_protocol.spec import StreamSpec
from v2v_server.corpus.catalogue import Catalogue
from v2v_server.corpus.videos import VideoEntry
from v2v_server.corpus_words import corpus_summary, sequence_span
from v2v_server.schedule import SequenceTable
from v2v_server.video.rows import Rows


def lines(catalogue: Catalogue, spec: StreamSpec = SMALL_SPEC) -> list[str]:
    return corpus_summary(catalogue, spec, SequenceTable(catalogue.videos, catalogue.rows, spec))


def test_a_corpus_without_trouble_is_one_line() -> None:
    assert lines(corpus(video("a.mp4"), video("b.mp4", frames=9), rows="top:0.75")) == [
        "2 videos in /corpus, 2 of use: 12 sequences of 5 frames (at most 10 a video), rows top:0.75"
    ]


@pytest.mark.parametrize(
    ("seconds", "made"),
    [
        ((0.001, 0.001), "2 grids of 0.0333 s"),
        ((0.06, 0.06), "2 grids of 0.0667 s"),
        ((0.001, 0.1), "2 grids of 0.0333 to 0.1 s"),
    ],
)
def test_the_duration_of_grids_is_the_one_that_is_made(seconds: tuple[float, float], made: str) -> None:
    recipe = replace(SMALL, frames_per_bin=1, voxel_seconds=seconds)
    catalogue = SimpleNamespace(videos=SimpleNamespace(frames_per_second=np.array([30.0, np.nan])))
    span, more = sequence_span(catalogue, recipe)  # type: ignore[arg-type]
    assert span == made
    if seconds[1] < 1 / 30:
        (warning,) = more
        assert warning.startswith("warning: voxel_seconds = 0.001 is shorter than the time between frames of 1 videos")
        assert "0.0333 s" in warning
    else:
        assert not more


def test_refusals_name_reason_and_remedy() -> None:
    said = lines(corpus(video("a.mp4"), video("short.mp4", frames=4), video("small.mp4", height_px=5)))
    assert said[0].startswith("3 videos in /corpus, 1 of use: 10 sequences")
    assert said[1:] == [
        "2 videos give none under the server's own recipe:",
        "  short.mp4: 4 frames, the recipe needs 5; would admit it: voxels_per_clip at most 1 "
        "(--set voxels_per_clip=1)",
        "  small.mp4: picture 16x5 after rows full, the crop is 8x8; "
        "would admit it: resize_scale up to 1.6, or a smaller crop",
        "  The longest clip that fits has 1 voxel grids. Shorter clips: --set voxels_per_clip=1 admits 1 of them",
    ]


def test_many_refusals_are_counted_and_a_length_of_clip_named_that_admits_them() -> None:
    lengths = (15, 11, 11, 8, 8, 8, 6)  # SMALL spends two bins of one frame on a voxel grid
    shorts: list[VideoEntry] = [video(f"s{number}.mp4", frames) for number, frames in enumerate(lengths)]
    spec = replace(SMALL_SPEC, recipe=replace(SMALL, voxels_per_clip=10))
    said = lines(corpus(*shorts, video("still.mp4", frames=1), video("good.mp4")), spec)
    assert said[1] == "8 videos give none under the server's own recipe:"
    assert said[-2] == "  ... and 3 more: --list-refused names all"
    assert len(said) == 2 + 5 + 2
    # The middle one of those seven has room for three voxel grids, and all of them for two.
    assert said[-1] == (
        "  The longest clip that fits has 7 voxel grids. Shorter clips: --set voxels_per_clip=3 admits 6 of them, "
        "--set voxels_per_clip=2 admits 7 of them"
    )


def test_files_that_cannot_be_used_are_named() -> None:
    problems = tuple(Refusal(f"p{number}.mp4", None, "has no video track") for number in range(7))
    named = NamedCorpus((video("a.mp4"),), Rows(), problems, Path("/elsewhere"))
    said = lines(named)  # type: ignore[arg-type]
    assert said[0].startswith("1 video in /elsewhere, 1 of use: 10 sequences")
    assert said[1:] == [
        "7 files cannot be used at all:",
        *(f"  p{number}.mp4: has no video track" for number in range(5)),
        "  ... and 2 more: --list-refused names all",
    ]
    table = SequenceTable(named.videos, named.rows, SMALL_SPEC)
    every = corpus_summary(named, SMALL_SPEC, table, list_refused=True)  # type: ignore[arg-type]
    assert every[2:] == [f"  p{number}.mp4: has no video track" for number in range(7)]

"""Pieces of videos: encoded, in columns, and clipped."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from tests.pieces import pieces
from v2v_server.corpus.scenes.scene import (
    NO_BARS,
    Flag,
    Pieces,
    Sides,
    SplitVideos,
    clip_pieces,
    encoded_pieces,
    firsts_of,
)

TELLING = Flag.CUT | Flag.REPEAT | Flag.FADE | Flag.COMBED
SIDES = st.sampled_from([NO_BARS, Sides(2, 4, 0, 0)])


@st.composite
def videos(draw: st.DrawFn) -> tuple[int, Pieces]:
    """Draw the frames of a video and the pieces of the part that was analysed."""
    ends = sorted(draw(st.sets(st.integers(1, 40), max_size=6)))
    drawn = pieces(*((end, draw(st.integers(0, 127)), draw(SIDES)) for end in ends))
    return draw(st.integers(1, 50)), draw(st.sampled_from([drawn, pieces()]))


def by_frame(part: Pieces, first: int) -> list[tuple[int, ...]]:
    """Return flags (a cut at its frame only) and bars of each frame."""
    found = []
    for low, (end, flags, *sides) in zip(firsts_of(part, first).tolist(), part.tolist(), strict=True):
        found += [(flags if frame == low else flags & ~Flag.CUT, *sides) for frame in range(low, end)]
    return found


@given(videos(), st.integers(0, 45), st.integers(1, 20))
def test_clipped_pieces_say_the_same_of_each_frame(drawn: tuple[int, Pieces], start: int, count: int) -> None:
    _, whole = drawn
    seen = by_frame(whole, 0)
    spoilt = any(flags & TELLING or any(sides) for flags, *sides in seen)
    all_frames = [*seen, *[(Flag.UNSEEN if spoilt else 0, *NO_BARS)] * 70]
    assert by_frame(clip_pieces(whole, 0, start, start + count), start) == all_frames[start : start + count]


@given(st.lists(videos()))
def test_columns_hold_the_pieces_of_the_videos_that_are_divided(drawn: list[tuple[int, Pieces]]) -> None:
    encoded = [encoded_pieces(each, frames) for frames, each in drawn]
    for (frames, each), one in zip(drawn, encoded, strict=True):
        said = set(by_frame(clip_pieces(each, 0, 0, frames), 0))
        assert bool(one) == (said != {(0, *NO_BARS)} or len(clip_pieces(each, 0, 0, frames)) > 1)
    split = SplitVideos.of(encoded)
    assert split.numbers.tolist() == [number for number, one in enumerate(encoded) if one]
    assert [split.encoded(number) for number in range(len(drawn))] == encoded
    assert split.firsts().tolist() == [
        first for frames, each in drawn if encoded_pieces(each, frames)
        for first in firsts_of(clip_pieces(each, 0, 0, frames), 0).tolist()
    ]  # fmt: skip
    part = split.between(1, 3)
    assert [part.encoded(number) for number in (1, 2)] == [*encoded, b"", b"", b""][1:3]
    assert part.bounds.dtype == split.bounds.dtype == split.numbers.dtype == np.int32

"""The runs of all videos in columns say what a tuple for each would say."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from v2v_server.corpus.scenes.runs import Runs, SplitVideos


@st.composite
def videos(draw: st.DrawFn) -> tuple[int, Runs]:
    """Draw the frames of a video and its runs."""
    frames = draw(st.integers(1, 40))
    bounds = sorted(draw(st.sets(st.integers(0, frames), max_size=6)))
    runs = tuple(zip(bounds[::2], bounds[1::2], strict=False))
    return frames, draw(st.sampled_from([runs, ((0, frames),)]))


@given(st.lists(videos()))
def test_runs_of_the_videos_that_are_not_one_run(drawn: list[tuple[int, Runs]]) -> None:
    frames, runs = [frames for frames, _ in drawn], [runs for _, runs in drawn]
    split = SplitVideos.of(frames, runs)
    expected = {number: runs for number, (frames, runs) in enumerate(drawn) if runs != ((0, frames),)}
    assert split.numbers.tolist() == list(expected)
    assert {number: split.runs(number) for number in range(len(drawn)) if split.find(number) is not None} == expected
    assert split.longest().tolist() == [
        max((end - first for first, end in runs), default=0) for runs in expected.values()
    ]
    assert split.owners().tolist() == [at for at, runs in enumerate(expected.values()) for _ in runs]
    assert split.first.dtype == split.end.dtype == split.bounds.dtype == np.int32

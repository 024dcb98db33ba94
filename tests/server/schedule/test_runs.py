"""Sequences of divided videos, against their definition frame by frame."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from tests.pieces import pieces, shots
from v2v_protocol.errors import UsageError
from v2v_protocol.recipe import Recipe
from v2v_protocol.spec import DEFECTS, StreamSpec
from v2v_server.corpus.scenes.runs import Runs
from v2v_server.corpus.scenes.scene import NO_BARS, Flag, Pieces, Sides
from v2v_server.corpus.videos import SplitVideos, VideoEntry, encoded_pieces
from v2v_server.schedule import SequenceTable
from v2v_server.video.rows import Rows

RECIPE = Recipe(voxels_per_clip=4, bins=5, crop_height_px=32, crop_width_px=32)
"""21 frames a sequence, 20 apart."""
AUTO = StreamSpec(recipe=RECIPE, scene="auto", still_share=1.0)
BARS = Sides(8, 8, 0, 0)
SKIPPED = {
    Flag.FADE: "fades", Flag.BLACK: "black", Flag.WHITE: "white", Flag.COMBED: "combed", Flag.UNSEEN: "cuts",
}  # fmt: skip
TELLING = Flag.CUT | Flag.REPEAT | Flag.FADE | Flag.COMBED


def video(name: str, frames: int, parts: Pieces | None = None) -> VideoEntry:
    divided = b"" if parts is None else encoded_pieces(parts, frames)
    return VideoEntry(name, "f", frames, 64, 64, 25.0, "h264", pieces=divided)


def starts(table: SequenceTable) -> list[tuple[str, int]]:
    return [(found.video.id, found.start_frame) for found in map(table.__getitem__, range(table.count))]


def expected(parts: Pieces, frames: int, spec: StreamSpec) -> list[int]:
    """Collect runs frame by frame, and return where sequences begin."""
    kept, runs, before, first = spec.kept_defects, [list[int]()], None, 0
    spoilt = any(flags & TELLING or any(bars) for _, flags, *bars in parts.tolist())
    for end, flags, *bars in [*parts.tolist(), (frames, Flag.UNSEEN if spoilt else 0, *NO_BARS)]:
        sides = list(NO_BARS) if "bars" in kept else bars
        if first < end and ((flags & Flag.CUT and "cuts" not in kept) or sides != (before or sides)):
            runs.append([])
        for frame in range(first, end):
            before = sides
            if any(flags & flag and kind not in kept for flag, kind in SKIPPED.items()):
                runs.append([])
            elif not (flags & Flag.REPEAT and "duplicates" not in kept):
                runs[-1].append(frame)
        first = end
    found = [run[at] for run in runs for at in range(0, len(run) - 20, 20)]
    return found[: spec.max_sequences_per_video]


@st.composite
def divided(draw: st.DrawFn) -> Pieces:
    ends = sorted(draw(st.sets(st.integers(1, 300), min_size=1, max_size=8)))
    flags = st.sampled_from([0, 0, Flag.CUT, Flag.REPEAT, Flag.REPEAT, Flag.STILL, Flag.QUIET, *SKIPPED])
    return pieces(*((end, draw(flags), draw(st.sampled_from([NO_BARS, NO_BARS, BARS]))) for end in ends))


@given(st.lists(divided(), min_size=1, max_size=3), st.data())
def test_flagged_frames_are_counted_one_by_one(all_parts: list[Pieces], data: st.DataObject) -> None:
    split = SplitVideos.of(encoded_pieces(parts, 300) for parts in all_parts)
    runs = Runs(split, StreamSpec(scene="auto", keep_defects=",".join(DEFECTS)))
    flags = np.repeat(split.pieces["flags"], split.pieces["end"] - split.firsts())
    assume(len(flags))
    first = data.draw(st.integers(0, len(flags) - 1))
    count = data.draw(st.integers(1, len(flags) - first))
    found = runs.flagged(Flag.STILL, np.array([first]), np.array([count]))
    assert found == ((flags[first : first + count] & Flag.STILL) != 0).sum()


@given(st.lists(divided(), min_size=1, max_size=4), st.integers(1, 8), st.sets(st.sampled_from(DEFECTS)))
def test_sequences_are_those_of_each_run(all_parts: list[Pieces], most: int, kept: set[str]) -> None:
    spec = StreamSpec(
        recipe=RECIPE, scene="auto", still_share=1.0, max_sequences_per_video=most, keep_defects=",".join(kept)
    )
    videos = [video(str(number), 300, parts) for number, parts in enumerate(all_parts)]
    table = SequenceTable([*videos, video("whole", 50)], Rows(), spec)
    each = [expected(parts, 300, spec) for parts in all_parts]
    found = [(str(number), start) for number, those in enumerate(each) for start in those]
    assert starts(table) == [*found, *[("whole", 0), ("whole", 20)][:most]]
    places = set(range(0, 280, 20)[:most])
    assert table.spoilt == sum(len(places) - len(places & set(those)) for those in each)
    assert len(table.refusals) == sum(not those for those in each)
    assert all(refusal.remedy for refusal in table.refusals)


def test_what_can_be_done_about_a_video_is_said() -> None:
    videos = (video("short", 60, shots(60, 20, 40)), video("boxed", 61, pieces((61, 0, Sides(20, 20, 0, 0)))),
              video("still", 61, pieces((61, Flag.STILL))))  # fmt: skip
    table = SequenceTable(videos, Rows(), StreamSpec(recipe=RECIPE, scene="auto", still_share=0.0))
    assert [(refusal.reason, refusal.remedy) for refusal in table.refusals] == [
        (
            "at most 20 frames in a row without a defect, the recipe needs 21",
            "voxels_per_clip at most 3 (--set voxels_per_clip=3), or scene off",
        ),
        (
            "picture 64x24 after rows full and without its bars, the crop is 32x32",
            "resize_scale up to 1.334, or a smaller crop",
        ),
        ("all its sequences are still or quiet", "still_share 1 and quiet_share 1"),
    ]
    assert table.count == 0


@pytest.mark.parametrize("share", [0.0, 0.25, 1.0])
def test_a_share_of_the_still_sequences_is_served(share: float) -> None:
    """Still, or still for three quarters; moving ones are all there."""
    parts = pieces((16_000, Flag.STILL), (16_005, 0), (16_020, Flag.STILL), (16_420, 0))
    spec = StreamSpec(recipe=RECIPE, scene="auto", still_share=share, max_sequences_per_video=10_000)
    found = np.array([start for _, start in starts(SequenceTable([video("a", 16_420, parts)], Rows(), spec))])
    assert np.count_nonzero(found > 16_000) == 19
    assert abs(np.count_nonzero(found <= 16_000) - share * 801) <= 50


@pytest.mark.parametrize("share", [0.0, 0.25, 1.0])
def test_a_share_of_the_quiet_sequences_is_served(share: float) -> None:
    """Quiet for half, and not still; what is still is up to still_share alone."""
    quiet, still = Flag.QUIET, Flag.QUIET | Flag.STILL
    parts = pieces((16_000, quiet), (16_011, 0), (16_020, quiet), (16_420, 0), (16_820, still))
    spec = StreamSpec(recipe=RECIPE, scene="auto", still_share=1.0, quiet_share=share, max_sequences_per_video=10_000)
    found = np.array([start for _, start in starts(SequenceTable([video("a", 16_820, parts)], Rows(), spec))])
    assert found[found >= 16_000].tolist() == list(range(16_000, 16_800, 20))
    assert abs(np.count_nonzero(found < 16_000) - share * 800) <= 50


@settings(max_examples=50)
@given(divided(), st.floats(0, 1), st.floats(0, 1))
def test_shares_are_nested(parts: Pieces, one: float, other: float) -> None:
    """A larger share serves all sequences of a smaller one, as far as max_sequences_per_video reaches."""
    few, many, every = (
        set(starts(SequenceTable([video("a", 300, parts)], Rows(), spec)))
        for spec in (
            replace(AUTO, quiet_share=share, max_sequences_per_video=100) for share in (*sorted((one, other)), 1.0)
        )
    )
    assert few <= many <= every


def test_the_rest_of_a_long_video_is_served_if_the_analysed_part_has_no_defects() -> None:
    """Films of many shots would otherwise be served from where they are not analysed."""
    clean, many_cuts = video("a", 5000, shots(4096)), video("b", 5000, shots(4096, *range(15, 4096, 15)))
    spec = replace(AUTO, max_sequences_per_video=1000)
    assert Counter(name for name, _ in starts(SequenceTable([clean, many_cuts], Rows(), spec))) == {"a": 249}
    kept = replace(spec, keep_defects="cuts")
    assert Counter(name for name, _ in starts(SequenceTable([clean, many_cuts], Rows(), kept))) == {"a": 249, "b": 249}


def test_a_catalogue_without_statistics_says_what_to_do() -> None:
    plain = VideoEntry("a", "f", 61, 64, 64, 25.0, "h264")
    with pytest.raises(UsageError, match="--scene auto"):
        SequenceTable((plain,), Rows(), AUTO)
    assert SequenceTable((plain,), Rows(), StreamSpec(recipe=RECIPE)).count == 3

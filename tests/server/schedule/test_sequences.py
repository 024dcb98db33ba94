"""Sequences of videos, lookup by rank, refusals with a remedy that works, and the schedule's candidates."""

from __future__ import annotations

import dataclasses
import itertools
import math
import re
import tracemalloc
from bisect import bisect_right
from typing import Any
from unittest import mock

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.pieces import pieces
from tests.server.named_corpus import SMALL, SMALL_SPEC, video
from v2v_protocol.recipe import MOST_STEPS_PER_GRID, Recipe
from v2v_protocol.spec import StreamSpec
from v2v_server import schedule as sequences
from v2v_server.corpus.scenes.scene import Flag
from v2v_server.corpus.videos import VideoEntry, encoded_pieces
from v2v_server.lease_memory import LARGEST_MEMORY_BYTES, MOST_CLIP_BYTES, MOST_LEASE_BYTES
from v2v_server.schedule import MOST_CANDIDATES, Schedule, SequenceTable
from v2v_server.video.rows import Rows

FULL = Rows()


def table(*videos: VideoEntry, rows: Rows = FULL, spec: StreamSpec = SMALL_SPEC) -> SequenceTable:
    return SequenceTable(videos, rows, spec)


def listed(of: SequenceTable) -> list[tuple[str, int]]:
    return [(of[rank].video.id, of[rank].start_frame) for rank in range(of.count)]


def brute_force(videos: list[VideoEntry], spec: StreamSpec) -> list[tuple[str, int]]:
    """The rule as the paper's code walks it: step through the video until a sequence no longer fits."""
    found = []
    for entry in videos:
        start, number = 0, 0
        while start + spec.recipe.frames_needed <= entry.frames and number < spec.max_sequences_per_video:
            found.append((entry.id, start))
            start, number = start + spec.recipe.frames_per_sequence, number + 1
    return found


# --- the rule ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("frames", "starts"),
    [
        (200, []),
        (201, [0]),
        (400, [0]),
        (401, [0, 200]),
        (600, [0, 200]),
        (2001, list(range(0, 2000, 200))),
        (2201, list(range(0, 2000, 200))),
        (100_000, list(range(0, 2000, 200))),
    ],
)
def test_the_papers_rule(frames: int, starts: list[int]) -> None:
    found = table(video("a", frames, 336, 596), spec=StreamSpec())
    assert [start for _, start in listed(found)] == starts


_lengths = st.lists(st.integers(1, 120), max_size=12)


_runs = st.lists(st.tuples(st.integers(0, 30), st.integers(1, 40)), max_size=4)
_blocks = st.sampled_from((1, 2, 3, 512))


@given(_lengths, st.integers(1, 12), st.integers(1, 4), st.integers(0, 1), _blocks)
def test_lookup_by_rank_equals_the_list(lengths: list[int], most: int, voxels: int, lead: int, block: int) -> None:
    recipe = SMALL.replace(voxels_per_clip=voxels, lead_voxels=lead)
    spec = StreamSpec(recipe=recipe, max_sequences_per_video=most)
    videos = [video(f"v{number}", frames) for number, frames in enumerate(lengths)]
    with mock.patch.object(sequences, "_BLOCK", block):
        found = table(*videos, spec=spec)
        expected = brute_force(videos, spec)
        assert listed(found) == expected
    assert found.count == len(expected)
    assert found.videos == len({name for name, _ in expected})
    assert found.videos + len(found.refusals) == len(videos)
    for name, start in expected:
        entry = next(entry for entry in videos if entry.id == name)
        assert start + recipe.frames_needed <= entry.frames


def _divided(ends: list[int]) -> bytes:
    """Return pieces of which every other one is black, from the first on; without ends, a video that fades."""
    parts = pieces(*((end, 0 if at % 2 else Flag.BLACK) for at, end in enumerate(ends) if end))
    return encoded_pieces(parts if ends else pieces((9, Flag.FADE)), max(ends, default=9))


@given(
    st.lists(st.tuples(_runs, st.sampled_from((1.0, 24.0, 30_000 / 1001, 60.0, 240.0, math.nan, 1e5))), max_size=8),
    st.floats(0.01, 0.5),
    st.integers(1, 3),
    st.sampled_from(("off", "auto")),
    _blocks,
)
def test_grids_of_a_duration_have_as_many_frames_as_the_rate_of_their_video_says(
    stretches: list[tuple[list[tuple[int, int]], float]], seconds: float, stride: int, scene: str, block: int
) -> None:
    recipe = SMALL.replace(voxel_seconds=(0.001, seconds), frame_stride=stride)
    spec = StreamSpec(recipe=recipe, max_sequences_per_video=5, scene=scene)
    videos, expected, admitted = [], [], set()
    for number, (each, rate) in enumerate(stretches):
        ends = list(itertools.accumulate(itertools.chain.from_iterable(each)))
        runs = tuple(zip(ends[::2], ends[1::2], strict=True))
        divided = _divided(ends)
        entry = dataclasses.replace(video(f"v{number}", max(ends, default=9), rate=rate), pieces=divided)
        videos.append(entry)
        if math.isnan(rate) or (steps := max(1, math.floor(seconds * rate / stride + 0.5))) > MOST_STEPS_PER_GRID:
            continue
        length = steps * stride * recipe.voxels_per_clip
        stretch = runs if scene == "auto" else ((0, entry.frames),)
        starts = [start for first, end in stretch for start in range(first, end - length, length)]
        expected += [(entry.id, start) for start in starts[:5]]
        admitted |= {entry.id} if starts else set()
    with mock.patch.object(sequences, "_BLOCK", block):
        found = table(*videos, spec=spec)
        assert listed(found) == expected
    assert {refusal.video for refusal in found.refusals} == {entry.id for entry in videos} - admitted


@pytest.mark.parametrize(
    ("rate", "frames", "reason", "remedy"),
    [
        (math.nan, 100, "its frame rate is unknown, and voxel_seconds needs it", "voxel_seconds 0"),
        (10_000.0, 10**6, r"a voxel grid of 10 s spans 100000 steps at 10000 frames/s, the limit is 1024", "shorter"),
        (
            30.0,
            500,
            r"500 frames, the recipe needs 601 at 30 frames/s",
            "voxels_per_clip at most 1 (--set voxels_per_clip=1)",
        ),
        (30.0, 200, r"200 frames, the recipe needs 601 at 30 frames/s", "shorter voxel_seconds or frame_stride"),
    ],
)
def test_a_duration_that_a_video_cannot_give_is_refused(rate: float, frames: int, reason: str, remedy: str) -> None:
    found = table(video("a", frames, rate=rate), spec=StreamSpec(recipe=SMALL.replace(voxel_seconds=10.0)))
    (refusal,) = found.refusals
    assert refusal.reason == reason
    assert refusal.remedy.startswith(remedy)
    assert found.count == 0
    assert found.longest_clips == ((1,) if frames == 500 else ())


def test_tables_of_a_thousand_geometries_take_little_memory() -> None:
    """Each of a thousand consumers may have a spec of its own."""
    videos = [video(f"v{number}", 100 + number % 900) for number in range(20_000)]
    columns = sequences.Columns(videos)
    tracemalloc.start()
    try:
        tables = [
            SequenceTable(videos, FULL, StreamSpec(recipe=SMALL, max_sequences_per_video=most), columns)
            for most in range(1, 51)
        ]
        kept_bytes, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert kept_bytes / len(tables) < 10_000


@pytest.mark.parametrize("rank", [-1, 3, 2**48])
def test_a_rank_outside_is_refused(rank: int) -> None:
    found = table(video("a", 13))
    assert found.count == 3
    with pytest.raises(IndexError, match=f"sequence {rank} of 3"):
        found[rank]


# --- refusals -------------------------------------------------------------------------------------------------------


@given(
    st.integers(2, 60),
    st.integers(1, 12),
    st.integers(1, 4),
    st.integers(1, 3),
    st.integers(0, 1),
)
def test_the_remedy_for_a_short_video_admits_it(frames: int, voxels: int, bins: int, per_bin: int, lead: int) -> None:
    changes: dict[str, Any] = {"voxels_per_clip": voxels, "bins": bins, "frames_per_bin": per_bin, "lead_voxels": lead}
    recipe = SMALL.replace(**changes)
    refusals = table(video("short", frames), spec=StreamSpec(recipe=recipe)).refusals
    assert bool(refusals) == (frames < recipe.frames_needed)
    if not refusals:
        return
    assert refusals[0].video == "short"
    assert refusals[0].reason == f"{frames} frames, the recipe needs {recipe.frames_needed}"
    if match := re.fullmatch(r"voxels_per_clip at most (\d+) \(--set voxels_per_clip=\1\)", refusals[0].remedy):
        most = int(match[1])
        assert 1 <= most < voxels
        assert table(video("short", frames), spec=StreamSpec(recipe=recipe.replace(voxels_per_clip=most))).count == 1
        more = recipe.replace(voxels_per_clip=most + 1)
        assert table(video("short", frames), spec=StreamSpec(recipe=more)).count == 0
    else:
        assert refusals[0].remedy == "fewer bins, frames_per_bin or frame_stride, no lead_voxels"
        least = recipe.replace(voxels_per_clip=1, bins=1, frames_per_bin=1, lead_voxels=0)
        assert table(video("short", frames), spec=StreamSpec(recipe=least)).count >= 1


def test_one_frame_has_no_remedy() -> None:
    (refusal,) = table(video("still", 1)).refusals
    assert refusal.remedy == "none: a voxel grid needs two frames"


@given(st.integers(1, 300), st.integers(1, 300), st.integers(1, 300), st.integers(1, 300))
def test_the_remedy_for_a_small_picture_admits_it(height: int, width: int, crop_height: int, crop_width: int) -> None:
    recipe = SMALL.replace(crop_height_px=crop_height, crop_width_px=crop_width)
    small = video("small", 100, height, width)
    refusals = table(small, spec=StreamSpec(recipe=recipe)).refusals
    assert bool(refusals) == (height < crop_height or width < crop_width)
    if not refusals:
        return
    assert refusals[0].reason == (f"picture {width}x{height} after rows full, the crop is {crop_width}x{crop_height}")
    match = re.fullmatch(r"resize_scale up to ([\d.]+), or a smaller crop", refusals[0].remedy)
    if match is None:
        # No scale that a recipe may have is large enough.
        assert refusals[0].remedy == "a smaller crop"
        assert max(crop_height / height, crop_width / width) > 100
        return
    scale = float(match[1])
    assert table(small, spec=StreamSpec(recipe=recipe.replace(resize_scale=(1.0, scale)))).count > 0
    assert scale <= max(crop_height / height, crop_width / width) + 0.002


def test_what_a_worker_would_have_to_hold_is_refused_before_it_starts() -> None:
    """Pictures that are made small are held whole first: 706 MiB for a sample of 177 KB."""
    large = video("v.mp4", frames=1000, width_px=3840, height_px=2160)
    most = MOST_CLIP_BYTES // (3840 * 2160) - 1  # steps

    def under(steps: int, **fields: Any) -> SequenceTable:
        recipe = Recipe(voxels_per_clip=steps, bins=1, crop_height_px=64, crop_width_px=64, **fields)
        return table(large, spec=StreamSpec(recipe))

    assert under(most, resize_scale=(0.1, 0.1)).count
    (refusal,) = under(most + 1, resize_scale=(0.1, 0.1)).refusals
    assert re.fullmatch(r"one sample takes 20\d\d MiB of decoded frames, the limit is 2048 MiB", refusal.reason)
    assert "resize_scale 1" in refusal.remedy
    assert under(most + 1).count  # cropped as it is decoded


@pytest.mark.parametrize(
    ("asked", "recipe"),
    [
        ({"flow_margin_px": -1}, {}),
        ({"flow_margin_px": 2000}, {}),
        ({"samples_per_decode": 32, "flow_margin_px": 500}, {}),
        ({}, {"crop_height_px": 400, "crop_width_px": 600, "light": "declared"}),
        ({"substep_px": 1.0}, {"crop_height_px": 100, "crop_width_px": 200}),
        ({"substep_px": 1.0, "flow_margin_px": 0}, {"crop_height_px": 100, "crop_width_px": 200}),
        ({"scene": "off", "voxel_dtype": "float32"}, {"crop_height_px": 300, "crop_width_px": 600}),
    ],
)
def test_all_that_a_lease_may_take_counts(asked: dict[str, Any], recipe: dict[str, Any]) -> None:
    """A crop of 16 x 16 px with the whole picture as its margin once ended three workers, and its healthy video."""
    long = video("v.mp4", frames=200_000, width_px=1920, height_px=1080)

    def under(steps: int, **fields: Any) -> SequenceTable:
        made = Recipe(voxels_per_clip=steps, bins=1, **({"crop_height_px": 16, "crop_width_px": 16} | recipe | fields))
        return table(long, spec=StreamSpec(made, **asked))

    most = bisect_right(range(1, 100_000), 0, key=lambda steps: not under(steps).count)
    (refusal,) = under(most + 1).refusals
    told = re.fullmatch(r"one sample takes up to (\d+) MiB of memory, the limit is 7168 MiB", refusal.reason)
    assert told is not None
    assert 7168 <= int(told[1]) < 7300
    crop = int(np.prod(under(1)._spec.recipe.crop_px)) * asked.get("samples_per_decode", 1)
    assert crop * most < MOST_CLIP_BYTES, "the frames alone would not have been refused"
    assert LARGEST_MEMORY_BYTES - MOST_LEASE_BYTES == 1 << 30


def test_rows_that_one_picture_does_not_have_reject_only_that_video() -> None:
    found = table(video("low", 100, height_px=10), video("tall", 5, height_px=20), rows=Rows.parse("top:12px"))
    assert listed(found) == [("tall", 0)]
    (refusal,) = found.refusals
    assert refusal.video == "low"
    assert "the picture has 10 rows only" in refusal.reason
    (refusal,) = table(video("flat", 100, height_px=1), rows=Rows.parse("0.1:0.6")).refusals
    assert "no row is left" in refusal.reason


# --- the schedule -----------------------------------------------------------------------------------------------------


def schedule(*lengths: int, shuffle: bool = True) -> Schedule:
    videos = (video(f"v{number}", frames) for number, frames in enumerate(lengths))
    return Schedule(table(*videos), StreamSpec(recipe=SMALL, shuffle=shuffle))


def epoch_order(of: Schedule, seed: int, epoch: int, candidate: int = 0) -> list[tuple[str, int]]:
    found = [of.candidate(seed, epoch, index, candidate) for index in range(of.count)]
    return [(sequence.video.id, sequence.start_frame) for sequence in found]


def test_an_epoch_holds_every_sequence_once() -> None:
    of = schedule(30, 5, 45)
    catalogue_order = epoch_order(schedule(30, 5, 45, shuffle=False), 0, 0)
    assert len(set(catalogue_order)) == of.count == 7 + 1 + 10
    orders = [epoch_order(of, seed, epoch) for seed in (0, 2**64 - 1) for epoch in (0, 2**32 - 1)]
    assert all(sorted(order) == sorted(catalogue_order) for order in orders)
    assert len(set(map(tuple, orders))) == 4


def test_substitutes_are_fixed_and_leave_the_order_alone() -> None:
    of = schedule(100, 100, 100, 100)
    before = epoch_order(of, 1, 2)
    substitutes = [epoch_order(of, 1, 2, candidate) for candidate in range(1, MOST_CANDIDATES)]
    assert substitutes == [epoch_order(of, 1, 2, candidate) for candidate in range(1, MOST_CANDIDATES)]
    assert len(set(map(tuple, substitutes))) == MOST_CANDIDATES - 1
    assert epoch_order(of, 1, 2) == before
    # Substitutes are spread over the corpus, not over the neighbourhood of the one they replace.
    assert all(len({name for name, _ in order}) == 4 for order in substitutes)


@pytest.mark.parametrize("candidate", [0, 1])
def test_an_index_outside_the_epoch_is_refused(candidate: int) -> None:
    of = schedule(5)
    assert of.count == 1
    assert of.candidate(0, 0, 0, candidate).video.id == "v0"
    for index in (-1, 1):
        with pytest.raises(IndexError, match=f"index {index} of an epoch of 1 samples"):
            of.candidate(0, 0, index, candidate)


def test_the_crop_at_its_full_size_fits_exactly() -> None:
    recipe = Recipe(voxels_per_clip=1, bins=1, crop_height_px=16, crop_width_px=16)
    assert table(video("a", 2), spec=StreamSpec(recipe=recipe)).count == 1

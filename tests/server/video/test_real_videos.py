"""Real footage, where the shared collection is at hand: ``$V2V_TEST_VIDEOS``, or ``../shared/data/videos``."""

from __future__ import annotations

import csv
import os
import random
from functools import cache
from itertools import islice
from pathlib import Path

import av
import numpy as np
import pytest

from tests.oracles.decoded import decode_luma
from v2v_protocol.errors import VideoError
from v2v_server.video.picture import LumaFormat, Orientation, PixelRect, range_table
from v2v_server.video.probe import probe

FOLDER = Path(os.environ.get("V2V_TEST_VIDEOS", Path(__file__).parents[4] / "shared" / "data" / "videos"))
CORRUPT = "decord_corrupted.mp4"
MOST_FRAMES = 60


def manifest() -> dict[str, int]:
    table = FOLDER.parent / "MANIFEST.tsv"
    if not table.is_file():
        return {}
    with table.open(newline="") as lines:
        rows = csv.DictReader(lines, delimiter="\t")
        return {Path(row["file"]).name: int(row["frames_decoded"]) for row in rows if row["file"].startswith("videos/")}


FRAMES = manifest()
SOUND = sorted(name for name in FRAMES if name != CORRUPT)

pytestmark = pytest.mark.skipif(not FRAMES, reason=f"no MANIFEST.tsv beside {FOLDER}; set V2V_TEST_VIDEOS")


facts_of = cache(probe)


def luma_in_one_go(path: Path, most: int, *windows: PixelRect) -> list[np.ndarray]:
    """The slow oracle: every frame from the beginning, whole planes, upright by rot90; then windows of them."""
    pictures: list[list[np.ndarray]] = [[] for _ in windows]
    with av.open(str(path)) as container:
        for frame in islice(container.decode(video=0), most):
            plane = frame.planes[0]
            luma = np.frombuffer(memoryview(plane), np.uint8).reshape(-1, plane.line_size)[:, : frame.width]
            upright = np.rot90(luma, frame.rotation // 90) if Orientation.of(frame).transpose else luma
            for seen, (top, left, height, width) in zip(pictures, windows, strict=True):
                part = upright[top : top + height, left : left + width].copy()
                seen.append(part if LumaFormat.of(frame).full_range else range_table(8, False)[part])
    return [np.stack(seen) for seen in pictures]


@pytest.mark.parametrize("name", sorted(FRAMES))
def test_frame_counts(name: str) -> None:
    counted = facts_of(FOLDER / name).frames
    if name == CORRUPT:
        assert counted > FRAMES[name]
    else:
        assert counted == FRAMES[name]


@pytest.mark.parametrize("name", SOUND)
def test_random_ranges_equal_sequential_decoding(name: str) -> None:
    path, rng = FOLDER / name, random.Random(name)
    facts = facts_of(path)
    frames = min(MOST_FRAMES, facts.frames)
    windows = [(rng.randrange(facts.height_px - 32), rng.randrange(facts.width_px - 32), 32, 32) for _ in range(3)]
    for window, reference in zip(windows, luma_in_one_go(path, frames, *windows), strict=True):
        start = rng.randrange(frames)
        count = rng.randint(1, min(25, frames - start))
        got = decode_luma(path, facts.index.slice(start, count), start, count, window)
        np.testing.assert_array_equal(got.frames, reference[start : start + count])


def test_the_corrupt_clip() -> None:
    path, sound = FOLDER / CORRUPT, FRAMES[CORRUPT]
    facts = facts_of(path)
    (reference,) = luma_in_one_go(path, sound, (0, 0, facts.height_px, facts.width_px))
    np.testing.assert_array_equal(decode_luma(path, facts.index, 0, sound).frames, reference)
    with pytest.raises(VideoError, match="does not decode") as caught:
        decode_luma(path, facts.index, 20, 20)
    assert caught.value.frame == sound

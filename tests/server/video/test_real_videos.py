"""Real footage, where the shared collection is at hand: ``$V2V_TEST_VIDEOS``, or ``../shared/data/videos``."""

from __future__ import annotations

import csv
import os
import random
from pathlib import Path

import av
import numpy as np
import pytest

from tests.oracles.decoded import decode_luma
from v2v_protocol.errors import VideoError
from v2v_server.video.picture import LumaFormat, Orientation, range_table
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


def luma_in_one_go(path: Path, most: int) -> np.ndarray:
    """The slow oracle: every frame from the beginning, whole planes, upright by rot90."""
    pictures = []
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        for frame in container.decode(stream):
            plane = frame.planes[0]
            luma = np.frombuffer(memoryview(plane), np.uint8).reshape(-1, plane.line_size)[:, : frame.width].copy()
            if not LumaFormat.of(frame).full_range:
                luma = range_table(8, False)[luma]
            pictures.append(np.rot90(luma, frame.rotation // 90) if Orientation.of(frame).transpose else luma)
            if len(pictures) == most:
                break
    return np.stack(pictures)


@pytest.mark.parametrize("name", sorted(FRAMES))
def test_frame_counts(name: str) -> None:
    counted = probe(FOLDER / name).frames
    if name == CORRUPT:
        assert counted > FRAMES[name]
    else:
        assert counted == FRAMES[name]


@pytest.mark.parametrize("name", SOUND)
def test_random_ranges_equal_sequential_decoding(name: str) -> None:
    path, rng = FOLDER / name, random.Random(name)
    facts = probe(path)
    frames = min(MOST_FRAMES, facts.frames)
    reference = luma_in_one_go(path, frames)
    for _ in range(3):
        start = rng.randrange(frames)
        count = rng.randint(1, min(25, frames - start))
        top, left = rng.randrange(facts.height_px - 32), rng.randrange(facts.width_px - 32)
        got = decode_luma(path, facts.index.slice(start, count), start, count, (top, left, 32, 32))
        np.testing.assert_array_equal(got.frames, reference[start : start + count, top : top + 32, left : left + 32])


def test_the_corrupt_clip() -> None:
    path, sound = FOLDER / CORRUPT, FRAMES[CORRUPT]
    index = probe(path).index
    np.testing.assert_array_equal(decode_luma(path, index, 0, sound).frames, luma_in_one_go(path, sound))
    with pytest.raises(VideoError, match="does not decode") as caught:
        decode_luma(path, index, 20, 20)
    assert caught.value.frame == sound

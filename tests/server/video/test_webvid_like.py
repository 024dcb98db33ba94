"""The corpus of the benches: clips of the promised form."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from bench.corpus import webvid_like
from tests.clips import panned_luma, write_clip
from tests.oracles.decoded import decode_luma
from v2v_server.video.probe import probe


@pytest.mark.slow  # of the benches
def test_form_and_ping_pong(tmp_path: Path) -> None:
    source = write_clip(tmp_path / "source.mp4", panned_luma(8, 240, 320, step=(0, 6)))
    (clip,) = webvid_like([source], tmp_path / "out", gop=12, frames=30, clips=1)
    path = Path(clip["path"])
    facts = probe(path)
    assert (facts.frames, facts.width_px, facts.height_px) == (30, 596, 336)
    assert (facts.codec, facts.pixel_format) == ("h264", "yuv420p")
    assert len(facts.index.keyframes) >= 3
    assert clip["bits_per_second"] == pytest.approx(path.stat().st_size * 8 / (30 * 1001 / 30000))
    shown = decode_luma(path, facts.index, 0, 30).frames.astype(int)
    # 0 1 .. 7 6 .. 1 0: frame 14 shows the first picture again, frame 7 is farthest from it.
    distance = np.abs(shown - shown[0]).mean(axis=(1, 2))
    assert np.argmax(distance[:15]) == 7
    assert distance[14] < distance[1]

"""Which of several video tracks is the video, and how often its frames come."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest
from av.stream import Disposition

from tests.clips import panned_luma, write_clip
from v2v_server.video.probe import probe


def with_tracks(target: Path, tracks: Sequence[tuple[Path, Disposition]]) -> Path:
    """Copy the first video track of each file, in that order."""
    with av.open(str(target), "w") as output:
        sources = [av.open(str(source)) for source, _ in tracks]
        copies = [output.add_stream_from_template(source.streams.video[0]) for source in sources]
        for copy, (_, disposition) in zip(copies, tracks, strict=True):
            copy.disposition = disposition
        packets = [
            (float(packet.dts * packet.time_base), number, packet)
            for number, source in enumerate(sources)
            for packet in source.demux(video=0)
            if packet.size
        ]
        for _, number, packet in sorted(packets, key=lambda entry: entry[:2]):
            packet.stream = copies[number]
            output.mux(packet)
        for source in sources:
            source.close()
    return target


NONE, DEFAULT = Disposition(0), Disposition.default


@pytest.fixture
def parts(tmp_path: Path) -> dict[str, Path]:
    """Return tracks that their heights tell apart."""
    return {
        "still": write_clip(tmp_path / "still.avi", panned_luma(1, 32), codec="mjpeg", pixel_format="yuvj420p"),
        "first": write_clip(tmp_path / "first.mp4", panned_luma(20, 48)),
        "second": write_clip(tmp_path / "second.mp4", panned_luma(20, 64)),
    }


@pytest.mark.parametrize("suffix", ["mkv", "mov"])
@pytest.mark.parametrize(
    ("tracks", "height"),
    [
        ([("still", NONE), ("first", DEFAULT)], 48),
        ([("still", DEFAULT), ("first", NONE)], 48),
        ([("first", NONE), ("second", DEFAULT)], 64),
        ([("first", DEFAULT), ("second", DEFAULT)], 64),
        ([("second", NONE), ("first", NONE)], 64),
        ([("first", NONE), ("first", NONE)], 48),
        ([("still", NONE), ("still", DEFAULT)], 32),
        ([("still", DEFAULT)], 32),
    ],
    ids=str,
)
def test_which_track_is_the_video(
    tmp_path: Path, parts: dict[str, Path], suffix: str, tracks: list[tuple[str, Disposition]], height: int
) -> None:
    path = with_tracks(tmp_path / f"clip.{suffix}", [(parts[name], disposition) for name, disposition in tracks])
    assert probe(path).height_px == height


def test_a_still_in_avi(tmp_path: Path, parts: dict[str, Path]) -> None:
    """Its header states more frames than there are."""
    moving = write_clip(tmp_path / "moving.avi", panned_luma(20, 48), codec="mpeg4")
    path = with_tracks(tmp_path / "clip.avi", [(parts["still"], NONE), (moving, NONE)])
    assert probe(path).height_px == 48


def test_a_track_that_is_not_read_is_not_the_video(tmp_path: Path, parts: dict[str, Path]) -> None:
    unread = write_clip(tmp_path / "unread.avi", panned_luma(20, 80), codec="cinepak", pixel_format="rgb24")
    path = with_tracks(tmp_path / "clip.mov", [(unread, DEFAULT), (parts["first"], NONE)])
    assert probe(path).height_px == 48


def test_a_gap_does_not_change_the_rate(tmp_path: Path) -> None:
    times = np.arange(60) * 40
    times[30:] += 3_600_000
    path = write_clip(tmp_path / "clip.mkv", panned_luma(60), pts=times.tolist())
    assert probe(path).frames_per_second == pytest.approx(25)
    assert probe(path).frames == 60


def test_a_rate_that_needs_a_fine_clock(tmp_path: Path) -> None:
    """Matroska rounds time stamps to milliseconds: most steps last 33 ms, and their average is right."""
    path = write_clip(tmp_path / "clip.mkv", panned_luma(91), rate=Fraction(30000, 1001))
    assert probe(path).frames_per_second == pytest.approx(30000 / 1001, rel=1e-3)


def test_the_rate_of_h264_in_avi_is_that_of_frames(tmp_path: Path) -> None:
    path = write_clip(tmp_path / "clip.avi", panned_luma(40), b_frames=2)
    assert not probe(path).index.seekable
    assert probe(path).frames_per_second == pytest.approx(25)

"""Files whose packets do not name their frames: each frame that is counted is served, as the decoder delivers it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import av
import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import v2v_server.video.probe as probing
from tests.clips import panned_luma, write_clip
from tests.oracles.decoded import decode_luma
from v2v_server.video.decode import decodes_as_listed
from v2v_server.video.frame_index import FrameIndex
from v2v_server.video.packets import is_scaled, may_be_not_coded, times_are_doubtful
from v2v_server.video.picture import range_table
from v2v_server.video.probe import VideoFacts, probe

Change = Callable[[av.Packet, int], av.Packet]
"""(packet, its number in stored order) -> what is stored instead."""


def joined(sources: Sequence[Path], target: Path, change: Change = lambda packet, number: packet) -> Path:
    """Write the packets of all sources as one track, with the time stamps of one clock."""
    with av.open(str(sources[0])) as first, av.open(str(target), "w") as output:
        copy = output.add_stream_from_template(first.streams.video[0])
        number = end = 0
        for source in sources:
            begin, end = end, end
            with av.open(str(source)) as container:
                for packet in container.demux(video=0):
                    if packet.size:
                        packet.pts, packet.dts = packet.pts + begin, packet.dts + begin
                        end = max(end, packet.pts + packet.duration)
                        packet = change(packet, number)
                        packet.stream = copy
                        output.mux(packet)
                        number += 1
    return target


def delivered(path: Path) -> npt.NDArray[np.uint8]:
    """Return the luma of every frame in the decoder's order, with those of limited range stretched."""
    with av.open(str(path)) as container:
        frames = list(container.decode(video=0))
    rows = [np.asarray(memoryview(frame.planes[0])).reshape(frame.height, -1)[:, : frame.width] for frame in frames]
    return range_table(8, False)[np.stack(rows)]


def assert_all_are_served(path: Path, facts: VideoFacts, frames: npt.NDArray[np.uint8]) -> None:
    assert facts.frames == len(frames)
    for start, count in ((0, len(frames)), (len(frames) // 2, 5), (len(frames) - 3, 3)):
        got = decode_luma(path, facts.index.slice(start, count), start, count).frames
        np.testing.assert_array_equal(got, frames[start : start + count])


def pts_is_dts(packet: av.Packet, number: int) -> av.Packet:
    packet.pts = packet.dts
    return packet


@pytest.mark.parametrize("b_frames_from", [0, 40])
@pytest.mark.parametrize("suffix", ["mp4", "mkv", "flv"])
def test_reordered_frames_without_times_of_presentation(tmp_path: Path, suffix: str, b_frames_from: int) -> None:
    """As the muxers of many recorders and browsers write them."""
    luma = panned_luma(90)
    luma[:b_frames_from] = luma[b_frames_from]
    options = {"x264-params": "b-adapt=0:scenecut=0" if not b_frames_from else "b-adapt=2"}
    plain = write_clip(tmp_path / "plain.mp4", luma, b_frames=3, gop=30, options=options)
    path = joined([plain], tmp_path / f"clip.{suffix}", pts_is_dts)
    facts = probe(path)
    assert not facts.index.seekable
    assert_all_are_served(path, facts, delivered(path))


def test_interleaved_clocks(tmp_path: Path) -> None:
    """Two recordings in one file, of which the second begins within the first one's time."""
    first = write_clip(tmp_path / "first.ts", panned_luma(60), b_frames=2)

    def later(packet: av.Packet, number: int) -> av.Packet:
        packet.pts, packet.dts = packet.pts + 45900, packet.dts + 45900
        return packet

    second = joined([first], tmp_path / "second.ts", later)
    path = tmp_path / "both.ts"
    path.write_bytes(first.read_bytes() + second.read_bytes())
    facts = probe(path)
    assert facts.frames == 120
    assert_all_are_served(path, facts, delivered(path))


def not_coded(packet: av.Packet, number: int) -> av.Packet:
    """Replace every tenth packet of MPEG-4 at 25 Hz by a picture that is not coded: ISO/IEC 14496-2, 6.2.5."""
    content = bytes(packet)
    at = content.find(b"\0\0\1\xb6") + 4
    bits = f"{int.from_bytes(content[at : at + 8], 'big'):064b}"
    if number % 10 != 5 or bits[:2] != "01":
        return packet
    end = bits.index("0", 2) + 1 + 1 + 5 + 1  # seconds, marker, 5 bits of time, marker
    head = bits[:end] + "0"
    head += "0" + "1" * (-(len(head) + 1) % 8)
    short = av.Packet(content[:at] + int(head, 2).to_bytes(len(head) // 8, "big"))
    short.pts, short.dts, short.duration, short.time_base = packet.pts, packet.dts, packet.duration, packet.time_base
    return short


@pytest.mark.parametrize("suffix", ["mp4", "mkv", "avi"])
def test_pictures_that_are_not_coded(tmp_path: Path, suffix: str) -> None:
    """MPEG-4 says that nothing changed; the decoder delivers no frame."""
    plain = write_clip(tmp_path / f"plain.{suffix}", panned_luma(60), codec="mpeg4", gop=30)
    path = joined([plain], tmp_path / f"clip.{suffix}", not_coded)
    facts = probe(path)
    assert (facts.frames, facts.index.seekable) == (54, True)
    assert_all_are_served(path, facts, delivered(path))


@settings(max_examples=20, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(order=st.permutations(range(24)), gaps=st.lists(st.integers(1, 400), min_size=24, max_size=24))
def test_any_time_stamps(tmp_path: Path, order: list[int], gaps: list[int]) -> None:
    plain = tmp_path / "plain.mp4"
    if not plain.exists():
        write_clip(plain, panned_luma(24), b_frames=2, gop=24)
    times = np.cumsum(gaps)

    def timed(packet: av.Packet, number: int) -> av.Packet:
        packet.pts, packet.dts = int(times[order[number]]) * 512, number * 512 - 10**6
        return packet

    path = joined([plain], tmp_path / "clip.mp4", timed)
    facts = probe(path)
    frames = delivered(path)
    got = decode_luma(path, facts.index, 0, facts.frames).frames
    np.testing.assert_array_equal(got, frames[len(frames) - len(got) :])


@pytest.mark.parametrize(
    ("codec", "suffix", "options"),
    [
        ("libx264", "mkv", {}),
        ("libx265", "mkv", {"x265-params": "log-level=none:pools=1:frame-threads=1:repeat-headers=1"}),
        ("libvpx", "webm", {}),
        ("libvpx-vp9", "webm", {"cpu-used": "8"}),
        ("mpeg4", "mkv", {}),
        ("mpeg2video", "mkv", {}),
        ("mjpeg", "mkv", {}),
    ],
)
def test_what_follows_a_change_of_size_is_not_counted(
    tmp_path: Path, codec: str, suffix: str, options: dict[str, str]
) -> None:
    pixel_format = "yuvj420p" if codec == "mjpeg" else "yuv420p"
    container = "mpegts" if codec in ("libx264", "mpeg4") else None  # keeps its parameters in the packets
    parts = [
        write_clip(
            tmp_path / f"{number}.{suffix}", panned_luma(70, *size), codec=codec, options=options, gop=70,
            pixel_format=pixel_format, full_range=codec == "mjpeg", container=container,
        )
        for number, size in enumerate([(48, 64), (64, 96), (48, 64)])
    ]  # fmt: skip
    path = joined(parts, tmp_path / f"turned.{suffix}")
    facts = probe(path)
    # The decoder of MPEG-2 loses the frame that it holds back when the size changes.
    count = 69 if codec == "mpeg2video" else 70
    assert (facts.frames, facts.height_px, facts.width_px, facts.index.seekable) == (count, 48, 64, True)
    assert decode_luma(path, facts.index, 30, count - 30).frames.shape == (count - 30, 48, 64)


def test_only_the_frames_around_a_gap_are_decoded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    times = np.arange(120) * 40
    times[50:] += 3_600_000
    path = write_clip(tmp_path / "clip.mkv", panned_luma(120), pts=times.tolist(), gop=100)
    places: list[tuple[int, int]] = []

    def seen(path: str, index: FrameIndex, start: int, count: int) -> bool:
        places.append((start, count))
        return decodes_as_listed(path, index, start, count)

    monkeypatch.setattr(probing, "decodes_as_listed", seen)
    monkeypatch.setattr(probing.Delivered, "of", lambda *more: pytest.fail("the whole file was decoded"))
    assert probe(path).frames == 120
    assert places == [(0, 8), (49, 2), (100, 20)]


def test_short_packets() -> None:
    vop = b"\0\0\1\xb6"
    assert may_be_not_coded("mpeg4", memoryview(b"\0\0\1\xb3abc" + vop + b"\x57\x3f"))
    assert not may_be_not_coded("mpeg4", memoryview(vop + bytes(range(20))))
    assert may_be_not_coded("wmv3", memoryview(b"\0"))
    assert not may_be_not_coded("av1", memoryview(b"\x88"))


@pytest.mark.parametrize(
    ("head", "scaled"),
    [
        ("1000 0110 00 00000001 0000 0010 0100 1", False),
        ("1000 0110 00 00000001 0000 0010 0100 001", False),
        ("1000 0110 00 00000001 0000 0010 0100 000", True),
        ("1000 0111 00000001 0000 0010 0100 000", True),  # resilient to errors: no bits of the context
        ("1000 0100 0 00 00000001 0000 0010 0100 000", True),  # not shown
        ("1000 0100 1 00 00000001 0000 0010 0100 000", False),  # intra only
        ("1011 0 0110 00 00000001 0000 0010 0100 000", True),  # profile 3
        ("1000 1000", False),  # shows an existing frame
    ],
)
def test_vp9_that_refers_to_other_sizes(head: str, scaled: bool) -> None:
    bits = head.replace(" ", "").ljust(64, "1")
    assert is_scaled(memoryview(int(bits, 2).to_bytes(8, "big"))) == scaled
    assert not is_scaled(memoryview(b"\x88"))


@pytest.mark.parametrize(
    ("pts", "dts", "reorders", "doubtful"),
    [
        ([0, 1, 2, 3], [0, 1, 2, 3], False, False),
        ([0, 3, 1, 2], [-1, 0, 1, 2], True, False),
        ([0, 1, 2, 3], [0, 1, 2, 3], True, True),
        ([0, 1, 2, 3], [0, 2, 1, 3], False, True),
        ([0, 1, 2, 90000, 90001], [0, 1, 2, 90000, 90001], False, False),
        ([*range(1, 40), 0], [*range(40)], False, True),
        ([0], [0], True, False),
    ],
)
def test_doubtful_times(pts: list[int], dts: list[int], reorders: bool, doubtful: bool) -> None:
    assert times_are_doubtful(np.array(pts), np.array(dts), reorders) == doubtful

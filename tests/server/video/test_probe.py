"""What a file holds, found by walking over its packets: its frames, its track and rate, and what is left out of it."""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from contextlib import closing
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import numpy.typing as npt
import pytest
from av.stream import Disposition
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import v2v_server.video.probe as probing
from tests.clips import damaged, panned_luma, truncated, write_clip
from tests.oracles.decoded import decode_luma
from v2v_protocol.errors import VideoError
from v2v_protocol.recipe import Recipe
from v2v_protocol.spec import StreamSpec
from v2v_server.corpus.catalogue import open_catalogue
from v2v_server.corpus_words import notes_of
from v2v_server.video.decode import decodes_as_listed
from v2v_server.video.frame_index import FrameIndex
from v2v_server.video.packets import is_hidden, is_scaled, may_be_not_coded, times_are_doubtful
from v2v_server.video.picture import range_table
from v2v_server.video.probe import VideoFacts, probe
from v2v_server.video.source import describe_cut, dolby_vision_profile
from v2v_tools.remake import Remaker

Change = Callable[[av.Packet, int], av.Packet | None]
"""(packet, its number in stored order) -> what is stored instead, or None for nothing."""


def remuxed(
    source: Path | Sequence[Path], target: Path, change: Change = lambda packet, number: packet, **options: str
) -> Path:
    """Write the packets of one or more files as one track, with the time stamps of one clock."""
    sources = [source] if isinstance(source, Path) else source
    with av.open(str(sources[0])) as first, av.open(str(target), "w", options=options) as output:
        copy = output.add_stream_from_template(first.streams.video[0])
        number = end = 0
        for each in sources:
            begin = end
            with av.open(str(each)) as container:
                for packet in container.demux(video=0):
                    if packet.size:
                        packet.pts, packet.dts = packet.pts + begin, packet.dts + begin
                        end = max(end, packet.pts + packet.duration)
                        if (stored := change(packet, number)) is not None:
                            stored.stream = copy
                            output.mux(stored)
                        number += 1
    return target


def stored_packets(path: Path) -> int:
    with av.open(str(path)) as container:
        return sum(packet.size > 0 for packet in container.demux(video=0))


def test_hidden_vp8_frames_are_not_counted(tmp_path: Path) -> None:
    plain = write_clip(tmp_path / "plain.webm", panned_luma(30), codec="libvpx", gop=30)

    def not_shown(packet: av.Packet, number: int) -> av.Packet:
        content = bytearray(bytes(packet))
        content[0] &= ~0x10 if number in (7, 20) else 0xFF  # show_frame
        again = av.Packet(bytes(content))
        again.pts, again.dts, again.time_base = packet.pts, packet.dts, packet.time_base
        again.is_keyframe = packet.is_keyframe
        return again

    hidden = remuxed(plain, tmp_path / "hidden.webm", not_shown)
    facts = probe(hidden)
    assert (stored_packets(hidden), facts.frames) == (30, 28)
    shown = np.delete(decode_luma(plain, probe(plain).index, 0, 30).frames, [7, 20], axis=0)
    np.testing.assert_array_equal(decode_luma(hidden, facts.index, 0, 28).frames, shown)
    np.testing.assert_array_equal(decode_luma(hidden, facts.index, 15, 10).frames, shown[15:25])


def test_hidden_vp9_frames_packed_with_shown_ones(tmp_path: Path) -> None:
    options = {"auto-alt-ref": "1", "lag-in-frames": "16", "b": "60k", "cpu-used": "4"}
    path = write_clip(tmp_path / "clip.webm", panned_luma(60, 96, 128), codec="libvpx-vp9", options=options, gop=60)
    assert probe(path).frames == 60


@pytest.mark.parametrize(
    ("codec", "packet", "hidden"),
    [
        ("vp8", b"\x11\x00", False),
        ("vp8", b"\x01\x00", True),
        ("vp9", b"\x82\x00", False),  # shown key frame of profile 0
        ("vp9", b"\x80\x00", True),
        ("vp9", b"\x88\x00", False),  # shows an existing frame
        ("vp9", b"\xb1\x00", False),  # profile 3 has one bit more
        ("vp9", b"\xb0\x00", True),
        ("vp9", b"\x80\x00\xc0", False),  # a superframe
        ("h264", b"\x00\x00", False),
    ],
)
def test_show_bits(codec: str, packet: bytes, hidden: bool) -> None:
    assert is_hidden(codec, memoryview(packet)) == hidden


def test_a_file_cut_in_mid_gop(tmp_path: Path) -> None:
    """What lies in front of the first keyframe cannot be decoded, and is not counted."""
    plain = write_clip(tmp_path / "plain.mkv", panned_luma(40), gop=12, options={"sc_threshold": "0", "qp": "0"})
    cut = remuxed(plain, tmp_path / "cut.mkv", lambda packet, number: packet if number >= 5 else None)
    facts, whole = probe(cut), probe(plain)
    reference = decode_luma(plain, whole.index, 0, 40).frames
    assert facts.frames <= 35
    got = decode_luma(cut, facts.index, 0, facts.frames).frames
    np.testing.assert_array_equal(got, reference[-facts.frames :])


def test_sound_alone(tmp_path: Path) -> None:
    path = tmp_path / "tone.m4a"
    with av.open(str(path), "w", format="mp4") as output:
        stream = output.add_stream("aac", rate=16000)
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 4096), np.int16), format="s16", layout="mono")
        frame.sample_rate = 16000
        output.mux(stream.encode(frame))
        output.mux(stream.encode(None))
    with pytest.raises(VideoError, match="has no video track"):
        probe(path)


def test_a_beginning_that_does_not_decode(tmp_path: Path) -> None:
    plain = write_clip(tmp_path / "plain.mkv", panned_luma(1), codec="ffv1")
    bad = damaged(plain, tmp_path / "bad.mkv", packet=0)
    with pytest.raises(VideoError, match="no frame decodes"):
        probe(bad)


def test_one_frame(tmp_path: Path) -> None:
    facts = probe(write_clip(tmp_path / "clip.mp4", panned_luma(1)))
    assert facts.frames == 1
    assert facts.frames_per_second == pytest.approx(25)


def test_a_name_that_looks_like_an_address(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As the path of a worker has it that was started with ``--videos .``; the server's paths are absolute."""
    write_clip(tmp_path / "12:30.mp4", panned_luma(5))
    monkeypatch.chdir(tmp_path)
    assert probe(Path("12:30.mp4")).frames == 5


@pytest.mark.parametrize("suffix", ["mp4", "mkv", "avi", "mov"])
def test_a_tag_that_is_not_utf_8_costs_no_video(tmp_path: Path, suffix: str) -> None:
    """Old cameras and QuickTime write Latin-1 and binary data."""
    plain, tagged = write_clip(tmp_path / f"plain.{suffix}", panned_luma(30)), tmp_path / f"tagged.{suffix}"
    with av.open(str(plain)) as source, av.open(str(tagged), "w") as target:
        track = source.streams.video[0]
        copied = target.add_stream_from_template(track)
        target.metadata["title"] = "Caf~"
        for packet in source.demux(track):
            if packet.size:
                packet.stream = copied
                target.mux(packet)
    content = tagged.read_bytes()
    assert content.count(b"Caf~") == 1
    tagged.write_bytes(content.replace(b"Caf~", b"Caf\xe9"))
    assert probe(tagged).frames == probe(plain).frames == 30


# --- which track is the video, and its rate ---------------------------------------------------------------------------


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


NONE, DEFAULT, COVER = Disposition(0), Disposition.default, Disposition.attached_pic


@pytest.fixture(scope="module")
def parts(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Return tracks that their heights tell apart."""
    folder = tmp_path_factory.mktemp("parts")
    return {
        "still": write_clip(folder / "still.avi", panned_luma(1, 32), codec="mjpeg", pixel_format="yuvj420p"),
        "first": write_clip(folder / "first.mp4", panned_luma(20, 48)),
        "second": write_clip(folder / "second.mp4", panned_luma(20, 64)),
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
        ([("still", COVER), ("first", NONE)], 48),
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
    unread = write_clip(tmp_path / "unread.avi", panned_luma(3, 80), codec="cinepak", pixel_format="rgb24")
    path = with_tracks(tmp_path / "clip.mov", [(unread, DEFAULT), (parts["first"], NONE)])
    assert probe(path).height_px == 48


def test_a_rate_that_needs_a_fine_clock(tmp_path: Path) -> None:
    """Matroska rounds time stamps to milliseconds: most steps last 33 ms, and their average is right."""
    path = write_clip(tmp_path / "clip.mkv", panned_luma(91), rate=Fraction(30000, 1001))
    assert probe(path).frames_per_second == pytest.approx(30000 / 1001, rel=1e-3)


def test_the_rate_of_h264_in_avi_is_that_of_frames(tmp_path: Path) -> None:
    path = write_clip(tmp_path / "clip.avi", panned_luma(40), b_frames=2)
    assert not probe(path).index.seekable
    assert probe(path).frames_per_second == pytest.approx(25)


# --- files whose packets do not name their frames ---------------------------------------------------------------------


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
    path = remuxed(plain, tmp_path / f"clip.{suffix}", pts_is_dts)
    facts = probe(path)
    assert not facts.index.seekable
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
    path = remuxed(plain, tmp_path / f"clip.{suffix}", not_coded)
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

    path = remuxed(plain, tmp_path / "clip.mp4", timed)
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
    path = remuxed(parts, tmp_path / f"turned.{suffix}")
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
    facts = probe(path)
    assert (facts.frames, facts.frames_per_second) == (120, pytest.approx(25))
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


# --- what is not served is said ---------------------------------------------------------------------------------------

CODECS = {
    "huffyuv.avi": ("huffyuv", "yuv422p"),
    "mjpeg.avi": ("mjpeg", "yuvj420p"),
    "mjpeg.mov": ("mjpeg", "yuvj420p"),
    "mjpeg.mjpeg": ("mjpeg", "yuvj420p"),
    "ffv1.avi": ("ffv1", "yuv420p"),
    "vp8.ivf": ("libvpx", "yuv420p"),
    "vp9.ivf": ("libvpx-vp9", "yuv420p"),
    "h264.ts": ("libx264", "yuv420p"),
    "mpeg4.avi": ("mpeg4", "yuv420p"),
    "ffv1.mkv": ("ffv1", "yuv420p"),
}


@pytest.mark.parametrize("name", CODECS)
def test_no_picture_of_a_recording_that_is_cut_short_is_served_unless_it_is_whole(name: str, tmp_path: Path) -> None:
    codec, pixel_format = CODECS[name]
    path = write_clip(
        tmp_path / name, panned_luma(40, 72, 96), codec=codec, pixel_format=pixel_format, gop=8,
        full_range=pixel_format.startswith("yuvj"),
    )  # fmt: skip
    facts = probe(path)
    assert (facts.frames, facts.remark) == (40, "")
    whole = decode_luma(path, facts.index, 0, 40).frames
    if name.endswith("mov"):
        path = remuxed(path, tmp_path / "fast.mov", movflags="faststart")  # as streaming needs it
    for share in (0.613, 0.777, 0.95):
        cut = probe(truncated(path, tmp_path / f"cut-{name}", share))
        served = decode_luma(tmp_path / f"cut-{name}", cut.index, 0, cut.frames).frames
        assert cut.frames < 40
        np.testing.assert_array_equal(served, whole[: cut.frames])
        assert cut.remark.startswith("is truncated")


def test_a_file_without_its_list_of_frames_is_called_truncated(tmp_path: Path) -> None:
    path = write_clip(tmp_path / "clip.mp4", panned_luma(40))
    write_clip(tmp_path / "other.mp4", panned_luma(40))
    truncated(path, path, 0.5)
    with closing(open_catalogue(tmp_path, cache_dir=tmp_path / "index", processes=0)) as catalogue:
        (refusal,) = catalogue.refusals
    size = path.stat().st_size
    assert refusal.reason.startswith(f"is truncated: {size:,} of at least ")
    assert ", and cannot be opened: " in refusal.reason


@pytest.mark.parametrize(
    ("head", "said"),
    [
        (b"RIFF" + struct.pack("<I", 100) + b"AVI ", "is truncated: 50 of at least 108 bytes are there"),
        (b"RIFF" + b"\xff" * 4 + b"AVI ", ""),  # unknown, as of a stream
        (b"RIFF" + struct.pack("<I", 43) + b"AVI ", ""),  # a byte of padding is missing
        (b"\0\0\0\x10ftypisom\0\0\0\0" + struct.pack(">I", 90) + b"mdat", "is truncated: 50 of at least 106 bytes"),
        (b"\0\0\0\x10ftypisom\0\0\0\0" + struct.pack(">I", 0) + b"mdat", ""),  # up to the end of the file
        (b"\0\0\0\x10ftypisom\0\0\0\0" + b"\xff" * 8, ""),  # no box
        (b"\0\0\0\x10ftypisom\0\0\0\0\0\0\0\1mdat" + struct.pack(">Q", 1000), "is truncated: 50 of at least 1,016"),
        (b"\x1a\x45\xdf\xa3\x80\x18\x53\x80\x67\x40\x60", "is truncated: 50 of at least 107 bytes are there"),
        (b"\x1a\x45\xdf\xa3\x80\x18\x53\x80\x67\x01" + b"\xff" * 7, ""),  # unknown
        (b"\x1a\x45\xdf\xa3", ""),
        (b"", ""),
    ],
)
def test_the_size_that_a_file_states(head: bytes, said: str, tmp_path: Path) -> None:
    path = tmp_path / "clip"
    path.write_bytes(head.ljust(50, b"\0"))
    assert describe_cut(str(path)).startswith(said)
    assert bool(describe_cut(str(path))) == bool(said)


def test_a_picture_that_grows_is_said_everywhere(tmp_path: Path) -> None:
    parts = [
        write_clip(tmp_path / f"{number}.ts", panned_luma(count, *size), gop=70, container="mpegts")
        for number, (count, size) in enumerate([(30, (48, 64)), (50, (96, 128))])
    ]
    videos = tmp_path / "videos"
    videos.mkdir()
    (videos / "grows.ts").write_bytes(parts[0].read_bytes() + parts[1].read_bytes())
    facts = probe(videos / "grows.ts")
    assert facts.frames == 30
    assert facts.remark.startswith("50 of 80 pictures are left out: from frame 30 on they are 128x96 px of yuv420p")
    write_clip(videos / "whole.mp4", panned_luma(30))
    recipe = Recipe(voxels_per_clip=1, bins=5, crop_height_px=32, crop_width_px=32)
    with closing(open_catalogue(videos, cache_dir=tmp_path / "index", processes=0)) as catalogue:
        (note,) = (note for note in notes_of(catalogue) if "are left out" in note)
        assert note.startswith(
            "1 video is served in part, or with wrong grey levels or times (grows.ts: 50 of 80 pictures"
        )
        samples = Remaker(catalogue, StreamSpec(recipe=recipe))
        remarks = {
            sample.provenance.video: sample.provenance.remark
            for sample in (samples.sample(0, 0, index) for index in range(samples.count))
        }
    assert remarks == {"grows.ts": facts.remark, "whole.mp4": ""}


@pytest.mark.parametrize("small_first", [True, False])
def test_pictures_of_a_track_that_begins_late(small_first: bool, tmp_path: Path) -> None:
    """A broadcast changes the number (PID) of its track: a demuxer does not see the second one."""
    parts = []
    for number, (frames, pid) in enumerate([(20, 256), (45, 512)][:: 1 if small_first else -1]):
        plain = write_clip(
            tmp_path / f"{number}.mp4", panned_luma(frames, 240, 320), options={"crf": "4", "preset": "ultrafast"}
        )
        parts.append(remuxed(plain, tmp_path / f"{number}.ts", mpegts_start_pid=str(pid)).read_bytes())
    path = tmp_path / "changes.ts"
    path.write_bytes(b"".join(parts))
    expected = "45 pictures of track 512" if small_first else "20 pictures of track 256"
    assert probe(path).remark == f"other tracks are left out: {expected}"


def dolby_record(profile: int, compatible: int) -> bytes:
    return bytes([1, 0]) + struct.pack(">H", profile << 9 | 1 << 3 | 5) + bytes([compatible << 4]) + bytes(19)


@pytest.mark.parametrize(
    ("profile", "compatible", "is_said"), [(5, 0, True), (10, 0, True), (8, 1, False), (10, 1, False), (7, 6, False)]
)
@pytest.mark.parametrize("container", ["mp4", "mkv"])
def test_dolby_vision_without_luma(
    profile: int, compatible: int, is_said: bool, container: str, tmp_path: Path
) -> None:
    path = write_clip(tmp_path / f"clip.{container}", panned_luma(12), pixel_format="yuv420p10le")
    content, record = bytearray(path.read_bytes()), dolby_record(profile, compatible)
    if container == "mp4":
        box = struct.pack(">I4s", 8 + len(record), b"dvvC") + record
        at = content.find(b"avc1", content.find(b"stsd")) - 4
        end = at + struct.unpack_from(">I", content, at)[0]
        for name in (b"moov", b"trak", b"mdia", b"minf", b"stbl", b"stsd", b"avc1"):  # behind the pictures
            begin = content.find(name, content.find(b"moov")) - 4
            struct.pack_into(">I", content, begin, struct.unpack_from(">I", content, begin)[0] + len(box))
        content[end:end] = box
        path.write_bytes(content)
        said = probe(path).remark
        wanted = f"is Dolby Vision profile {profile}, which stores IPT-PQ: its grey is not luma"
        assert said == (wanted if is_said else "")
    else:
        path.write_bytes(b"\x1a\x45\xdf\xa3 ... \x41\xe7\x84dvvC\x41\xed\x98" + record)
        assert dolby_vision_profile(str(path)) == (profile if is_said else None)


@pytest.mark.parametrize("rate", [2500, 1200, 1000, 400])
@pytest.mark.parametrize(("name", "codec"), [("a.mkv", "libx264"), ("a.mkv", "ffv1"), ("a.flv", "libx264")])
def test_rates_beyond_the_clock_of_the_container(rate: int, name: str, codec: str, tmp_path: Path) -> None:
    """Matroska and FLV count milliseconds; H.264 states its rate, FFV1 does not."""
    path = write_clip(tmp_path / name, panned_luma(300, 32, 32), codec=codec, rate=rate)
    tolerance = 0.01 if codec == "ffv1" else 0.005
    assert probe(path).frames_per_second == pytest.approx(rate, rel=tolerance)
    assert probe(path).frames == 300

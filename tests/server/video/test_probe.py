"""What a file holds, found by walking over its packets."""

from __future__ import annotations

from pathlib import Path

import av
import numpy as np
import pytest
from av.stream import Disposition

from tests.clips import damaged, panned_luma, write_clip
from tests.oracles.decoded import decode_luma
from v2v_protocol.errors import VideoError
from v2v_server.video.packets import is_hidden
from v2v_server.video.probe import probe


def stored_packets(path: Path) -> int:
    with av.open(str(path)) as container:
        return sum(packet.size > 0 for packet in container.demux(video=0))


def remuxed(source: Path, target: Path, drop: int = 0, cover: bool = False) -> Path:
    """The same packets in another container, without the first ``drop``; with a cover picture in front if asked."""
    with av.open(str(source)) as container, av.open(str(target), "w") as output:
        if cover:
            picture = output.add_stream("png", rate=1)
            picture.width, picture.height, picture.pix_fmt = 32, 32, "rgb24"
            picture.disposition = Disposition.attached_pic
        track = container.streams.video[0]
        copy = output.add_stream_from_template(track)
        if cover:
            output.mux(picture.encode(av.VideoFrame(32, 32, "rgb24")))
        for number, packet in enumerate(container.demux(track)):
            if packet.size and number >= drop:
                packet.stream = copy
                output.mux(packet)
    return target


def test_hidden_vp8_frames_are_not_counted(tmp_path: Path) -> None:
    plain = write_clip(tmp_path / "plain.webm", panned_luma(30), codec="libvpx", gop=30)
    hidden = tmp_path / "hidden.webm"
    with av.open(str(plain)) as container, av.open(str(hidden), "w") as output:
        track = container.streams.video[0]
        copy = output.add_stream_from_template(track)
        for number, packet in enumerate(container.demux(track)):
            if not packet.size:
                continue
            content = bytearray(bytes(packet))
            if number in (7, 20):
                content[0] &= ~0x10  # show_frame
            again = av.Packet(bytes(content))
            again.pts, again.dts, again.time_base = packet.pts, packet.dts, packet.time_base
            again.is_keyframe, again.stream = packet.is_keyframe, copy
            output.mux(again)
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


def test_cover_pictures_are_not_the_video(tmp_path: Path) -> None:
    plain = write_clip(tmp_path / "plain.mp4", panned_luma(20))
    facts = probe(remuxed(plain, tmp_path / "cover.mp4", cover=True))
    assert (facts.frames, facts.codec, facts.width_px) == (20, "h264", 64)


def test_a_file_cut_in_mid_gop(tmp_path: Path) -> None:
    """What lies in front of the first keyframe cannot be decoded, and is not counted."""
    plain = write_clip(tmp_path / "plain.mkv", panned_luma(40), gop=12, options={"sc_threshold": "0", "qp": "0"})
    cut = remuxed(plain, tmp_path / "cut.mkv", drop=5)
    facts, whole = probe(cut), probe(plain)
    reference = decode_luma(plain, whole.index, 0, 40).frames
    assert facts.frames <= 35
    got = decode_luma(cut, facts.index, 0, facts.frames).frames
    np.testing.assert_array_equal(got, reference[-facts.frames :])


def test_an_open_gop_at_the_beginning(tmp_path: Path) -> None:
    """Leading pictures of the first keyframe lack their reference; the file begins behind them."""
    options = {"x264-params": "open-gop=1:scenecut=0:b-adapt=0", "qp": "0"}
    plain = write_clip(tmp_path / "plain.mkv", panned_luma(40), gop=12, b_frames=3, options=options)
    with av.open(str(plain)) as container:
        keys = [number for number, packet in enumerate(container.demux(video=0)) if packet.is_keyframe]
    cut = remuxed(plain, tmp_path / "cut.mkv", drop=keys[1])
    facts = probe(cut)
    reference = decode_luma(plain, probe(plain).index, 0, 40).frames
    keyframe = int(facts.index.keyframes[0])
    got = decode_luma(cut, facts.index, keyframe, facts.frames - keyframe).frames
    np.testing.assert_array_equal(got, reference[-len(got) :])


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


def test_raw_motion_jpeg_is_a_video(tmp_path: Path) -> None:
    path = write_clip(tmp_path / "raw.mjpeg", panned_luma(30), codec="mjpeg", pixel_format="yuvj420p", full_range=True)
    assert probe(path).frames == 30
    assert decode_luma(path, probe(path).index, 10, 20).frames.shape == (20, 48, 64)

"""Test that a remark names what is not served: a last picture that is cut short, other sizes, tracks and levels."""

from __future__ import annotations

import struct
from contextlib import closing
from pathlib import Path

import av
import numpy as np
import pytest

from tests.clips import panned_luma, truncated, write_clip
from tests.oracles.decoded import decode_luma
from v2v_protocol.recipe import Recipe
from v2v_protocol.spec import StreamSpec
from v2v_server.corpus.catalogue import open_catalogue
from v2v_server.video.probe import probe
from v2v_server.video.source import describe_cut, dolby_vision_profile
from v2v_tools.remake import Remaker

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
        tmp_path / name, panned_luma(40, 144, 192), codec=codec, pixel_format=pixel_format, gop=8,
        full_range=pixel_format.startswith("yuvj"),
    )  # fmt: skip
    facts = probe(path)
    assert (facts.frames, facts.remark) == (40, "")
    whole = decode_luma(path, facts.index, 0, 40).frames
    if name.endswith("mov"):
        path = with_head_in_front(path)
    for share in (0.613, 0.777, 0.95):
        cut = probe(truncated(path, tmp_path / f"cut-{name}", share))
        served = decode_luma(tmp_path / f"cut-{name}", cut.index, 0, cut.frames).frames
        assert cut.frames < 40
        np.testing.assert_array_equal(served, whole[: cut.frames])
        assert cut.remark.startswith("is truncated")


def with_head_in_front(path: Path) -> Path:
    """Move the list of frames to the beginning of the file, as streaming needs it."""
    target = path.with_name(f"fast-{path.name}")
    with av.open(str(path)) as source, av.open(str(target), "w", options={"movflags": "faststart"}) as sink:
        stream = sink.add_stream_from_template(source.streams.video[0])
        for packet in source.demux(video=0):
            if packet.dts is not None:
                packet.stream = stream
                sink.mux(packet)
    return target


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
        (note,) = (note for note in catalogue.notes if "are left out" in note)
        assert note.startswith("1 videos are served in part, or with wrong grey levels (grows.ts: 50 of 80 pictures")
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
        plain = write_clip(tmp_path / f"{number}.mp4", panned_luma(frames, 240, 320), options={"crf": "4"})
        target = tmp_path / f"{number}.ts"
        with av.open(str(plain)) as source, av.open(str(target), "w", options={"mpegts_start_pid": str(pid)}) as sink:
            stream = sink.add_stream_from_template(source.streams.video[0])
            for packet in source.demux(video=0):
                if packet.dts is not None:
                    packet.stream = stream
                    sink.mux(packet)
        parts.append(target.read_bytes())
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
    path = write_clip(tmp_path / name, panned_luma(300), codec=codec, rate=rate)
    tolerance = 0.01 if codec == "ffv1" else 0.005
    assert probe(path).frames_per_second == pytest.approx(rate, rel=tolerance)
    assert probe(path).frames == 300

"""Every frame delivered is exactly the frame that was asked for."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import av
import numpy as np
import numpy.typing as npt
import pytest
from av.bitstream import BitStreamFilterContext
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.clips import damaged, panned_luma, truncated, write_clip
from tests.field_coded import write_field_coded
from tests.oracles.decoded import decode_luma
from v2v_protocol.errors import UsageError, VideoError
from v2v_server.video.decode import ClipRequest, Cut, DecodedClip, decode_cuts
from v2v_server.video.frame_index import unseekable
from v2v_server.video.packets import Fields
from v2v_server.video.picture import range_table
from v2v_server.video.probe import VideoFacts, probe

FRAMES = 50
X265 = "log-level=none:pools=1:frame-threads=1"
UNEVEN = np.cumsum(np.arange(FRAMES) % 7 * 11 + 5).tolist()


@dataclass(frozen=True)
class Kind:
    """A way to store the panned photograph."""

    name: str
    codec: str = "libx264"
    pixel_format: str = "yuv420p"
    shift: int = 0
    full_range: bool = False
    more: dict[str, Any] = field(default_factory=dict)


KINDS = (
    Kind("plain.mp4"),
    Kind("b_frames.mp4", more={"b_frames": 3}),
    Kind("b_frames.mkv", more={"b_frames": 3}),
    Kind("b_frames.ts", more={"b_frames": 3}),
    Kind("b_frames.flv", more={"b_frames": 3}),
    Kind("b_frames.avi", more={"b_frames": 3}),
    Kind("plain.avi"),
    Kind("raw.h264", more={"b_frames": 3}),
    Kind("open_gop.mp4", more={"b_frames": 3, "options": {"x264-params": "open-gop=1"}}),
    Kind("open_gop.mkv", more={"b_frames": 3, "options": {"x264-params": "open-gop=1:bframes=5:b-pyramid=normal"}}),
    Kind("gradual_refresh.mp4", more={"options": {"intra-refresh": "1"}}),
    Kind("ten_bits_422.mp4", pixel_format="yuv422p10le", shift=2, more={"b_frames": 2}),
    Kind("yuv444.mp4", pixel_format="yuv444p", more={"b_frames": 2}),
    Kind("full_range.mp4", pixel_format="yuvj420p", full_range=True, more={"b_frames": 2}),
    Kind("uneven_times.mkv", more={"b_frames": 2, "pts": UNEVEN}),
    Kind("uneven_times.mp4", more={"b_frames": 2, "pts": UNEVEN}),
    Kind("sound.mp4", more={"b_frames": 2, "audio": True}),
    Kind("lossless.mp4", more={"b_frames": 3, "options": {"qp": "0"}}),
    Kind("hevc.mp4", "libx265", more={"b_frames": 3, "options": {"x265-params": f"{X265}:open-gop=1"}}),
    Kind("hevc10.mkv", "libx265", "yuv420p10le", 2, more={"b_frames": 3, "options": {"x265-params": X265}}),
    Kind("hevc12.mp4", "libx265", "yuv444p12le", 4, more={"options": {"x265-params": X265}}),
    Kind("vp8.webm", "libvpx", more={"options": {"auto-alt-ref": "1", "lag-in-frames": "16", "b": "60k"}}),
    Kind("vp9.webm", "libvpx-vp9", more={"options": {"auto-alt-ref": "1", "lag-in-frames": "16", "cpu-used": "8"}}),
    Kind("mpeg4.mp4", "mpeg4", more={"b_frames": 2}),
    Kind("mpeg4.avi", "mpeg4", more={"b_frames": 2}),
    Kind("mpeg2.mpg", "mpeg2video", more={"b_frames": 2}),
    Kind("mpeg2.mkv", "mpeg2video", "yuv422p", more={"b_frames": 2}),
    Kind("mjpeg.avi", "mjpeg", "yuvj422p", full_range=True),
    Kind("mjpeg.mov", "mjpeg", "yuvj420p", full_range=True),
    Kind("ffv1.mkv", "ffv1"),
    Kind("ffv1_16.mkv", "ffv1", "yuv420p16le", 8),
    Kind("huffyuv.avi", "huffyuv", "yuv422p"),
    Kind("rgb.mov", "png", "rgb24", full_range=True, more={"full_range": None}),
)


@dataclass(frozen=True)
class Clip:
    """A stored clip with what must come out of it."""

    path: Path
    kind: Kind
    facts: VideoFacts
    whole: DecodedClip
    reference: npt.NDArray[np.uint8]


def reference_grey(path: Path) -> npt.NDArray[np.uint8]:
    """The slow oracle: swscale's grey of every frame, read in one go."""
    with av.open(str(path)) as container:
        return np.stack([frame.reformat(format="gray").to_ndarray() for frame in container.decode(video=0)])


@pytest.fixture(scope="module", params=KINDS, ids=lambda kind: kind.name)
def clip(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Clip:
    kind = request.param
    luma = panned_luma(FRAMES, 54, 70, full_range=kind.full_range)
    path = tmp_path_factory.mktemp("clips") / kind.name
    options = {"full_range": kind.full_range} | kind.more
    stored = luma.astype(np.uint16) << kind.shift if kind.shift else luma
    write_clip(path, stored, codec=kind.codec, pixel_format=kind.pixel_format, **options)
    facts = probe(path)
    return Clip(path, kind, facts, decode_luma(path, facts.index, 0, FRAMES), reference_grey(path))


def test_the_whole_clip_is_the_independent_reference(clip: Clip) -> None:
    facts, kind, whole = clip.facts, clip.kind, clip.whole
    assert (facts.frames, facts.height_px, facts.width_px) == (FRAMES, 54, 70)
    assert facts.full_range == kind.full_range
    assert whole.frames.flags.c_contiguous
    assert whole.frames.dtype == np.uint8
    # Deeper formats are rounded once here, and dithered or truncated by swscale.
    difference = np.abs(whole.frames.astype(int) - clip.reference)
    assert difference.max() <= (1 if kind.shift else 0)
    by_standard = not kind.codec.startswith(("mpeg", "mjpeg"))
    assert whole.bit_exact == by_standard


@settings(max_examples=10, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_any_cuts_of_one_pass_equal_sequential_decoding(clip: Clip, data: st.DataObject) -> None:
    start, stride = data.draw(st.integers(0, FRAMES - 1)), data.draw(st.integers(1, 4))
    height, width = clip.facts.height_px, clip.facts.width_px
    cuts = []
    for _ in range(data.draw(st.integers(1, 3))):
        top, left = data.draw(st.integers(0, height - 1)), data.draw(st.integers(0, width - 1))
        window = (top, left, data.draw(st.integers(1, height - top)), data.draw(st.integers(1, width - left)))
        count = data.draw(st.integers(1, min(12, (FRAMES - 1 - start) // stride + 1)))
        cuts.append(Cut(count, data.draw(st.sampled_from((window, None)))))
    part = clip.facts.index.slice(start, (max(cut.count for cut in cuts) - 1) * stride + 1)
    index = data.draw(st.sampled_from((part, clip.facts.index)))
    frames = clip.whole.frames if clip.kind.shift else clip.reference
    for got, cut in zip(decode_cuts(clip.path, ClipRequest(index, start, tuple(cuts), stride)), cuts, strict=True):
        top, left, rows, columns = cut.window or (0, 0, height, width)
        shown = slice(start, start + cut.count * stride, stride)
        np.testing.assert_array_equal(got.frames, frames[shown, top : top + rows, left : left + columns])
        np.testing.assert_array_equal(got.seconds, clip.whole.seconds[shown])
        assert got.frames.flags.c_contiguous
        assert got.codec == clip.facts.codec


def test_presentation_times(clip: Clip) -> None:
    seconds = decode_luma(clip.path, clip.facts.index, 3, 20).seconds
    assert clip.facts.index.seekable == (clip.kind.name not in {"b_frames.avi", "mpeg4.avi", "raw.h264"})
    if not clip.facts.index.seekable:
        assert np.isnan(seconds).all()
        return
    stated = clip.kind.more.get("pts")
    wanted = np.diff(stated[3:23]) / 1000 if stated else np.full(19, 1 / 25)
    np.testing.assert_allclose(np.diff(seconds), wanted, atol=0.0011)  # matroska and flv count milliseconds


def test_av1(tmp_path: Path) -> None:
    path = tmp_path / "clip.mp4"
    options = {"preset": "12", "svtav1-params": "lp=1"}
    policy, priority = os.sched_getscheduler(0), os.sched_getparam(0)
    write_clip(path, panned_luma(40, 64, 96, full_range=False), codec="libsvtav1", options=options)
    os.sched_setscheduler(0, policy, priority)  # for root this encoder puts its caller before everybody else
    facts, reference = probe(path), reference_grey(path)
    assert facts.codec == "av1"
    for start in (0, 5, 12, 27, 39):
        got = decode_luma(path, facts.index, start, min(6, 40 - start))
        np.testing.assert_array_equal(got.frames, reference[start : start + 6])


@pytest.mark.parametrize("degrees", [0, 90, 180, -90])
@pytest.mark.parametrize("hflip", [False, True])
def test_rotation_metadata(tmp_path: Path, degrees: int, hflip: bool) -> None:
    luma = panned_luma(10, 48, 64)
    path = write_clip(
        tmp_path / "clip.mp4", luma, full_range=True, options={"qp": "0"}, rotation_degrees=degrees, hflip=hflip
    )
    with av.open(str(path)) as container:
        stated = next(container.decode(video=0)).rotation
    facts = probe(path)
    upright = decode_luma(path, facts.index, 0, 10).frames
    # A display matrix mirrors the stored picture first and turns the result.
    flipped = luma[:, :, ::-1] if hflip else luma
    if not hflip:
        np.testing.assert_array_equal(upright, np.rot90(flipped, stated // 90, axes=(1, 2)))
    candidates = [np.rot90(flipped, turn, axes=(1, 2)) for turn in range(4)]
    assert sum(np.array_equal(upright, candidate) for candidate in candidates) == 1
    assert (facts.height_px, facts.width_px) == upright.shape[1:]
    assert facts.rotation_degrees == stated
    window = decode_luma(path, facts.index, 2, 5, (3, 7, 11, 13)).frames
    np.testing.assert_array_equal(window, upright[2:7, 3:14, 7:20])


@pytest.mark.parametrize("turn", ["rotate=90", "rotate=180", "flip=horizontal", "flip=vertical"])
def test_an_orientation_that_is_stated_with_keyframes_only_holds_for_all_frames(tmp_path: Path, turn: str) -> None:
    plain = write_clip(tmp_path / "plain.mp4", panned_luma(36), b_frames=2, options={"x264-params": "scenecut=0"})
    path = tmp_path / "turned.mp4"
    with av.open(str(plain)) as source, av.open(str(path), "w") as output:
        track = source.streams.video[0]
        copy = output.add_stream_from_template(track)
        insert = BitStreamFilterContext(f"h264_metadata=display_orientation=insert:{turn}", track, copy)
        for packet in source.demux(track):
            for changed in insert.filter(packet if packet.size else None):
                changed.stream = copy
                output.mux(changed)
    facts, stored = probe(path), decode_luma(plain, probe(plain).index, 0, 36).frames
    turned = {
        "rotate=90": np.rot90(stored, axes=(1, 2)), "rotate=180": np.rot90(stored, 2, axes=(1, 2)),
        "flip=horizontal": stored[:, :, ::-1], "flip=vertical": stored[:, ::-1],
    }[turn]  # fmt: skip
    for start, count in ((0, 36), (5, 10), (13, 20), (30, 6)):
        got = decode_luma(path, facts.index, start, count).frames
        np.testing.assert_array_equal(got, turned[start : start + count])


def test_a_container_that_lies_about_keyframes(tmp_path: Path) -> None:
    """The index calls a P-frame a keyframe: the decoder does not, and counting from the beginning wins."""
    path = write_clip(tmp_path / "clip.mp4", panned_luma(40), gop=100, options={"qp": "0"})
    index = probe(path).index
    reference = decode_luma(path, index, 0, 40).frames
    lying = type(index)(
        index.first, index.pts, np.array([0, 20]), index.pts[[0, 20]], index.time_base, 48, 64, seekable=True
    )
    np.testing.assert_array_equal(decode_luma(path, lying, 25, 5).frames, reference[25:30])


def test_truncated_file(tmp_path: Path) -> None:
    whole = write_clip(tmp_path / "whole.mkv", panned_luma(60), options={"qp": "0"})
    index = probe(whole).index
    short = truncated(whole, tmp_path / "short.mkv", 0.5)
    with pytest.raises(VideoError) as caught:
        decode_luma(short, index, 0, 60)
    assert caught.value.frame is not None
    assert 10 < caught.value.frame < 45
    good = decode_luma(short, index, 0, caught.value.frame).frames
    np.testing.assert_array_equal(good, decode_luma(whole, index, 0, caught.value.frame).frames)


@pytest.mark.parametrize(
    ("codec", "options"),
    [
        ("libx264", {"sc_threshold": "0"}),
        ("libx265", {"x265-params": f"{X265}:scenecut=0"}),
        ("libvpx", {}),
        ("libvpx-vp9", {"cpu-used": "8"}),
        ("mpeg4", {"sc_threshold": "1000000"}),
        ("mpeg2video", {"sc_threshold": "1000000"}),
        ("ffv1", {}),
    ],
)
def test_damage_is_refused_and_does_not_spread(tmp_path: Path, codec: str, options: dict[str, str]) -> None:
    whole = write_clip(tmp_path / "whole.mkv", panned_luma(60), gop=12, codec=codec, options=options, full_range=None)
    bad = damaged(whole, tmp_path / "bad.mkv", packet=17)
    index = probe(bad).index
    assert len(index) == 60
    reference = decode_luma(whole, index, 0, 60).frames
    np.testing.assert_array_equal(decode_luma(bad, index, 0, 16).frames, reference[:16])
    for start in (15, 19, 21):
        with pytest.raises(VideoError) as caught:
            decode_luma(bad, index, start, 3)
        assert caught.value.frame is not None
        assert start <= caught.value.frame < start + 3
    np.testing.assert_array_equal(decode_luma(bad, index, 24, 36).frames, reference[24:])


@pytest.mark.parametrize(
    ("start", "count", "window", "words"),
    [
        *((*frames, (), r"holds 0 \.\. 19") for frames in ((0, 0), (-1, 3), (0, 21), (20, 1))),
        *((0, 5, [each], "64x48 px") for each in ((0, 0, 49, 64), (0, 1, 48, 64), (-1, 0, 4, 4), (0, 0, 0, 4))),
    ],
)
def test_ranges_outside_the_index_and_windows_outside_the_picture(
    tmp_path: Path, start: int, count: int, window: list[tuple[int, int, int, int]], words: str
) -> None:
    path = write_clip(tmp_path / "clip.mp4", panned_luma(20))
    with pytest.raises(UsageError, match=words):
        decode_luma(path, probe(path).index, start, count, *window)


def test_missing_file(tmp_path: Path) -> None:
    path = write_clip(tmp_path / "clip.mp4", panned_luma(5))
    index = probe(path).index
    path.unlink()
    with pytest.raises(VideoError, match="cannot be opened: No such file"):
        decode_luma(path, index, 0, 5)


def test_a_damaged_frame_that_the_stride_leaves_out_spoils_what_refers_to_it(tmp_path: Path) -> None:
    """The first frame that cannot be had is named by its place in the file, whatever the stride."""
    write_clip(tmp_path / "whole.mp4", panned_luma(60, 48, 64), gop=60)
    damaged(tmp_path / "whole.mp4", tmp_path / "bad.mp4", 30)
    index = probe(tmp_path / "whole.mp4").index
    with pytest.raises(VideoError) as caught:
        decode_cuts(tmp_path / "bad.mp4", ClipRequest(index, 0, (Cut(20),), 3))
    assert caught.value.frame is not None
    assert caught.value.frame % 3 == 0
    assert 30 <= caught.value.frame <= 33


def test_a_range_that_is_stated_only_later_ends_no_clip(tmp_path: Path) -> None:
    """It is the same all along, because a range that is not stated is the limited one."""
    parts = [
        write_clip(tmp_path / f"{stated}.h264", panned_luma(24, full_range=False), full_range=stated)
        for stated in (None, False, True)
    ]
    silent, limited, full = (part.read_bytes() for part in parts)
    (tmp_path / "later.h264").write_bytes(silent + limited)
    path = tmp_path / "later.h264"
    assert decode_luma(path, probe(path).index, 12, 24).frames.shape[0] == 24
    (tmp_path / "changed.h264").write_bytes(limited + full)
    path = tmp_path / "changed.h264"
    assert probe(path).frames == 24
    longer = unseekable(48, (1, 25), 48, 64)
    with pytest.raises(VideoError, match=r"from yuv420p \(8 bits, limited range\) to yuvj?420p \(8 bits, full range\)"):
        decode_luma(path, longer, 12, 24)


# --- a picture that is stored as two fields: one frame each -----------------------------------------------------------

LUMA = panned_luma(20, 64, 48, full_range=False)


@pytest.mark.parametrize("together", [False, True], ids=["apart", "together"])
@pytest.mark.parametrize("suffix", ["ts", "mkv", "mp4", "h264"])
def test_two_fields_are_one_frame(tmp_path: Path, suffix: str, together: bool) -> None:
    path = write_field_coded(tmp_path / f"clip.{suffix}", LUMA, together=together)
    facts = probe(path)
    assert (facts.frames, facts.height_px, facts.interlaced) == (20, 64, True)
    assert facts.index.seekable == (suffix != "h264")
    assert facts.frames_per_second == pytest.approx(25, rel=0.01)
    known = range_table(8, False)[LUMA]
    for start, count in ((0, 20), (0, 1), (5, 3), (7, 6), (13, 7), (19, 1)):
        got = decode_luma(path, facts.index.slice(start, count), start, count)
        np.testing.assert_array_equal(got.frames, known[start : start + count])


def test_a_range_is_decoded_from_its_keyframe(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Not from the beginning, which is the way out where a seek fails."""
    path, plain = write_field_coded(tmp_path / "clip.ts", LUMA), write_clip(tmp_path / "a.mp4", LUMA, gop=6, b_frames=2)
    index = probe(path).index
    np.testing.assert_array_equal(index.keyframes, [0, 6, 12, 18])
    monkeypatch.setattr("v2v_server.video.decode._from_beginning", lambda stack: pytest.fail("the seek failed"))
    np.testing.assert_array_equal(decode_luma(path, index, 14, 3).frames, range_table(8, False)[LUMA[14:17]])
    np.testing.assert_array_equal(decode_luma(plain, probe(plain).index, 14, 3).frames, reference_grey(plain)[14:17])


def test_damaged_parameters_and_packets_are_left_to_the_decoder(tmp_path: Path) -> None:
    path = write_field_coded(tmp_path / "clip.h264", LUMA[:4])
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        extradata = stream.codec_context.extradata or b""
        packets = [bytes(packet) for packet in container.demux(stream) if packet.size]
    chance = np.random.default_rng(0)
    for _ in range(300):
        fields = Fields(bytes(_flipped(extradata, chance)))
        for packet in packets:
            assert fields.begins_frame(memoryview(_flipped(packet, chance))) in (True, False)
    for content in (b"", b"\x01\x4d\x40\x1f\xff\xe1", b"\x01\x4d\x40\x1f\xff\xff\xff\xff", b"\0\0\1", b"\0\0\1\x67"):
        assert Fields(content).begins_frame(memoryview(b"\0\0\1\x67\0\0\1\x61\0\0\1"))


def _flipped(content: bytes, chance: np.random.Generator) -> bytearray:
    changed = bytearray(content[:64])
    for at in chance.integers(0, len(changed), 4):
        changed[at] ^= 1 << chance.integers(0, 8)
    return changed + content[64:]

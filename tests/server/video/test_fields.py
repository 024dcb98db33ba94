"""H.264 that stores a picture as two fields: one frame each, and every frame the one that was asked for."""

from __future__ import annotations

from pathlib import Path

import av
import numpy as np
import pytest

from tests.clips import panned_luma, write_clip
from tests.field_coded import write_field_coded
from tests.oracles.decoded import decode_luma
from v2v_server.video.packets import Fields
from v2v_server.video.picture import range_table
from v2v_server.video.probe import probe

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
    path = write_field_coded(tmp_path / "clip.ts", LUMA)
    index = probe(path).index
    np.testing.assert_array_equal(index.keyframes, [0, 6, 12, 18])
    monkeypatch.setattr("v2v_server.video.decode._from_beginning", lambda stack: pytest.fail("the seek failed"))
    np.testing.assert_array_equal(decode_luma(path, index, 14, 3).frames, range_table(8, False)[LUMA[14:17]])


def test_an_interlaced_encoding_is_said_and_a_progressive_one_is_not(tmp_path: Path) -> None:
    mixed = write_clip(tmp_path / "mixed.mp4", panned_luma(12, 64, 64), options={"x264-params": "interlaced=1"})
    plain = write_clip(tmp_path / "plain.mp4", panned_luma(12, 64, 64))
    old = write_clip(
        tmp_path / "old.mpg", panned_luma(12, 64, 64), codec="mpeg2video", options={"flags": "+ildct+ilme"}
    )
    assert [probe(path).interlaced for path in (mixed, plain, old)] == [True, False, True]
    assert [probe(path).frames for path in (mixed, plain, old)] == [12, 12, 12]


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

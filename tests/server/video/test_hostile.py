"""Files that a stranger made: each is refused with its reason before much is allocated, and none opens another."""

from __future__ import annotations

import os
import struct
import zlib
from pathlib import Path

import av
import numpy as np
import pytest

from tests.clips import panned_luma, write_clip
from v2v_protocol.errors import VideoError
from v2v_server.corpus.probe import probe_files
from v2v_server.corpus.sources.folder import Folder
from v2v_server.video import probe as probing
from v2v_server.video import source
from v2v_server.video.decode import ClipRequest, Cut, decode_cuts
from v2v_server.video.picture import ChromaCut
from v2v_server.video.probe import probe
from v2v_server.video.source import CODECS, FORMATS

PLAYLISTS = {
    "concat.mp4": "ffconcat version 1.0\nfile {clip}\n",
    "hls.ts": "#EXTM3U\n#EXT-X-TARGETDURATION:10\n#EXTINF:10,\n{clip}\n#EXT-X-ENDLIST\n",
    "dash.mp4": '<?xml version="1.0"?>\n<MPD xmlns="urn:mpeg:dash:schema:mpd:2011" type="static"><Period>'
    '<AdaptationSet contentType="video"><Representation id="0" mimeType="video/mp4"><BaseURL>{clip}</BaseURL>'
    "</Representation></AdaptationSet></Period></MPD>\n",
    "image2.mkv": "%d.png\n",
    "sdp.avi": "v=0\no=- 0 0 IN IP4 127.0.0.1\ns=x\nc=IN IP4 127.0.0.1\nt=0 0\nm=video 5004 RTP/AVP 96\n",
}


@pytest.mark.parametrize("name", PLAYLISTS)
def test_a_file_that_names_others_is_refused_and_opens_none(tmp_path: Path, name: str) -> None:
    clip = write_clip(tmp_path / "clip.mp4", panned_luma(5))
    os.utime(clip, ns=(0, 0))  # reading it would set the access time, where the file system keeps one
    (tmp_path / name).write_text(PLAYLISTS[name].format(clip="clip.mp4"))
    with pytest.raises(VideoError, match=r"is of no format that is read here|Invalid data"):
        probe(tmp_path / name)
    assert clip.stat().st_atime_ns == 0


def test_a_playlist_that_ffmpeg_would_open_is_refused_by_the_list_of_formats(tmp_path: Path) -> None:
    """The test above would pass as well if FFmpeg did not know the file for a playlist, or no time were kept."""
    clip = write_clip(tmp_path / "clip.mp4", panned_luma(5))
    os.utime(clip, ns=(0, 0))
    path = tmp_path / "concat.mp4"
    path.write_text(PLAYLISTS["concat.mp4"].format(clip="clip.mp4"))
    with av.open(str(path)) as container:
        assert container.format.name == "concat"
    if not os.statvfs(tmp_path).f_flag & os.ST_NOATIME:
        assert clip.stat().st_atime_ns > 0
    with pytest.raises(VideoError, match=r"is of no format that is read here.*matroska"):
        probe(path)


@pytest.mark.parametrize("codec", ["magicyuv", "cinepak", "snow"])
def test_a_codec_that_is_not_on_the_list_is_refused_by_name(tmp_path: Path, codec: str) -> None:
    options = {"strict": "-2"} if codec == "snow" else None
    pixels = "rgb24" if codec == "cinepak" else "gbrp" if codec == "magicyuv" else "yuv420p"
    path = write_clip(tmp_path / "clip.avi", panned_luma(3), codec=codec, pixel_format=pixels, options=options)
    with pytest.raises(VideoError, match=f"holds {codec} video, which is not read here"):
        probe(path)


def test_every_name_on_the_lists_is_one_of_ffmpegs() -> None:
    known = {name for names in av.formats_available for name in names.split(",")}
    assert set(FORMATS) <= known
    assert set(CODECS) <= set(av.codec.codecs_available)
    assert not set(FORMATS) & {"concat", "hls", "dash", "image2", "lavfi", "sdp", "rtsp", "imf", "webm_dash_manifest"}


def test_a_picture_with_too_many_pixels_is_refused_before_it_is_decoded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("v2v_server.video.probe.LARGEST_INDEXED_SIDE_PX", 63)
    with pytest.raises(VideoError, match="of 64x48 px are larger than 63 px a side"):
        probe(write_clip(tmp_path / "wide.mkv", panned_luma(3)))
    assert source.LARGEST_PICTURE_PX == 8192 * 8192
    monkeypatch.setattr(source, "LARGEST_PICTURE_PX", 64 * 48 - 1)
    with pytest.raises(VideoError, match="64x48 px is larger than 3071 pixels"):
        probe(write_clip(tmp_path / "large.mkv", panned_luma(3)))
    # Where only the stream itself states the size, the decoder refuses it.
    with pytest.raises(VideoError, match=r"64x48 px is larger than 3071 pixels|no frame decodes"):
        probe(write_clip(tmp_path / "raw.h264", panned_luma(3)))


def test_no_more_streams_are_made_than_the_limit(tmp_path: Path) -> None:
    path = tmp_path / "many.mkv"
    with av.open(str(path), "w") as output:
        streams = [output.add_stream("ffv1", rate=25) for _ in range(source.MOST_STREAMS + 20)]
        for stream in streams:
            stream.width, stream.height, stream.pix_fmt = 2, 2, "gray"  # type: ignore[attr-defined]
        for stream in streams:
            output.mux(stream.encode(av.VideoFrame(2, 2, "gray")))  # type: ignore[attr-defined]
    with source.opened(path) as (container, _):
        assert len(container.streams) == source.MOST_STREAMS
    assert probe(path).frames == 1


def test_a_file_that_claims_a_thousand_million_frames_is_given_no_room_for_them(tmp_path: Path) -> None:
    """Their list would take 40 GB. Its neighbours are served."""
    write_clip(tmp_path / "good.mov", panned_luma(5))
    whole = write_clip(tmp_path / "claim.mov", panned_luma(3), codec="mjpeg", pixel_format="yuvj420p")
    content, count = bytearray(whole.read_bytes()), 10**9
    for atom, at, fields in (("stsz", 8, (1, count)), ("stsc", 8, (1, 1, count, 1)), ("stts", 12, (count,))):
        start = content.index(atom.encode()) + at
        content[start : start + 4 * len(fields)] = struct.pack(f">{len(fields)}I", *fields)
    whole.write_bytes(content)
    records = {record.id: record for record in probe_files(Folder(tmp_path), ["claim.mov", "good.mov"], 1)}
    assert records["good.mov"].frames == 5
    assert records["claim.mov"].problem is not None
    assert records["claim.mov"].size_bytes > 0  # it is not read again at each start


def _atom(name: bytes, content: bytes) -> bytes:
    return struct.pack(">I4s", 8 + len(content), name) + content


def test_metadata_that_grow_when_they_are_unpacked_are_refused(tmp_path: Path) -> None:
    """QuickTime may compress its table of contents (cmov): 64 kB make 64 MiB here. What may be made at all is the
    limit of the process's memory."""
    packed = zlib.compress(bytes(64 << 20), 9)
    bombs = {"as it says.mov": 64 << 20, "more than it says.mov": 1 << 20, "4 GiB.mov": 2**32 - 1}
    for name, claimed in bombs.items():
        moov = _atom(b"cmov", _atom(b"dcom", b"zlib") + _atom(b"cmvd", struct.pack(">I", claimed) + packed))
        content = _atom(b"ftyp", b"qt  \0\0\0\0qt  ") + _atom(b"moov", moov) + _atom(b"mdat", bytes(100))
        (tmp_path / name).write_bytes(content)
    records = list(probe_files(Folder(tmp_path), bombs, 1))
    assert {record.id for record in records} == bombs.keys()
    for record in records:
        assert record.problem in (
            "has no video track",
            "cannot be opened: Invalid data found when processing input",
            "cannot be opened: Cannot allocate memory",
        )
        assert record.size_bytes == (tmp_path / record.id).stat().st_size  # it is not read again at each start


def test_a_list_of_frames_that_never_ends_is_given_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    clip = write_clip(tmp_path / "clip.mp4", panned_luma(30))
    monkeypatch.setattr(probing, "LARGEST_FRAMES", 20)
    with pytest.raises(VideoError, match="holds more than 20 frames"):
        probe(clip)
    monkeypatch.undo()
    monkeypatch.setattr(probing, "LONGEST_CPU_SECONDS", -1.0)
    with pytest.raises(VideoError, match="of processor time to list its frames"):
        probe(clip)


@pytest.mark.parametrize(("plane", "colour"), [(0, ""), (1, "colour ")])
def test_a_raw_sample_beyond_its_bits_is_a_damaged_frame(tmp_path: Path, plane: int, colour: str) -> None:
    """FFmpeg passes on the numbers of a raw video as they are."""
    header = b"YUV4MPEG2 W32 H32 F25:1 Ip A1:1 C420p10 XYSCSS=420P10\n"
    frames = np.full((24, 32 * 32 * 3 // 2), 512, "<u2")
    frames[20, (0, 32 * 32)[plane] + 77] = 5000
    path = tmp_path / "raw.y4m"
    path.write_bytes(header + b"".join(b"FRAME\n" + frame.tobytes() for frame in frames))
    facts = probe(path)
    wanted = Cut(24, chroma=ChromaCut(tuple(range(24)), (0, 0, 32, 32), (0, 32)))
    with pytest.raises(VideoError, match=f"at frame 20: has a {colour}sample of 5000, beyond its 10 bits"):
        decode_cuts(path, ClipRequest(facts.index, 0, (wanted,)))
    assert len(decode_cuts(path, ClipRequest(facts.index, 0, (Cut(20),)))[0].frames) == 20


def test_what_is_no_file_is_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.mp4")
    with pytest.raises(VideoError, match="is not a regular file"):
        probe(tmp_path / "pipe.mp4")

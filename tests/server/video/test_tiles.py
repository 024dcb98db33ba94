"""Pictures in tiles: a window of them is the same window of the whole, and costs only the tiles it touches."""

from __future__ import annotations

import dataclasses
import itertools
import re
import shutil
from contextlib import closing
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.clips import panned_luma
from tests.server.prepare.test_prepare import opened, psnr_db, run, whole
from tests.server.prepare.test_prepare_served import ROWS, SPEC
from v2v_protocol.errors import CorpusError, UsageError, VideoError
from v2v_server.catalogue.catalogue import open_catalogue
from v2v_server.offline.remake import remake
from v2v_server.prepare.encode import CODECS, Encoding, encode_luma
from v2v_server.prepare.transcode import luma_frames
from v2v_server.store.manifest import read_manifest
from v2v_server.video import decode
from v2v_server.video.collect import Cut
from v2v_server.video.decode import decode_cuts, decode_luma
from v2v_server.video.frame_index import MOST_TILES, FrameIndex, Tile, make_up
from v2v_server.video.probe import probe
from v2v_server.video.rows import Rows
from v2v_server.video.tiles import KEY, MARK, NARROWEST_PX, columns, parts, split

FRAMES, HEIGHT, WIDTH = 30, 48, 300
TILED = Encoding("h264", 18, 12, tile_px=96)
OVERLAPPING = Encoding("h264", 18, 12, tile_px=140, tile_overlap_px=64)


def write(
    path: Path, luma: npt.NDArray[np.uint8], encoding: Encoding = TILED, time_base: Fraction = Fraction(1, 25)
) -> Path:
    count, height, width = luma.shape
    encode_luma(path, luma, encoding, height=height, width=width, pts=range(count), time_base=time_base)
    return path


def by_track(path: Path) -> npt.NDArray[np.uint8]:
    """The oracle: every track decoded from its beginning, in full range, and put side by side."""
    tiles = []
    with av.open(str(path)) as container:
        tracks = len(container.streams.video)
    for track in range(tracks):
        with av.open(str(path)) as container:
            frames = [frame.reformat(format="gray") for frame in container.decode(video=track)]
            tiles.append(np.stack([frame.to_ndarray() for frame in frames]))
    return np.concatenate(tiles, axis=2)


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("tiles") / "clip.mp4", panned_luma(FRAMES, HEIGHT, WIDTH, step=(1, 3)))


@pytest.fixture(scope="module")
def overlapping(tmp_path_factory: pytest.TempPathFactory) -> Path:
    luma = panned_luma(FRAMES, HEIGHT, WIDTH, step=(1, 3))
    return write(tmp_path_factory.mktemp("overlapping") / "clip.mp4", luma, OVERLAPPING)


@pytest.fixture(scope="module")
def oracle(clip: Path) -> npt.NDArray[np.uint8]:
    return by_track(clip)


@st.composite
def cuttings(draw: st.DrawFn) -> tuple[int, int, int]:
    """(width, tile, overlap) of a picture that is worth cutting."""
    overlap = draw(st.integers(0, 300))
    tile = overlap + draw(st.integers(NARROWEST_PX, 400))
    return draw(st.integers(2 * tile - overlap, 4000)), tile, overlap


@given(cuttings())
def test_tiles_make_up_the_picture(cutting: tuple[int, int, int]) -> None:
    width, tile, overlap = cutting
    tiles = split(width, tile, overlap)
    assert make_up(tiles, width)
    assert all(each.left_px % 16 == 0 for each in tiles)
    assert all(a.right_px - b.left_px == overlap for a, b in itertools.pairwise(tiles))
    even = (width + (len(tiles) - 1) * overlap) / len(tiles)
    assert all(abs(each.width_px - even) <= 16 for each in tiles)
    assert len(tiles) == MOST_TILES or abs(even - tile) <= tile / 2


@given(st.integers(1, 2000), st.integers(NARROWEST_PX, 1000))
def test_what_is_not_worth_cutting_stays_whole(width: int, tile: int) -> None:
    assert split(width, 0) == ()
    assert (split(width, tile) == ()) == (round(width / tile) < 2)


def test_which_pictures_stay_whole_is_as_documented() -> None:
    text = (Path(__file__).parents[3] / "docs" / "prepare.md").read_text()
    told = re.findall(r"below (\d+)[a-z ]* with `--tile-width (\d+)(?: --tile-overlap (\d+))?`", text)
    assert len(told) == 2
    for narrowest, *asked in told:
        tile, overlap = (int(number or 0) for number in asked)
        assert split(int(narrowest) - 1, tile, overlap) == ()
        assert len(split(int(narrowest), tile, overlap)) == 2


@given(cuttings(), st.data())
def test_parts_make_up_the_window(cutting: tuple[int, int, int], data: st.DataObject) -> None:
    whole_width, _, overlap = cutting
    tiles = split(*cutting)
    left = data.draw(st.integers(0, whole_width - 1))
    width = data.draw(st.integers(1, whole_width - left))
    picture = np.arange(7 * whole_width).reshape(7, -1).astype(np.uint8)
    stored = columns(picture, tiles)
    found = parts((2, left, 3, width), tiles)
    pieces = []
    for part in found:
        top, first, height, size = part.window
        assert part.left == sum(piece.shape[1] for piece in pieces)
        pieces.append(stored[part.track][top : top + height, first : first + size])
        assert pieces[-1].shape == (height, size)  # nothing reaches out of its tile
    np.testing.assert_array_equal(np.concatenate(pieces, axis=1), picture[2:5, left : left + width])
    assert all(part.window[3] for part in found)  # none is touched for nothing
    if width <= overlap:
        assert len(found) == 1


@given(cuttings(), st.data())
def test_a_window_within_another_comes_from_the_same_tiles(cutting: tuple[int, int, int], data: st.DataObject) -> None:
    tiles = split(*cutting)
    core = data.draw(st.integers(0, cutting[0] - 1))
    width = data.draw(st.integers(1, cutting[0] - core))
    left = data.draw(st.integers(0, core))
    right = data.draw(st.integers(core + width, cutting[0]))
    alone, around = parts((2, core, 3, width), tiles), parts((2, left, 3, right - left), tiles, core)
    tracks = [part.track for part in around]
    assert tracks == sorted(set(tracks))  # one part a tile
    owners = [
        np.repeat([part.track for part in found], [part.window[3] for part in found]) for found in (alone, around)
    ]
    np.testing.assert_array_equal(owners[1][core - left :][:width], owners[0])
    at = 0
    for part in around:
        assert (part.left, tiles[part.track].left_px + part.window[1]) == (at, left + at)
        at += part.window[3]
    assert at == right - left


def test_flow_changes_no_other_array(overlapping: Path, tmp_path: Path) -> None:
    """What lies around a crop is of other tiles than the crop, and some of them hold columns of the crop too."""
    spec = dataclasses.replace(SPEC, flow_method="dis-ultrafast")
    with closing(open_catalogue(overlapping, cache_dir=tmp_path, processes=0)) as catalogue:
        for seed in range(8):
            without, with_flow = (
                remake(catalogue, spec, seed=seed, epoch=0, index=0, arrays=arrays)
                for arrays in (("voxels", "frames"), ("voxels", "frames", "flow"))
            )
            for name, array in without.arrays.items():
                np.testing.assert_array_equal(with_flow.arrays[name], array)


def test_the_picture_is_whole(clip: Path, oracle: npt.NDArray[np.uint8]) -> None:
    facts = probe(clip)
    assert facts.index.tiles == ((0, 96), (96, 96), (192, 108))
    assert (facts.frames, facts.height_px, facts.width_px) == (FRAMES, HEIGHT, WIDTH)
    assert FrameIndex.from_bytes(facts.index.to_bytes()).tiles == facts.index.tiles
    assert facts.index.slice(13, 4).tiles == facts.index.tiles
    decoded = whole(clip)
    np.testing.assert_array_equal(decoded, oracle)
    assert psnr_db(decoded, panned_luma(FRAMES, HEIGHT, WIDTH, step=(1, 3))) > 40


@pytest.mark.parametrize("codec", CODECS)
def test_every_codec(codec: str, tmp_path: Path) -> None:
    luma = panned_luma(14, 49, 231)
    path = write(tmp_path / "clip.mp4", luma, Encoding(codec, CODECS[codec].default, 5, tile_px=64))
    index = probe(path).index
    assert len(index.tiles) == 4
    assert index.keyframes.tolist() == (list(range(14)) if codec == "mjpeg" else [0, 5, 10])
    part = decode_luma(path, index, 6, 7, (3, 50, 40, 150)).frames
    np.testing.assert_array_equal(part, whole(path)[6:13, 3:43, 50:200])
    assert psnr_db(whole(path), luma) > 38


@settings(max_examples=40)
@given(st.data())
def test_any_window_is_that_of_the_whole(clip: Path, oracle: npt.NDArray[np.uint8], data: st.DataObject) -> None:
    index = probe(clip).index
    stride = data.draw(st.integers(1, 3))
    start = data.draw(st.integers(0, FRAMES - 1))
    cuts = []
    for _ in range(data.draw(st.integers(1, 3))):
        top, left = data.draw(st.integers(0, HEIGHT - 1)), data.draw(st.integers(0, WIDTH - 1))
        size = data.draw(st.integers(1, HEIGHT - top)), data.draw(st.integers(1, WIDTH - left))
        cuts.append(Cut(data.draw(st.integers(1, (FRAMES - 1 - start) // stride + 1)), (top, left, *size)))
    for cut, got in zip(cuts, decode_cuts(clip, index, start, cuts, stride=stride), strict=True):
        assert cut.window is not None
        top, left, height, width = cut.window
        frames = range(start, start + cut.count * stride, stride)
        np.testing.assert_array_equal(got.frames, oracle[frames, top : top + height, left : left + width])
        assert got.codec == "h264"
        assert got.bit_exact


def test_overlapping_tiles(overlapping: Path) -> None:
    index = probe(overlapping).index
    assert index.tiles == ((0, 144), (80, 144), (160, 140))
    luma = panned_luma(FRAMES, HEIGHT, WIDTH, step=(1, 3))
    assert psnr_db(whole(overlapping), luma) > 40
    for left in range(0, WIDTH - 64, 19):
        part = decode_luma(overlapping, index, 12, 6, (0, left, HEIGHT, 64)).frames
        assert psnr_db(part, luma[12:18, :, left : left + 64]) > 36
    frames = np.stack(list(luma_frames(overlapping, index, (5, 70, 20, 200))))
    np.testing.assert_array_equal(frames, whole(overlapping)[:, 5:25, 70:270])


def test_only_the_tiles_that_are_touched_are_opened(
    clip: Path, overlapping: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    read, opened_before = [], decode.opened

    def counting(path: str, track: int):  # type: ignore[no-untyped-def]
        read.append(track)
        return opened_before(path, track)

    monkeypatch.setattr(decode, "opened", counting)
    for path, left, width, tracks in (
        (clip, 10, 80, [0]),
        (clip, 192, 108, [2]),
        (clip, 90, 30, [0, 1]),
        (clip, 0, 300, [0, 1, 2]),
        (overlapping, 79, 64, [0]),
        (overlapping, 81, 64, [1]),
        (overlapping, 90, 140, [1, 2]),
        (overlapping, 200, 64, [2]),
    ):
        index = probe(path).index
        read.clear()
        decode_luma(path, index, 12, 5, (0, left, 8, width))
        assert read == tracks


def test_all_frames_one_by_one(clip: Path, oracle: npt.NDArray[np.uint8]) -> None:
    index = probe(clip).index
    frames = np.stack(list(luma_frames(clip, index, (5, 70, 20, 200))))
    np.testing.assert_array_equal(frames, oracle[:, 5:25, 70:270])


def test_a_damaged_tile_spoils_what_touches_it(clip: Path, oracle: npt.NDArray[np.uint8], tmp_path: Path) -> None:
    spoilt = tmp_path / "spoilt.mp4"
    with av.open(str(clip)) as container:
        place = [(packet.pos, packet.size) for packet in container.demux(video=1) if packet.size][15]
    content = bytearray(clip.read_bytes())
    content[place[0] + 8 : place[0] + place[1]] = np.random.default_rng(1).bytes(place[1] - 8)
    spoilt.write_bytes(content)
    index = probe(spoilt).index
    np.testing.assert_array_equal(decode_luma(spoilt, index, 10, 12, (0, 0, 48, 96)).frames, oracle[10:22, :, :96])
    with pytest.raises(VideoError) as caught:
        decode_luma(spoilt, index, 10, 12, (0, 90, 48, 20))
    assert caught.value.frame == 15


@pytest.mark.parametrize(
    ("heights", "more"), [((48,), ""), ((48, 40), ""), ((48,) * 65, ""), ((48, 48), " 128"), ((48, 48), "0")]
)
def test_tracks_that_do_not_fit_together_are_refused(heights: tuple[int, ...], more: str, tmp_path: Path) -> None:
    path = tmp_path / "liar.mp4"
    with av.open(str(path), "w") as output:
        output.metadata[KEY] = f"{MARK} {' '.join(str(64 * number) for number in range(len(heights)))}{more}"
        tracks = [output.add_stream("mpeg4", rate=25) for _ in heights]
        for track, height in zip(tracks, heights, strict=True):
            track.width, track.height, track.pix_fmt = 64, height, "yuv420p"
        for track, height in zip(tracks, heights, strict=True):
            frame = av.VideoFrame.from_ndarray(np.zeros((height, 64), np.uint8), format="gray")
            output.mux(track.encode(frame.reformat(format="yuv420p")) + track.encode(None))
    with pytest.raises(VideoError, match=r"columns of one picture, from \[0.* on, but they are mpeg4 of 64x48 px"):
        probe(path)


def test_a_track_that_is_not_there(clip: Path) -> None:
    index = probe(clip).index
    with pytest.raises(VideoError, match="has no video track 3"):
        decode_luma(clip, FrameIndex.from_bytes(_with_more_tiles(index)), 3, 4, (0, 250, 8, 150))


def _with_more_tiles(index: FrameIndex) -> bytes:
    """What a message may claim."""
    return FrameIndex(
        index.first, index.pts, index.keyframes, index.keyframe_dts, index.time_base, HEIGHT, WIDTH + 100,
        seekable=True, tiles=(*index.tiles, Tile(WIDTH, 100)),
    ).to_bytes()  # fmt: skip


@pytest.mark.parametrize("tile", [-1, 1, 63])
def test_widths_that_cannot_be(tile: int) -> None:
    with pytest.raises(UsageError, match="or 64 and more"):
        Encoding("h264", 18, 12, tile_px=tile)


@pytest.mark.parametrize(("tile", "overlap"), [(0, 1), (200, -1), (200, 137)])
def test_overlaps_that_cannot_be(tile: int, overlap: int) -> None:
    with pytest.raises(UsageError, match="leave each at least 64 of its own"):
        Encoding("h264", 18, 12, tile, overlap)


def test_a_prepared_corpus(tmp_path: Path) -> None:
    """Every position means the same sample as in the source, but for the codec's error; and settings do not mix."""
    source, target = tmp_path / "source", tmp_path / "prepared"
    source.mkdir()
    for number in range(3):
        write(source / f"{number}.mp4", panned_luma(30, 90, 200, step=(1, number)), Encoding("h264", 5, 30))
    write(source / "narrow.mp4", panned_luma(30, 90, 72), Encoding("h264", 5, 30))
    report = run(source, target, TILED, rows=ROWS)
    assert report.complete
    assert read_manifest(target).header.tile_px == 96
    assert probe(target / "1.mp4").index.tiles == ((0, 96), (96, 104))
    assert probe(target / "narrow.mp4").index.tiles == ()
    with pytest.raises(CorpusError, match=r"tiles 96 px, and now .* quality 18 gop 12 is asked for"):
        run(source, target, Encoding("h264", 18, 12), rows=ROWS)
    assert run(source, target, TILED, rows=ROWS).kept == 4
    with (
        closing(open_catalogue(source, rows=Rows.parse(ROWS), cache_dir=tmp_path, processes=0)) as before,
        closing(open_catalogue(target, cache_dir=tmp_path, processes=0)) as after,
    ):
        for index in range(8):
            one, other = (remake(catalogue, SPEC, seed=3, epoch=0, index=index) for catalogue in (before, after))
            assert one.provenance.params == other.provenance.params
            assert (one.provenance.video, one.provenance.start_frame) == (
                other.provenance.video, other.provenance.start_frame,
            )  # fmt: skip
            assert psnr_db(one.arrays["frames"], other.arrays["frames"]) > 36


def test_a_manifest_without_tiles_is_as_it_always_was(tmp_path: Path) -> None:
    source = tmp_path / "source"
    source.mkdir()
    write(source / "a.mp4", panned_luma(12), Encoding("h264", 5, 30))
    run(source, tmp_path / "plain")
    assert b"tile_px" not in (tmp_path / "plain" / "v2v-prepared.jsonl").read_bytes()
    shutil.rmtree(tmp_path / "cache")
    assert opened(tmp_path / "plain").prepared == read_manifest(tmp_path / "plain").header

"""Numbered pictures as videos: the same samples as a lossless clip, and bad ones refused by frame and file."""

from __future__ import annotations

import io
import math
import os
import shutil
import zipfile
from collections.abc import Callable, Iterator
from contextlib import closing
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from tests.clips import panned_luma, write_clip
from tests.digests.rows import Row, samples_of
from v2v_protocol.errors import CorpusError, VideoError
from v2v_server.corpus.catalogue import Catalogue, open_catalogue
from v2v_server.corpus.sources.source import SourceOptions, open_source
from v2v_server.prepare import prepare
from v2v_server.store.cache import Cache, make_cache
from v2v_server.store.picture_sequence import PictureSequence, id_of
from v2v_server.store.pixels import VideosKind
from v2v_server.video.decode import ClipRequest, Cut

SEQUENCES, AT_25 = VideosKind("sequences"), VideosKind("sequences", 25.0)
FRAMES, HEIGHT, WIDTH = 30, 32, 40
ROW = Row("paper", ("voxels", "frames", "frames_rgb"))
DEEP = Row({"light": "declared"}, ("voxels", "frames", "frames_u16", "frames_rgb"))
ARCHIVES = Path(os.environ.get("V2V_TEST_RECORDINGS", Path(__file__).parents[4] / "shared" / "data" / "events"))


def write_lossless(path: Path, pixel_format: str) -> None:
    """Write a clip in FFV1: grey, or three shifted pans as red, green and blue."""
    luma = panned_luma(FRAMES, HEIGHT, WIDTH)
    if pixel_format.startswith("gray"):
        deep = luma.astype(np.uint16) * 255 + luma[::-1] if pixel_format == "gray16le" else luma
        write_clip(path, deep, codec="ffv1", pixel_format=pixel_format, full_range=True)
        return
    path.parent.mkdir()
    with av.open(str(path), "w") as container:
        stream = container.add_stream("ffv1", rate=25)
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, pixel_format
        for picture in np.stack([luma, np.roll(luma, 3, 2), np.roll(luma, 5, 1)], -1):
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(picture), format="rgb24")
            container.mux(stream.encode(frame.reformat(format=pixel_format)))
        container.mux(stream.encode(None))


def export(clip: Path, folder: Path, pixel_format: str, codec: str = "png", first: int = 0) -> None:
    """Write the frames of a clip as FFmpeg does with ``ffmpeg -i CLIP FOLDER/%06d.png``."""
    folder.mkdir(parents=True)
    with av.open(str(clip)) as container:
        for number, frame in enumerate(container.decode(video=0)):
            encoder: Any = av.CodecContext.create(codec, "w")
            encoder.width, encoder.height, encoder.pix_fmt = frame.width, frame.height, pixel_format
            encoder.time_base = Fraction(1, 25)
            packets = [*encoder.encode(frame.reformat(format=pixel_format)), *encoder.encode(None)]
            (folder / f"{first + number:06}.{codec}").write_bytes(b"".join(map(bytes, packets)))


def write_pictures(folder: Path, luma: npt.NDArray[np.uint8], name: str = "{:04}.png") -> None:
    """Write grey pictures."""
    folder.mkdir(parents=True, exist_ok=True)
    for number, picture in enumerate(luma):
        Image.fromarray(picture).save(folder / name.format(number))


def opened(folder: Path, kind: VideosKind = SEQUENCES, **options: Any) -> closing[Catalogue]:
    return closing(open_catalogue(folder, cache_dir=folder.parent / "index", kind=kind, processes=0, **options))


def arrays(catalogue: Catalogue, row: Row = ROW, cache: Cache | None = None) -> list[dict[str, bytes]]:
    samples = samples_of(catalogue, row, cache)
    return [{name: array.tobytes() for name, array in sample.arrays.items()} for sample in samples]


def refusal(folder: Path, kind: VideosKind = SEQUENCES) -> str:
    """Return why the only sequence of a folder cannot be used."""
    with pytest.raises(CorpusError) as caught, opened(folder, kind):
        pass
    return str(caught.value)


@pytest.fixture(scope="module")
def grey(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a lossless clip in `clips`, and its pictures in `seqs/a`."""
    folder = tmp_path_factory.mktemp("grey")
    write_lossless(folder / "clips/a.mkv", "gray")
    export(folder / "clips/a.mkv", folder / "seqs/a", "gray", first=7)
    return folder


@pytest.mark.parametrize(
    ("clip", "picture", "codec"),
    [
        ("gray", "gray", "png"), ("gray16le", "gray16be", "png"), ("bgr0", "rgb24", "png"), ("bgr0", "bgr24", "bmp"),
        ("gbrp16le", "rgb48be", "png"), ("gray", "gray", "tiff"), ("bgr0", "rgb24", "tiff"),
    ],
)  # fmt: skip
def test_exported_frames_give_the_samples_of_their_clip(tmp_path: Path, clip: str, picture: str, codec: str) -> None:
    write_lossless(tmp_path / "clips/a.mkv", clip)
    export(tmp_path / "clips/a.mkv", tmp_path / "seqs/a", picture, codec)
    row = DEEP if "16" in clip else ROW
    with opened(tmp_path / "clips", VideosKind()) as clips, opened(tmp_path / "seqs", AT_25) as sequences:
        assert [video.id for video in sequences.videos] == ["a/"]
        assert sequences.videos[0].codec == codec
        assert arrays(sequences, row) == arrays(clips, row)


def test_archive_cache_and_store_give_the_same_samples(grey: Path, tmp_path: Path) -> None:
    with opened(grey / "clips", VideosKind()) as clips:
        expected = arrays(clips)
    (tmp_path / "zips").mkdir()
    with zipfile.ZipFile(tmp_path / "zips/a.zip", "w", zipfile.ZIP_DEFLATED) as packed:
        for path in sorted((grey / "seqs/a").iterdir()):
            packed.write(path, f"deep/in/{path.name}")
        packed.writestr("__MACOSX/deep/._000001.png", b"of a Mac")
        packed.writestr("events.txt", b"0 1 2 3")
    with opened(tmp_path / "zips", AT_25) as zips:
        assert arrays(zips) == expected
    make_cache(tmp_path / "cache")
    cache = Cache(tmp_path / "cache", 1 << 30, least_free_bytes=0)
    with opened(grey / "seqs", AT_25) as sequences:
        assert arrays(sequences, cache=cache) == arrays(sequences, cache=cache) == expected
        assert samples_of(sequences, ROW, cache)[0].provenance.decoder == "png, from the cache"
        report = prepare(sequences, tmp_path / "store", processes=0, scene=True, planes=("chroma", "motion"))
        assert not report.failed
        again = prepare(sequences, tmp_path / "store", processes=0, scene=True, planes=("chroma", "motion"))
        assert again.kept == 1
        digest = sequences.digest
    for kind in (VideosKind(), SEQUENCES):  # a store needs no flag
        with opened(tmp_path / "store", kind, scene=True) as store:
            assert store.digest == digest
            assert arrays(store) == expected


def test_sequences_within_sequences_are_prepared(tmp_path: Path) -> None:
    luma = panned_luma(4, HEIGHT, WIDTH)
    write_pictures(tmp_path / "seqs/a", luma)
    write_pictures(tmp_path / "seqs/a/depth", luma, "{}.png")
    write_pictures(tmp_path / "seqs/a/0000x", luma, "{}.png")  # between the names of the pictures
    write_pictures(tmp_path / "seqs/a.masks", luma)
    write_pictures(tmp_path / "seqs/.hidden", luma)
    with opened(tmp_path / "seqs") as catalogue:
        assert list(catalogue.videos.ids) == ["a/", "a/0000x/", "a/depth/"]
        assert not prepare(catalogue, tmp_path / "store", processes=0).failed
    with opened(tmp_path / "store") as store:
        assert list(store.videos.ids) == ["a/", "a/0000x/", "a/depth/"]


def test_labels_lie_beside_the_folder(tmp_path: Path) -> None:
    luma = panned_luma(8, HEIGHT, WIDTH)
    write_pictures(tmp_path / "seqs/a.v1", luma)
    write_pictures(tmp_path / "seqs/b", luma)
    write_pictures(tmp_path / "seqs/a.v1.masks", luma // 64)
    row = Row({"voxels_per_clip": 2, "bins": 1}, ("masks",), count=1)
    with opened(tmp_path / "seqs", AT_25) as catalogue:
        assert list(catalogue.videos.ids) == ["a.v1/", "b/"]
        assert list(catalogue.sidecars[".masks/"].fingerprints) == ["a.v1/"]
    with closing(open_catalogue(tmp_path / "seqs/a.v1", cache_dir=tmp_path, kind=AT_25, processes=0)) as catalogue:
        (sample,) = samples_of(catalogue, row)
        assert not sample.provenance.unlabelled
        assert set(np.unique(sample.arrays["masks"])) <= {0, 1, 2, 3}


def test_without_the_flag_pictures_are_no_videos(grey: Path, tmp_path: Path) -> None:
    message = refusal(grey / "seqs", VideosKind())
    assert "no video found" in message
    assert "--videos-kind sequences" in message
    shutil.copytree(grey / "clips", tmp_path / "both")
    with opened(grey / "clips", VideosKind()) as clips:
        alone = clips.digest
    shutil.copytree(grey / "seqs/a", tmp_path / "both/pictures")
    with opened(tmp_path / "both", VideosKind()) as both:
        assert (both.digest, both.refusals, both.notes) == (alone, (), ())


def test_one_folder_of_pictures_is_named_like_a_video(grey: Path, tmp_path: Path) -> None:
    folder = tmp_path / "a"
    shutil.copytree(grey / "seqs/a", folder)
    with opened(folder) as catalogue:
        assert (list(catalogue.videos.ids), catalogue.folder) == (["a/"], tmp_path)


def write_times(path: Path, times: list[str]) -> None:
    path.write_text("# seconds\n" + "".join(f"{line}\n" for line in times))


@pytest.mark.parametrize("place", ["imgs/timestamps.txt", "imgs/images.txt", "timestamps.txt", "images.txt"])
@pytest.mark.parametrize("named", [False, True])
def test_times_come_from_a_file(tmp_path: Path, place: str, named: bool) -> None:
    write_pictures(tmp_path / "seqs/s/imgs", panned_luma(4, HEIGHT, WIDTH))
    seconds = [0.0, 0.04, 0.1, 0.12]
    names = [f" imgs/{number:04}.png" if named else "" for number in range(4)]
    write_times(tmp_path / "seqs/s" / place, [f"{time}{name}" for time, name in zip(seconds, names, strict=True)])
    with opened(tmp_path / "seqs", AT_25) as catalogue:  # times win over a rate
        assert catalogue.frame_index("s/imgs/").seconds(0, 4).tolist() == pytest.approx(seconds)
        assert catalogue.videos[0].frames_per_second == pytest.approx(3 / 0.12)
        before = catalogue.digest
    write_times(tmp_path / "seqs/s" / place, ["1", "2", "3", "4"])
    with opened(tmp_path / "seqs") as catalogue:
        assert catalogue.videos[0].frames_per_second == 1
        assert catalogue.digest != before


@pytest.mark.parametrize(
    ("times", "why"),
    [
        (["0", "1", "2"], "states times of 3 pictures: give each of the 4 pictures one"),
        (["0 0000.png", "1 0001.png", "2 0003.png"], "states times of 3 pictures; 0002.png has none: give each"),
        (["0 0000.png", "1 0001.png", "2 0003.png", "3 0002.png"], "in their order"),
        (["0", "1", "1", "2"], "do not increase: 1 in line 4 does not come after 1 in line 3"),
        (["0", "1", "nan", "2"], "line 4: 'nan': a line is a time in seconds or a date"),
        (["0", "1", "2", "1e30"], "beyond 4e9 s"),
        (["0", "1", "two", "3"], "line 4: 'two'"),
    ],
)
def test_wrong_times_are_refused(tmp_path: Path, times: list[str], why: str) -> None:
    write_pictures(tmp_path / "seqs/s", panned_luma(4, HEIGHT, WIDTH))
    write_times(tmp_path / "seqs/s/timestamps.txt", times)
    message = refusal(tmp_path / "seqs")
    assert "s/: timestamps.txt: " in message
    assert why in message


def test_rates_come_from_the_flag_or_a_list(tmp_path: Path) -> None:
    for name in ("a", "b", "c"):
        write_pictures(tmp_path / "seqs" / name, panned_luma(4, HEIGHT, WIDTH))
    (tmp_path / "list.csv").write_text("path,frames,c+,c-,rate\na,,,,50\nb/,4,0.3\n")
    (tmp_path / "list.txt").write_text("a 4 0.2 0.3 60\n")
    with opened(tmp_path / "seqs") as catalogue:
        assert [math.isnan(rate) for rate in catalogue.videos.frames_per_second] == [True] * 3
    with opened(tmp_path / "seqs", AT_25, list_file=tmp_path / "list.csv") as catalogue:
        assert catalogue.videos.frames_per_second.tolist() == [50, 25]
        assert catalogue.frame_index("a/").seconds(0, 3).tolist() == [0, 0.02, 0.04]
        assert (catalogue.videos[1].threshold_pos, catalogue.videos[1].threshold_neg) == (0.3, 0.3)
    with opened(tmp_path / "seqs", list_file=tmp_path / "list.txt") as catalogue:
        assert catalogue.videos.frames_per_second.tolist() == [60]
        assert (catalogue.videos[0].threshold_pos, catalogue.videos[0].threshold_neg) == (0.2, 0.3)


def test_pictures_without_times_are_decoded_alone(grey: Path) -> None:
    pixels = PictureSequence(grey / "seqs/a")
    index, luma = pixels.facts().index, panned_luma(FRAMES, HEIGHT, WIDTH)
    request = ClipRequest(index, 11, (Cut(4, (2, 3, 8, 9)), Cut(2)), stride=3)
    first, second = pixels.clips(request)
    np.testing.assert_array_equal(first.frames, luma[11:21:3, 2:10, 3:12])
    np.testing.assert_array_equal(second.frames, luma[11:15:3])
    assert np.isnan(first.seconds).all()
    assert first.bit_exact
    shown = [picture.grey for picture in pixels.pictures(ClipRequest(index, 5, (Cut(3),)))]
    np.testing.assert_array_equal(shown, luma[5:8])


def encoded(picture: Image.Image, form: str, **options: Any) -> bytes:
    file = io.BytesIO()
    picture.save(file, form, **options)
    return file.getvalue()


def grey_of(tmp_path: Path, data: bytes, ending: str) -> npt.NDArray[Any]:
    tmp_path.mkdir(exist_ok=True)
    (tmp_path / f"1.{ending}").write_bytes(data)
    pixels = PictureSequence(tmp_path)
    return pixels.clips(ClipRequest(pixels.facts().index, 0, (Cut(1),)))[0].frames[0]


@pytest.mark.parametrize(
    ("form", "options"), [("png", {}), ("bmp", {}), ("tiff", {"compression": "tiff_lzw"}), ("webp", {"lossless": True})]
)
def test_every_grey_is_exact(tmp_path: Path, form: str, options: dict[str, Any]) -> None:
    ramp = np.arange(256, dtype=np.uint8).reshape(16, 16)
    for number, mode in enumerate(("L", "RGB", *(["LA", "P"] if form == "png" else []))):
        data = encoded(Image.fromarray(ramp).convert(mode), form, **options)
        np.testing.assert_array_equal(grey_of(tmp_path / str(number), data, form), ramp)


def test_jpeg_is_turned_upright_and_transparency_is_said(tmp_path: Path) -> None:
    ramp = np.arange(0, 240, 5, dtype=np.uint8)[None].repeat(32, 0)
    exif = Image.Exif()
    for orientation, turns in ((1, 0), (3, 2), (6, -1), (8, 1)):
        exif[0x0112] = orientation
        write = tmp_path / f"{orientation}"
        found = grey_of(write, encoded(Image.fromarray(ramp), "jpeg", exif=exif, quality=98), "jpg")
        assert np.abs(found.astype(int) - np.rot90(ramp, turns)).max() < 4
        assert not PictureSequence(write).facts().remark
    exif[0x0112] = 2
    with pytest.raises(VideoError, match=r"1\.jpg: is mirrored by its Exif orientation"):
        grey_of(write, encoded(Image.fromarray(ramp), "jpeg", exif=exif), "jpg")
    clear = np.dstack([ramp, 255 - ramp])
    write = tmp_path / "clear"
    np.testing.assert_array_equal(grey_of(write, encoded(Image.fromarray(clear, "LA"), "png"), "png"), ramp)
    assert PictureSequence(write).facts().remark == "its transparency is left out"


BREAKS: dict[str, Callable[[Path, Image.Image], object]] = {
    "gap": lambda path, picture: path.unlink(),
    "again": lambda path, picture: shutil.copy(path, path.with_name("second_0002.png")),
    "unnumbered": lambda path, picture: shutil.copy(path, path.with_name("cover.png")),
    "size": lambda path, picture: picture.resize((8, 8)).save(path),
    "colour": lambda path, picture: picture.convert("RGB").save(path),
    "format": lambda path, picture: path.write_bytes(encoded(picture, "bmp")),
    "head": lambda path, picture: path.write_bytes(b"no picture"),
    "empty": lambda path, picture: path.write_bytes(b""),
}


def broken(kind: str, folder: Path) -> None:
    """Break the third of four pictures."""
    path = folder / "0002.png"
    with Image.open(path) as file:
        picture = file.copy()
    BREAKS[kind](path, picture)


@pytest.mark.parametrize(
    ("kind", "why"),
    [
        ("gap", "frame 2: 0003.png: is not the next one after 0001.png"),
        ("again", "frame 3: second_0002.png: is not the next one after 0002.png"),
        ("unnumbered", "frame 0: cover.png: has no number"),
        ("size", "frame 2: 0002.png: is 8x8 px of PNG L, and 0000.png 40x32 px of PNG L"),
        ("colour", "frame 2: 0002.png: is 40x32 px of PNG RGB, and 0000.png 40x32 px of PNG L"),
        ("format", "frame 2: 0002.png: is 40x32 px of BMP L"),
        ("head", "frame 2: 0002.png: is damaged, or of a format that is not read"),
        ("empty", "frame 2: 0002.png: is damaged, or of a format that is not read"),
    ],
)
def test_bad_sequences_are_refused_by_frame_and_file(tmp_path: Path, kind: str, why: str) -> None:
    write_pictures(tmp_path / "seqs/s", panned_luma(4, HEIGHT, WIDTH))
    broken(kind, tmp_path / "seqs/s")
    assert f"s/: {why}" in refusal(tmp_path / "seqs")


@pytest.mark.parametrize("form", ["png", "jpeg", "bmp", "tiff", "webp"])
def test_truncated_pictures_fail_by_frame_and_file(tmp_path: Path, form: str) -> None:
    for number, picture in enumerate(panned_luma(4, HEIGHT, WIDTH)):
        (tmp_path / f"{number}.{form}").write_bytes(encoded(Image.fromarray(picture), form))
    pixels, path = PictureSequence(tmp_path), tmp_path / f"2.{form}"
    index = pixels.facts().index
    path.write_bytes(path.read_bytes()[: path.stat().st_size * 3 // 4])
    assert len(pixels.clips(ClipRequest(index, 0, (Cut(2),)))[0].frames) == 2
    with pytest.raises(VideoError, match=f"2.{form}: ") as caught:
        pixels.clips(ClipRequest(index, 0, (Cut(4),)))
    assert caught.value.frame == 2


def test_pictures_that_change_later_fail_by_frame_and_file(tmp_path: Path) -> None:
    write_pictures(tmp_path, panned_luma(4, HEIGHT, WIDTH))
    pixels = PictureSequence(tmp_path)
    index = pixels.facts().index
    for change, why in (
        ("size", "the picture is 8x8 px here"),
        ("colour", "format changes"),
        ("format", "format changes"),
    ):
        broken(change, tmp_path)
        with pytest.raises(VideoError, match=f"0002.png: .*{why}") as caught:
            pixels.clips(ClipRequest(index, 0, (Cut(4),)))
        assert caught.value.frame == 2
        write_pictures(tmp_path, panned_luma(4, HEIGHT, WIDTH))


def test_changed_folders_are_noticed(grey: Path, tmp_path: Path) -> None:
    shutil.copytree(grey / "seqs", tmp_path / "seqs")
    with opened(tmp_path / "seqs", AT_25) as catalogue:
        fingerprint = catalogue.videos[0].fingerprint
        catalogue.check("a/", fingerprint)
        (tmp_path / "seqs/a/000008.png").unlink()
        with pytest.raises(VideoError, match="changed since it was catalogued"):
            catalogue.check("a/", fingerprint)


@pytest.mark.parametrize(
    ("files", "why"),
    [
        ({"events.txt": b""}, "holds pictures in 0 folders"),
        ({"a/1.png": b"", "b/1.png": b""}, "holds pictures in 2 folders, not in one: a, b"),
        (None, "is not a zip file"),
    ],
)
def test_unusable_archives_are_refused(tmp_path: Path, files: dict[str, bytes] | None, why: str) -> None:
    (tmp_path / "seqs").mkdir()
    if files is None:
        (tmp_path / "seqs/a.zip").write_bytes(b"PK no archive")
    else:
        with zipfile.ZipFile(tmp_path / "seqs/a.zip", "w") as packed:
            for name, data in files.items():
                packed.writestr(name, data)
    assert why in refusal(tmp_path / "seqs").replace("File is", "is")


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_damaged_archives_and_pictures_fail_cleanly(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    """Any bytes give the pictures, or an error of the video: nothing else is raised."""
    file = io.BytesIO()
    form = data.draw(st.sampled_from(("png", "jpeg", "bmp", "tiff", "webp")))
    with zipfile.ZipFile(file, "w", data.draw(st.sampled_from((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)))) as packed:
        for number, picture in enumerate(panned_luma(2, 16, 16)):
            packed.writestr(f"{number}.{form}", encoded(Image.fromarray(picture), form))
    content = bytearray(file.getvalue())
    for _ in range(data.draw(st.integers(1, 3))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    path = tmp_path_factory.mktemp("damaged") / "a.zip"
    path.write_bytes(content[: data.draw(st.integers(0, len(content)))] if data.draw(st.booleans()) else content)
    pixels = PictureSequence(path)
    try:
        index = pixels.facts().index
        assert len(pixels.clips(ClipRequest(index, 0, (Cut(1),)))[0].frames) == 1
    except VideoError:
        pass


@given(
    st.lists(st.text("ab.0", min_size=1, max_size=4), min_size=0, max_size=3),
    st.sampled_from(("", "x")),
    st.integers(0, 10**12),
    st.sampled_from((".png", ".JPG", ".jpeg", ".Tiff", ".tif", ".webp", ".bmp", ".mp4", ".txt", "")),
)
def test_pictures_belong_to_their_folder(folders: list[str], stem: str, number: int, suffix: str) -> None:
    path = "/".join([*folders, f"{stem}{number}{suffix}"])
    is_picture = suffix not in (".mp4", ".txt", "")
    assert id_of(path) == ("/".join(folders) + "/" if is_picture else "")
    assert id_of(f"a.masks/{path}") == id_of(f"b/a.masks/{path}") == ""


@pytest.fixture
def bucket(grey: Path, tmp_path: Path) -> Iterator[str]:
    """The address of a store with a sequence, an archive of the same pictures, and times above the folder."""
    fsspec = pytest.importorskip("fsspec", reason="the extra 'cloud' is not installed")
    store = fsspec.filesystem("memory")
    for path in sorted((grey / "seqs/a").iterdir()):
        store.pipe(f"/bucket/s/imgs/{path.name}", path.read_bytes())
    store.pipe("/bucket/s/timestamps.txt", "".join(f"{number / 25}\n" for number in range(FRAMES)).encode())
    store.pipe("/bucket/s/imgs/depth/readme.txt", b"not a part of it")
    yield "memory://bucket"
    store.rm("/bucket", recursive=True)


@pytest.mark.filterwarnings("ignore")
def test_sequences_of_a_bucket_are_as_on_a_disk(bucket: str, grey: Path, tmp_path: Path) -> None:
    options: dict[str, Any] = {"cache_dir": tmp_path, "copies": tmp_path / "copies", "kind": SEQUENCES, "processes": 0}
    with opened(grey / "clips", VideosKind()) as clips, closing(open_catalogue(bucket, **options)) as catalogue:
        assert list(catalogue.videos.ids) == ["s/imgs/"]
        assert catalogue.videos.frames_per_second.tolist() == pytest.approx([25])
        assert arrays(catalogue) == arrays(clips)
        catalogue.check("s/imgs/", catalogue.videos[0].fingerprint)
        digest = catalogue.digest
    shutil.rmtree(tmp_path / "copies")
    with closing(open_catalogue(bucket, **options)) as catalogue:  # nothing is probed again, and copies are equal
        assert catalogue.digest == digest
        assert arrays(catalogue)
    import fsspec

    fsspec.filesystem("memory").pipe("/bucket/s/timestamps.txt", b"0\n")
    source = open_source(bucket, SourceOptions(copies=tmp_path / "copies", cache_dir=tmp_path, kind=SEQUENCES))
    with pytest.raises(VideoError, match="changed"):
        source.verify("s/imgs/", "", (1, 2, 3))


@pytest.mark.skipif(not ARCHIVES.exists(), reason="real recordings are not there")
@pytest.mark.parametrize(("name", "grids"), [("ijrr_slider_depth_0-4", 4), ("ijrr_slider_depth_70-71", 1)])
def test_recordings_of_ijrr_are_served_as_they_are(tmp_path: Path, name: str, grids: int) -> None:
    shutil.copy(ARCHIVES / f"{name}.zip", tmp_path)
    row = Row({"bins": 1, "voxels_per_clip": grids}, count=1)
    with closing(open_catalogue(tmp_path, cache_dir=tmp_path, kind=SEQUENCES, processes=0)) as catalogue:
        (sample,) = samples_of(catalogue, row)
        assert catalogue.videos[0].frames_per_second == pytest.approx(25.8, abs=0.2)
    assert sample.arrays["voxels"].shape == (grids, 1, 16, 20)
    assert sample.arrays["frames"].any()

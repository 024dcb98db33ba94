"""Numbered pictures as videos: the same samples as a lossless clip, and bad ones refused by frame and file."""

from __future__ import annotations

import io
import math
import os
import shutil
import zipfile
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import closing
from fractions import Fraction
from functools import partial
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
from v2v_protocol.errors import CorpusError, UsageError, VideoChanged, VideoError
from v2v_server.corpus.catalogue import Catalogue, open_catalogue
from v2v_server.corpus.sources.source import SourceOptions, open_source
from v2v_server.corpus_words import notes_of
from v2v_server.kinds.kind import VideosKind
from v2v_server.kinds.registry import kind_from
from v2v_server.kinds.sequences import SequenceKind
from v2v_server.kinds.videos import VideoKind
from v2v_server.prepare import prepare
from v2v_server.store import picture_sequence
from v2v_server.store.cache import Cache, make_cache
from v2v_server.store.picture_sequence import PictureSequence
from v2v_server.store.pixels import signal_of
from v2v_server.video.decode import ClipRequest, Cut
from v2v_server.video.fingerprint import fingerprint

SEQUENCES, AT_25 = SequenceKind(), SequenceKind(25.0)
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
    with opened(tmp_path / "clips", VideoKind()) as clips, opened(tmp_path / "seqs", AT_25) as sequences:
        assert [video.id for video in sequences.videos] == ["a/"]
        assert sequences.videos[0].codec == codec
        assert arrays(sequences, row) == arrays(clips, row)


def test_archive_cache_and_store_give_the_same_samples(grey: Path, tmp_path: Path) -> None:
    with opened(grey / "clips", VideoKind()) as clips:
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
    for kind in (VideoKind(), SEQUENCES):  # a store needs no flag
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
    message = refusal(grey / "seqs", VideoKind())
    assert "no video found" in message
    assert "--videos-kind sequences" in message
    shutil.copytree(grey / "clips", tmp_path / "both")
    with opened(grey / "clips", VideoKind()) as clips:
        alone = clips.digest
    shutil.copytree(grey / "seqs/a", tmp_path / "both/pictures")
    with opened(tmp_path / "both", VideoKind()) as both:
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


def test_what_is_assumed_of_times_is_said(tmp_path: Path) -> None:
    write_pictures(tmp_path / "seqs/s", panned_luma(4, HEIGHT, WIDTH))
    (tmp_path / "seqs/s/timestamps.txt").write_text("4132468\n4168182\n4203896\n4239610\n")
    with opened(tmp_path / "seqs") as catalogue:
        assert catalogue.videos.frames_per_second.tolist() == pytest.approx([28], abs=0.01)
        assert catalogue.videos[0].remark == "timestamps.txt: its times are taken for us, 28 pictures a second"
        assert any("s/: timestamps.txt: its times are taken for us" in note for note in notes_of(catalogue))
    (tmp_path / "seqs/s/timestamps.txt").write_text("1\n2\n3\n4\n")
    with opened(tmp_path / "seqs") as catalogue:
        (note,) = notes_of(catalogue)
        assert "s/: timestamps.txt: its numbers, 1, 2 ..., count the pictures one by one" in note
        assert "remove the file and state the rate with --rate" in note
    write_times(tmp_path / "seqs/s/timestamps.txt", ["0", "10", "20", "30"])
    with opened(tmp_path / "seqs") as catalogue:
        assert catalogue.videos.frames_per_second.tolist() == [0.1]
        (note,) = notes_of(catalogue)
        assert "1 video has a rate outside of 0.5 to 20000 frames a second (s/: 0.1)" in note
    (tmp_path / "seqs/s/timestamps.txt").unlink()
    for rate, is_odd in ((0.4, True), (0.5, False), (20000.0, False), (20001.0, True), (0.0, False)):
        with opened(tmp_path / "seqs", SequenceKind(rate)) as catalogue:
            assert any("outside of" in note for note in notes_of(catalogue)) == is_odd, rate


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
    for orientation, turns in ((1, 0), (3, 2), (6, -1), (8, 1)):  # mirrored ones: test_picture_file.py
        exif[0x0112] = orientation
        write = tmp_path / f"{orientation}"
        found = grey_of(write, encoded(Image.fromarray(ramp), "jpeg", exif=exif, quality=98), "jpg")
        assert np.abs(found.astype(int) - np.rot90(ramp, turns)).max() < 4
        assert not PictureSequence(write).facts().remark
    clear = np.dstack([ramp, 255 - ramp])
    write = tmp_path / "clear"
    np.testing.assert_array_equal(grey_of(write, encoded(Image.fromarray(clear, "LA"), "png"), "png"), ramp)
    assert PictureSequence(write).facts().remark == "its transparency is left out"


def deep(count: int, bits: int, channels: int) -> list[npt.NDArray[np.uint16]]:
    """Return pictures that use all levels of a number of bits."""
    white = (1 << bits) - 1
    ramp = np.linspace(0, white, HEIGHT * WIDTH).round().astype(np.uint16).reshape(HEIGHT, WIDTH)
    return [np.roll(ramp, 7 * number).repeat(channels).reshape(HEIGHT, WIDTH, channels) for number in range(count)]


def write_deep(folder: Path, pictures: list[npt.NDArray[np.uint16]], form: str) -> None:
    """Write pictures of 16 bits; ya16 and rgba64 are opaque."""
    folder.mkdir(parents=True, exist_ok=True)
    codec, pixel_format = form.split()
    for number, picture in enumerate(pictures):
        encoder: Any = av.CodecContext.create(codec, "w")
        encoder.width, encoder.height, encoder.pix_fmt, encoder.time_base = WIDTH, HEIGHT, pixel_format, Fraction(1, 25)
        frame = av.VideoFrame(WIDTH, HEIGHT, pixel_format)
        sample = ">u2" if pixel_format.endswith("be") else "<u2"
        if pixel_format[:4] in ("ya16", "rgba"):
            picture = np.concatenate([picture, np.full((HEIGHT, WIDTH, 1), 65535, np.uint16)], -1)
        rows = np.zeros((HEIGHT, frame.planes[0].line_size), np.uint8)
        data = np.ascontiguousarray(picture.astype(sample)).view(np.uint8).reshape(HEIGHT, -1)
        rows[:, : data.shape[1]] = data
        frame.planes[0].update(rows.tobytes())
        packets = [*encoder.encode(frame), *encoder.encode(None)]
        (folder / f"{number:04}.{codec}").write_bytes(b"".join(map(bytes, packets)))


FORMS = {"png gray16be": 1, "png ya16be": 1, "png rgb48be": 3, "png rgba64be": 3, "tiff gray16le": 1, "tiff rgb48le": 3}


@pytest.mark.parametrize(
    ("form", "bits"),
    [*(("png gray16be", bits) for bits in (8, 10, 11, 14, 15, 16)), *((form, 12) for form in FORMS)],
)
def test_fewer_bits_than_the_picture_has_are_asked_about_and_stretched_if_stated(
    tmp_path: Path, form: str, bits: int
) -> None:
    def grey(catalogue: Catalogue) -> npt.NDArray[Any]:
        index = catalogue.frame_index("s/")
        with catalogue.source.open_pixels("s/", catalogue.videos[0].fingerprint) as pixels:
            return pixels.clips(ClipRequest(index, 0, (Cut(3),)))[0].frames.astype(int)

    write_deep(tmp_path / "seqs/s", deep(3, bits, FORMS[form]), form)
    with opened(tmp_path / "seqs", AT_25) as catalogue:
        digest, plain, remark = (
            catalogue.digest,
            grey(catalogue),
            catalogue.videos[0].remark.removeprefix(CLEAR).lstrip("; "),
        )
        said = (
            f"no level above {(1 << bits) - 1} of 65535 in the pictures looked at: if they hold {bits} bits, they are"
        )
        assert remark.startswith(said) == (bits <= 14)
        assert bool(remark) == (bits <= 14)
    write_deep(tmp_path / "whole/s", [picture << (16 - bits) for picture in deep(3, bits, FORMS[form])], form)
    with opened(tmp_path / "whole", AT_25) as catalogue:
        whole = grey(catalogue)
    assert abs(plain.max() - 255 * ((1 << bits) - 1) / 65535) <= 1, "never stretched unasked"
    if bits == 16:
        return
    with opened(tmp_path / "seqs", SequenceKind(25.0, picture_bits=bits)) as catalogue:
        assert catalogue.digest != digest
        assert np.abs(grey(catalogue) - whole).max() <= 1
        assert grey(catalogue).max() == 255
        assert catalogue.videos[0].remark in (CLEAR, "")
        assert signal_of(PictureSequence(tmp_path / "seqs/s"), catalogue.frame_index("s/")).bits in (bits, 8)
        catalogue.check("s/", catalogue.videos[0].fingerprint)
    with opened(tmp_path / "seqs", AT_25) as catalogue:
        assert catalogue.digest == digest
    if bits > 8:
        message = refusal(tmp_path / "seqs", SequenceKind(25.0, picture_bits=bits - 1))
        assert f"has a level of {(1 << bits) - 1}, beyond those of --picture-bits {bits - 1}" in message


CLEAR = "its transparency is left out"


def test_a_level_beyond_the_stated_bits_is_never_cut(tmp_path: Path) -> None:
    """Probing looks at 16 of the pictures; a worker at each that it serves."""
    pictures = deep(40, 12, 1)
    pictures[1][3, 5] = 4096
    write_deep(tmp_path / "seqs/s", pictures, "png gray16be")
    with opened(tmp_path / "seqs", SequenceKind(25.0, picture_bits=12)) as catalogue:
        index, pixels = catalogue.frame_index("s/"), PictureSequence(tmp_path / "seqs/s")
    assert len(pixels.clips(ClipRequest(index, 2, (Cut(3),)))[0].frames) == 3
    with pytest.raises(
        VideoError, match=r"0001.png: has a level of 4096, beyond 4095, the highest of --picture-bits 12"
    ):
        pixels.clips(ClipRequest(index, 0, (Cut(3),)))


def test_bits_of_pictures_of_8_are_said_not_to_apply(tmp_path: Path) -> None:
    write_pictures(tmp_path / "seqs/s", panned_luma(3, HEIGHT, WIDTH))
    with opened(tmp_path / "seqs", AT_25) as catalogue:
        fingerprint = catalogue.videos[0].fingerprint
    with opened(tmp_path / "seqs", SequenceKind(25.0, picture_bits=12)) as catalogue:
        assert catalogue.videos[0].fingerprint == fingerprint
        assert "--picture-bits 12 does not apply" in catalogue.videos[0].remark


@pytest.mark.parametrize(("kind", "bits"), [("videos", 12), ("photographs", 12), ("sequences", 7), ("sequences", 16)])
def test_bits_that_no_picture_has_are_refused(kind: str, bits: int) -> None:
    wanted = "has no effect without --videos-kind sequences" if bits == 12 else "whole number from 8 to 15"
    with pytest.raises(UsageError, match=f"--picture-bits [= ]*{bits}:? .*{wanted}"):
        kind_from({"videos_kind": kind, "picture_bits": bits})


@pytest.fixture
def listings(monkeypatch: pytest.MonkeyPatch) -> Counter[str]:
    """Count the listings of folders and archives by their samples; every state counts as old."""
    counts = Counter[str]()
    monkeypatch.setattr(picture_sequence, "_kept", {})
    monkeypatch.setattr(picture_sequence, "_SETTLED_NS", -(10**18))
    listed, opened_zip = picture_sequence.files_in, picture_sequence.ZipFile

    def count(call: Callable[..., Any], path: Any) -> Any:
        counts["all"] += 1
        return call(path)

    monkeypatch.setattr(picture_sequence, "files_in", partial(count, listed))
    monkeypatch.setattr(picture_sequence, "ZipFile", partial(count, opened_zip))
    return counts


@pytest.mark.parametrize("is_packed", [False, True])
def test_samples_list_a_folder_once_a_change(tmp_path: Path, listings: Counter[str], is_packed: bool) -> None:
    folder, luma = tmp_path / "a", panned_luma(6, HEIGHT, WIDTH)
    write_pictures(folder, luma)
    path = tmp_path / "a.zip" if is_packed else folder
    if is_packed:
        with zipfile.ZipFile(path, "w") as packed:
            for file in sorted(folder.iterdir()):
                packed.write(file, file.name)
    pixels, mark = PictureSequence(path), fingerprint(path)
    index = pixels.facts().index
    for start in (0, 2, 3):
        PictureSequence(path).check(mark)
        (clip,) = PictureSequence(path).clips(ClipRequest(index, start, (Cut(3),)))
        np.testing.assert_array_equal(clip.frames, luma[start : start + 3])
    assert listings["all"] == 1
    if is_packed:
        return
    (folder / "0005.png").unlink()
    with pytest.raises(VideoError, match="changed since it was catalogued"):
        pixels.check(mark)
    assert listings["all"] == 2
    write_times(tmp_path / "timestamps.txt", ["1"])  # above the folder
    pixels.check(fingerprint(path))
    assert listings["all"] == 3


def test_a_picture_that_changed_in_place_is_noticed_when_it_is_read(tmp_path: Path, listings: Counter[str]) -> None:
    folder, luma = tmp_path / "a", panned_luma(6, HEIGHT, WIDTH)
    write_pictures(folder, luma)
    pixels, mark = PictureSequence(folder), fingerprint(folder)
    index = pixels.facts().index
    with (folder / "0004.png").open("ab") as file:
        file.write(b"more")
    pixels.check(mark)
    assert len(pixels.clips(ClipRequest(index, 0, (Cut(3),)))[0].frames) == 3
    with pytest.raises(VideoChanged, match=r"0004.png: changed while it is served: \d+ bytes instead of \d+") as caught:
        pixels.clips(ClipRequest(index, 3, (Cut(3),)))
    assert caught.value.frame == 4
    with pytest.raises(VideoChanged, match="changed since it was catalogued"):
        pixels.check(mark)
    assert listings["all"] == 2


def test_a_folder_that_has_just_changed_is_listed_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The clock of a file system has steps, so its state may hide a change."""
    monkeypatch.setattr(picture_sequence, "_kept", {})
    write_pictures(tmp_path, panned_luma(2, HEIGHT, WIDTH))
    now = os.stat(tmp_path).st_ctime_ns
    for age_ns, is_kept in (
        (0, False),
        (picture_sequence._SETTLED_NS, False),
        (picture_sequence._SETTLED_NS + 1, True),
    ):
        monkeypatch.setattr(picture_sequence.time, "time_ns", lambda age_ns=age_ns: now + age_ns)
        picture_sequence.list_files(os.fspath(tmp_path))
        assert bool(picture_sequence._kept) == is_kept


def test_listings_are_kept_up_to_a_number_of_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, listings: Counter[str]
) -> None:
    monkeypatch.setattr(picture_sequence, "_KEPT_FILES", 5)
    for name in "abc":
        write_pictures(tmp_path / name, panned_luma(2, HEIGHT, WIDTH))
    for name in "abacb":
        picture_sequence.list_files(os.fspath(tmp_path / name))
    assert [Path(path).name for path in picture_sequence._kept] == ["c", "b"]
    assert listings["all"] == 4


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
    assert SEQUENCES.id_of(path) == ("/".join(folders) + "/" if is_picture else "")
    assert SEQUENCES.id_of(f"a.masks/{path}") == SEQUENCES.id_of(f"b/a.masks/{path}") == ""


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
    with opened(grey / "clips", VideoKind()) as clips, closing(open_catalogue(bucket, **options)) as catalogue:
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

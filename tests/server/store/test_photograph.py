"""Photographs as videos: catalogued by their heads, upright, bad ones refused alone; samples with exact truth."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from tests.digests.rows import Row, samples_of
from tests.server.named_corpus import corpus, video
from tests.server.peers import peers
from v2v_protocol.errors import CorpusError, UsageError, VideoError
from v2v_protocol.messages import Denied, Hello, Welcome
from v2v_protocol.sample import Sample
from v2v_protocol.spec import StreamSpec
from v2v_server.corpus.catalogue import Catalogue, open_catalogue
from v2v_server.kinds.kind import VideosKind
from v2v_server.kinds.photographs import LONGEST_PHOTOGRAPH_FRAMES, PhotographKind
from v2v_server.kinds.registry import kind_from, kind_of
from v2v_server.prepare import prepare
from v2v_server.schedule import SequenceTable
from v2v_server.store import photograph
from v2v_server.store.cache import Cache, make_cache
from v2v_server.store.photograph import Photograph
from v2v_server.store.picture_sequence import decode_picture
from v2v_server.video.decode import ClipRequest, Cut

PHOTOGRAPHS = PhotographKind(60.0, 0.5)
ALL = ("voxels", "frames", "flow", "flow_valid", "masks", "tracks")
SIZE = {"crop_height_px": 48, "crop_width_px": 64, "pause_probability": 0.0, "world_still_share": 0.0}
FAST = SIZE | {"world_speed_px": (100.0, 300.0), "world_patch_px": (30.0, 40.0), "track_points": 32}
ROW = Row({"preset": "worlds", **FAST}, ALL, count=6)
Grey = npt.NDArray[np.uint8]


@pytest.fixture(scope="module")
def picture() -> Grey:
    from skimage import data

    camera: Any = data.camera
    shown: Grey = np.array(camera()[::3, ::2])
    return shown


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, picture: Grey) -> Path:
    """A folder `photos` with the photograph in four formats."""
    photos = tmp_path_factory.mktemp("photographs") / "photos"
    photos.mkdir()
    for name, options in (("a.png", {}), ("b.jpg", {"quality": 95}), ("c.webp", {"lossless": True}), ("d.tiff", {})):
        Image.fromarray(picture).save(photos / name, **options)
    return photos


def opened(folder: Path, kind: VideosKind = PHOTOGRAPHS, **options: Any) -> closing[Catalogue]:
    return closing(open_catalogue(folder, cache_dir=folder.parent / "index", kind=kind, processes=0, **options))


@pytest.fixture(scope="module")
def catalogue(folder: Path) -> Iterator[Catalogue]:
    with opened(folder) as found:
        yield found


@pytest.fixture(scope="module")
def samples(catalogue: Catalogue) -> list[Sample]:
    return samples_of(catalogue, ROW)


def still(path: Path, catalogue: Catalogue) -> Grey:
    """Return the photograph as it stands."""
    index = catalogue.frame_index(path.name)
    (clip,) = Photograph(path).clips(ClipRequest(index, 3, (Cut(1),)))
    shown: Grey = clip.frames[0]
    return shown


def same(one: Sample, other: Sample) -> bool:
    return all(one.arrays[name].tobytes() == other.arrays[name].tobytes() for name in one.arrays)


def test_a_photograph_is_a_video_of_stated_rate_and_length(folder: Path, catalogue: Catalogue) -> None:
    assert list(catalogue.videos.ids) == ["a.png", "b.jpg", "c.webp", "d.tiff"]
    assert {(each.frames, each.frames_per_second) for each in catalogue.videos} == {(31, 60.0)}
    assert catalogue.frame_index("a.png").seconds(0, 31) == pytest.approx(np.arange(31) / 60, abs=1e-9)
    assert catalogue.kind.name == "photographs"
    digests = {catalogue.digest}
    for kind in (PhotographKind(), PhotographKind(30.0, 0.5), PhotographKind(60.0, 1.0)):
        with opened(folder, kind) as other:  # the index is the same file
            assert {each.frames for each in other.videos} == {kind.frames}
            digests.add(other.digest)
    assert len(digests) == 4
    with opened(folder) as again:
        assert again.digest == catalogue.digest


@given(st.floats(0.01, 1e4), st.floats(1e-4, 1e6))
def test_lengths_and_rates_are_checked(seconds: float, rate: float) -> None:
    if 1 <= math.floor(seconds * rate + 0.5) < LONGEST_PHOTOGRAPH_FRAMES:
        assert abs(PhotographKind(rate, seconds).frames - 1 - seconds * rate) <= 0.5
    else:
        with pytest.raises(UsageError, match=f"give 2 to {LONGEST_PHOTOGRAPH_FRAMES}"):
            PhotographKind(rate, seconds)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        (
            ("videos", 0.0, 10.0),
            "--photograph-seconds 10.0 has no effect without --videos-kind photographs .now videos.",
        ),
        (("sequences", 0.0, 10.0), "--photograph-seconds 10.0 has no effect without --videos-kind photographs"),
        (("videos", 25.0), "--rate 25.0 has no effect without --videos-kind sequences or photographs"),
        (("videos", "fast"), "--rate = 'fast': give a number from 0 to 1e.06 Hz"),
        (("films",), "--videos-kind = 'films': choose one of videos, sequences"),
    ],
)
def test_only_photographs_have_a_length_and_videos_no_rate(settings: tuple[Any, ...], words: str) -> None:
    with pytest.raises(UsageError, match=words):
        kind_from(dict(zip(("videos_kind", "rate", "photograph_seconds"), settings, strict=False)))


@pytest.mark.parametrize("turned", range(1, 9))
@pytest.mark.parametrize("suffix", ["png", "jpg"])
def test_photographs_stand_upright(tmp_path: Path, picture: Grey, turned: int, suffix: str) -> None:
    back = {
        2: Image.Transpose.FLIP_LEFT_RIGHT, 3: Image.Transpose.ROTATE_180, 4: Image.Transpose.FLIP_TOP_BOTTOM,
        5: Image.Transpose.TRANSPOSE, 6: Image.Transpose.ROTATE_90, 7: Image.Transpose.TRANSVERSE,
        8: Image.Transpose.ROTATE_270,
    }  # fmt: skip
    stored, exif = Image.fromarray(picture), Image.Exif()
    exif[0x0112] = turned
    stored = stored.transpose(back[turned]) if turned in back else stored
    (tmp_path / "photos").mkdir()
    path = tmp_path / f"photos/a.{suffix}"
    stored.save(path, exif=exif, quality=100)
    with opened(path.parent) as catalogue:
        shown = still(path, catalogue)
    assert shown.shape == picture.shape
    assert abs(shown.astype(int) - picture).mean() < (1.0 if suffix == "jpg" else 1e-9)


def test_sixteen_bits_and_rows_are_kept(tmp_path: Path, picture: Grey) -> None:
    (tmp_path / "photos").mkdir()
    Image.fromarray(picture.astype(np.uint16) * 257).save(tmp_path / "photos/a.png")
    Image.fromarray(picture).save(tmp_path / "photos/b.png")
    with opened(tmp_path / "photos") as catalogue:
        deep, plain = (still(tmp_path / f"photos/{name}.png", catalogue) for name in "ab")
        assert np.array_equal(deep, picture)
        assert np.array_equal(plain, picture)
        index = catalogue.frame_index("b.png")
        request = ClipRequest(index, 0, (Cut(1, (40, 10, 20, 30)),), rows=(35, 100))
        (clip,) = Photograph(tmp_path / "photos/b.png").clips(request)
    assert np.array_equal(clip.frames[0], picture[40:60, 10:40])


def test_bad_photographs_are_refused_alone(tmp_path: Path, picture: Grey) -> None:
    photos = tmp_path / "photos"
    photos.mkdir()
    shown, rgb = Image.fromarray(picture), Image.fromarray(np.dstack([picture] * 3))
    shown.save(photos / "good.jpg")
    rgb.convert("CMYK").save(photos / "cmyk.jpg")
    Image.fromarray(picture[:1, :5]).save(photos / "small.png")
    for name in ("moving.png", "moving.webp", "pages.tif"):
        rgb.save(photos / name, save_all=True, append_images=[Image.fromarray(np.dstack([picture[::-1]] * 3))])
    shown.convert("F").save(photos / "float.tiff")
    data = (photos / "good.jpg").read_bytes()
    (photos / "cut.jpg").write_bytes(data[:-100])
    (photos / "behind.jpg").write_bytes(data + bytes(5000))  # as some phones append a film
    (photos / "text.jpg").write_text("a text\n" * 100)
    (photos / "empty.png").write_bytes(b"")
    spoilt = bytearray(data)
    spoilt[len(data) // 2 : len(data) // 2 + 300] = bytes(300)
    (photos / "spoilt.jpg").write_bytes(spoilt)
    with opened(photos) as catalogue:
        assert list(catalogue.videos.ids) == ["behind.jpg", "good.jpg"]
        reasons = {refusal.video: refusal.reason for refusal in catalogue.refusals}
        for name, words in (
            ("cmyk.jpg", "has CMYK pixels: convert"), ("small.png", "has 5x1 px: give sides from 16"),
            ("moving.png", "more than one picture"), ("moving.webp", "more than one picture"),
            ("pages.tif", "more than one picture"), ("float.tiff", "has F pixels"), ("cut.jpg", "is truncated"),
            ("spoilt.jpg", "libjpeg says 'Corrupt JPEG data"),
            ("text.jpg", "does not begin like a JPEG"), ("empty.png", "does not begin like a JPEG"),
        ):  # fmt: skip
            assert words in reasons.pop(name)
        assert not reasons
        assert still(photos / "behind.jpg", catalogue).shape == picture.shape
        (photos / "good.jpg").write_bytes(spoilt)
        with pytest.raises(VideoError, match="Invalid data"):
            still(photos / "good.jpg", catalogue)
        (photos / "good.jpg").write_bytes(data[:-100])
        with pytest.raises(VideoError, match="changed"):
            Photograph(photos / "good.jpg").check(catalogue.videos[1].fingerprint)


def test_what_is_no_photograph_is_left_out(tmp_path: Path, picture: Grey) -> None:
    assert [PHOTOGRAPHS.id_of(name) for name in ("a.JPG", "b/c.tif", "d.mp4", "jpg", "e.masks/0.png")] == [
        "a.JPG", "b/c.tif", "", "", "e.masks/0.png",
    ]  # fmt: skip
    assert [kind_of(id).name for id in ("a.JPG", "b/", "c.zip", "d.mp4")] == [
        "photographs", "sequences", "sequences", "videos",
    ]  # fmt: skip
    with pytest.raises(CorpusError, match=r"no video found; looked for \.bmp \.jpeg"), opened(tmp_path):
        pass


def test_samples_have_names_and_exact_formats(samples: list[Sample], catalogue: Catalogue) -> None:
    decoders = {sample.provenance.video: sample.provenance.decoder for sample in samples}
    codecs = {"a.png": "png", "b.jpg": "mjpeg (host-dependent)", "c.webp": "webp", "d.tiff": "tiff"}
    assert decoders == {name: f"{codecs[name]}, 12 bits, SDR" for name in decoders}
    assert len(decoders) > 2
    assert all(map(same, samples, samples_of(catalogue, ROW)))
    few = samples_of(catalogue, Row({"preset": "worlds", **FAST}, ("tracks", "voxels"), count=6))
    assert all(map(same, few, samples)), "an array never changes another one"


def test_siblings_share_a_photograph_and_not_a_scene(catalogue: Catalogue, tmp_path: Path) -> None:
    spec = {"samples_per_decode": 2, "sibling_spacing": 2}
    row = Row({"preset": "worlds", **FAST}, ALL, spec, count=4)
    together = samples_of(catalogue, row)
    assert together[0].provenance.video == together[2].provenance.video
    assert not np.array_equal(together[0].arrays["frames"], together[2].arrays["frames"])
    make_cache(tmp_path)
    cache = Cache(tmp_path, 1 << 30, least_free_bytes=0)
    assert all(map(same, together, samples_of(catalogue, row, cache)))
    assert not any(path.is_file() and path.suffix for path in tmp_path.rglob("*.v2v")), "nothing to keep"


def test_photographs_are_decoded_once_within_a_bound(
    catalogue: Catalogue, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    decoded = list[int]()

    def decode(data: bytes) -> Any:
        decoded.append(len(data))
        return decode_picture(data)

    monkeypatch.setattr(photograph, "decode_picture", decode)
    monkeypatch.setattr(photograph, "kept_photographs", {})
    for name in ("a.png", "b.jpg", "a.png", "b.jpg"):
        still(folder / name, catalogue)
    assert len(decoded) == 2
    monkeypatch.setattr(photograph, "_KEPT_BYTES", 1)
    for name in ("c.webp", "c.webp", "a.png", "c.webp"):
        still(folder / name, catalogue)
    assert len(decoded) == 5
    assert len(photograph.kept_photographs) == 1


def test_paused_cameras_have_no_flow(catalogue: Catalogue) -> None:
    recipe = {"preset": "worlds", **FAST, "pause_probability": 1.0, "pause_stay_probability": 1.0, "lead_frames": 1}
    for sample in samples_of(catalogue, Row(recipe, ALL, count=2)):
        assert not sample.arrays["flow"].any()
        assert sample.arrays["flow_valid"].all()
        first, *others = sample.arrays["tracks"]
        assert all(np.array_equal(first, other) for other in others)
    late = samples_of(catalogue, Row({"preset": "worlds", **FAST}, ALL, {"flow_from": 1}, count=2))
    for sample in late:
        assert not sample.arrays["flow"][0].any()
        assert not sample.arrays["flow_valid"][0].any()
        assert sample.arrays["flow"][1].any()


@pytest.mark.parametrize(
    ("id", "spec", "arrays", "words"),
    [
        ("a.mp4", {"recipe": "paper"}, ("tracks",), "tracks needs --videos-kind photographs"),
        ("a.mp4", {"preset": "worlds"}, ("voxels",), "world fields are for photographs, these are videos"),
        ("a.jpg", {"recipe": "paper"}, ("voxels",), "photographs stand still under this recipe"),
        ("a.jpg", {"recipe": "worlds", "scene": "auto"}, ("voxels",), "needs statistics of the videos"),
        ("a.jpg", {"recipe": "worlds"}, ("frames_rgb",), "frames_rgb needs the colour of a video"),
        ("a.jpg", {"recipe": "worlds"}, ("boxes",), "boxes needs labels beside a video"),
    ],
)
def test_what_does_not_suit_the_corpus_is_refused_with_words(
    id: str, spec: dict[str, Any], arrays: tuple[str, ...], words: str
) -> None:
    """Also after a consumer whose request suits it."""
    fits = {"recipe": "worlds"} if id == "a.jpg" else {"recipe": "paper"}
    at = peers(corpus(video(id, 601, 200, 200)))
    (welcome,) = at.consumer_says(b"c", Hello(fits, ("voxels",), 4, 0))
    assert isinstance(welcome, Welcome), welcome
    (denied,) = at.consumer_says(b"d", Hello(spec, arrays, 4, 0))
    assert isinstance(denied, Denied)
    assert words in denied.text


def test_what_photographs_do_not_need_is_refused(folder: Path, catalogue: Catalogue, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="nothing to prepare"):
        prepare(catalogue, tmp_path / "store", processes=0)
    with pytest.raises(UsageError, match="--scene auto"), opened(folder, scene=True):
        pass
    with pytest.raises(UsageError, match="stand still"):
        SequenceTable(catalogue.videos, catalogue.rows, StreamSpec())
    assert catalogue.facts.missing.keys() >= {"frames_rgb", "boxes"}
    assert "tracks" not in catalogue.facts.missing


def test_a_large_photograph_takes_the_memory_of_its_crops() -> None:
    large = (video("a.jpg", frames=601, width_px=8000, height_px=6000),)
    spec = StreamSpec.from_dict({"recipe": {"preset": "worlds", "resize_scale": (0.1, 0.2)}})
    assert SequenceTable(large, corpus(*large).rows, spec).count == 3


def test_a_picture_is_no_video(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(CorpusError, match="is a picture that the camera moves over: add --videos-kind photographs"):
        open_catalogue(folder / "b.jpg", cache_dir=tmp_path, processes=0)
    with closing(open_catalogue(folder / "b.jpg", cache_dir=tmp_path, kind=PHOTOGRAPHS, processes=0)) as one:
        assert list(one.videos.ids) == ["b.jpg"]

"""Frames in colour, and all frames: the pixels of ``frames``, and no effect on other arrays."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import cast

import av
import numpy as np
import numpy.typing as npt
import pytest
from av.video.frame import VideoFrame
from av.video.stream import VideoStream
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.clips import panned_luma, write_clip
from v2v_protocol.errors import UsageError
from v2v_protocol.recipe import Recipe
from v2v_protocol.sample import Sample
from v2v_protocol.spec import StreamSpec
from v2v_server.broker.leases import Request
from v2v_server.corpus.catalogue import Catalogue, open_catalogue
from v2v_server.prepare import prepare
from v2v_server.schedule import Schedule, SequenceTable
from v2v_server.store.cache import Cache, make_cache
from v2v_server.store.store_file import StoreFile
from v2v_server.video.rows import Rows
from v2v_server.worker.produce import decode_for, make_sample
from v2v_tools.remake import Remaker, lease_for

RECIPE = Recipe(
    voxels_per_clip=4, bins=2, crop_height_px=24, crop_width_px=32, lead_frames=1, pause_probability=0.3,
    pause_stay_probability=0.5,
)  # fmt: skip


def coloured(frames: int = 30, height: int = 56, width: int = 72) -> npt.NDArray[np.uint8]:
    """Squares of random colours, which move by half a square a frame."""
    squares = np.random.default_rng(5).integers(20, 236, (height // 16 + 1, width // 16 + 1, 3), np.uint8)
    picture = squares.repeat(16, 0).repeat(16, 1)
    return np.stack([np.roll(picture, (8 * frame, 8 * frame), (0, 1))[:height, :width] for frame in range(frames)])


def write_coloured(path: Path, pictures: npt.NDArray[np.uint8]) -> Path:
    with av.open(str(path), "w") as output:
        stream = cast(VideoStream, output.add_stream("libx264", rate=25, options={"crf": "1"}))
        stream.height, stream.width = pictures.shape[1:3]
        stream.pix_fmt = "yuv420p"
        for number, picture in enumerate(pictures):
            frame = VideoFrame.from_ndarray(picture, format="rgb24").reformat(format="yuv420p")
            frame.pts = number
            output.mux(stream.encode(frame))
        output.mux(stream.encode(None))
    return path


@pytest.fixture(scope="module")
def catalogue(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Catalogue]:
    folder = tmp_path_factory.mktemp("coloured")
    write_coloured(folder / "a.mp4", coloured())
    with closing(open_catalogue(folder, processes=0, rows=Rows.parse("0.1:0.9"))) as opened:
        yield opened


def made(catalogue: Catalogue, recipe: Recipe, arrays: tuple[str, ...], seed: int = 0) -> Sample:
    return Remaker(catalogue, StreamSpec(recipe=recipe), arrays).sample(seed, 0, 0)


def viewed(sample: Sample, recipe: Recipe) -> npt.NDArray[np.uint8]:
    """The delivered frames of the pictures that were encoded, at scale 1: [T, 3, H, W]."""
    params, top = sample.provenance.params, Rows.parse("0.1:0.9").bounds(56)[0]
    frames = sample.provenance.start_frame + params.source_index(recipe.steps)[list(recipe.target_steps)]
    row, column = top + params.crop_top_px, params.crop_left_px
    crop = coloured()[frames, row : row + recipe.crop_height_px, column : column + recipe.crop_width_px]
    return (crop[:, :, ::-1] if params.flip else crop).transpose(0, 3, 1, 2)


@settings(max_examples=20, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(seed=st.integers(0, 2**32), contrast=st.booleans(), resize=st.booleans())
def test_frames_in_colour_are_the_frames_with_the_videos_colour(
    catalogue: Catalogue, seed: int, contrast: bool, resize: bool
) -> None:
    recipe = RECIPE.replace(contrast_probability=float(contrast), resize_scale=(0.7, 1.6) if resize else (1.0, 1.0))
    sample = made(catalogue, recipe, ("frames_all", "frames", "frames_rgb"), seed)
    frames, rgb = sample.arrays["frames"], sample.arrays["frames_rgb"]
    np.testing.assert_array_equal(sample.arrays["frames_all"][list(recipe.target_steps)], frames)
    with_flow = made(catalogue, recipe, ("flow", "frames_rgb"), seed)
    assert with_flow.arrays["frames_rgb"].tobytes() == rgb.tobytes(), "the margin of other arrays does not matter"
    luma = np.tensordot(rgb.astype(float), [0.299, 0.587, 0.114], axes=(1, 0))
    inside = ((rgb > 0) & (rgb < 255)).all(axis=1)
    np.testing.assert_allclose(luma[inside], frames[:, 0][inside], atol=1.01)
    if not contrast and not resize:
        # Colours blend at the borders of the squares.
        assert np.median(np.abs(rgb.astype(int) - viewed(sample, recipe))) <= 3


def test_colour_changes_no_other_array(catalogue: Catalogue) -> None:
    plain = made(catalogue, RECIPE, ("voxels", "frames"), 3)
    both = made(catalogue, RECIPE, ("voxels", "frames", "frames_rgb", "frames_all"), 3)
    for name in plain.arrays:
        assert both.arrays[name].tobytes() == plain.arrays[name].tobytes()


def test_a_grey_video_has_equal_channels(tmp_path: Path) -> None:
    write_clip(tmp_path / "a.mp4", panned_luma(30, 40, 48))
    with closing(open_catalogue(tmp_path, processes=0)) as catalogue:
        sample = made(catalogue, RECIPE.replace(contrast_probability=1.0), ("frames", "frames_rgb"))
    assert np.array_equal(sample.arrays["frames_rgb"], sample.arrays["frames"].repeat(3, axis=1))


def samples_of(folder: Path, recipe: Recipe = RECIPE) -> list[bytes]:
    with closing(open_catalogue(folder, processes=0, rows=Rows.parse("0.1:0.9"))) as catalogue:
        samples = [made(catalogue, recipe, ("frames", "frames_rgb"), seed) for seed in range(4)]
    return [sample.arrays["frames_rgb"].tobytes() for sample in samples]


def test_colour_stays_with_another_plane_and_without_some_files(tmp_path: Path) -> None:
    source, prepared = tmp_path / "source", tmp_path / "prepared"
    source.mkdir()
    for name in "ab":
        write_coloured(source / f"{name}.mp4", coloured(12))
    for planes in (("chroma",), ("motion",)):
        with closing(open_catalogue(source, processes=0)) as catalogue:
            prepare(catalogue, prepared, "fast", processes=0, planes=planes)
    with StoreFile(prepared / "a.mp4") as stored:
        assert stored.planes >= {"chroma", "motion"}
    (prepared / "b.mp4").unlink()
    with closing(open_catalogue(prepared, processes=0)) as catalogue:
        assert catalogue.notes
        catalogue.facts.require_arrays(("frames_rgb",))


@pytest.mark.parametrize("recipe", [RECIPE, RECIPE.replace(frame_stride=2, resize_scale=(0.7, 1.6))])
def test_a_prepared_folder_with_chroma_gives_the_same_colour(tmp_path: Path, recipe: Recipe) -> None:
    source, prepared, whole, grey = (tmp_path / name for name in ("source", "prepared", "whole", "grey"))
    source.mkdir()
    write_coloured(source / "a.mp4", coloured(40))
    with closing(open_catalogue(source, processes=0, rows=Rows.parse("0.1:0.9"))) as catalogue:
        prepare(catalogue, prepared, "fast", processes=0, planes=("chroma",))
        prepare(catalogue, grey, "fast", processes=0)
    with closing(open_catalogue(source, processes=0)) as catalogue:
        prepare(catalogue, whole, "dense", processes=0, planes=("chroma",))
    expected = samples_of(source, recipe)
    assert samples_of(prepared, recipe) == expected
    assert samples_of(whole, recipe) == expected
    with pytest.raises(
        UsageError,
        match=r"frames_rgb needs the plane chroma, .*: prepare .* with v2v-prepare --planes chroma, or serve",
    ):
        samples_of(grey, recipe)


def test_the_cache_keeps_colour_once_a_stream_needs_it(tmp_path: Path) -> None:
    folder = tmp_path / "videos"
    folder.mkdir()
    write_coloured(folder / "a.mp4", coloured(40))
    make_cache(tmp_path / "cache")
    cache = Cache(tmp_path / "cache", 1 << 30, 0)
    spec = StreamSpec(recipe=RECIPE)
    origins = []
    with closing(open_catalogue(folder, processes=0)) as catalogue:
        schedule = Schedule(SequenceTable(catalogue.videos, catalogue.rows, spec), spec)
        for arrays in (("frames",), ("frames", "frames_rgb"), ("frames", "frames_rgb"), ("frames",)):
            lease = lease_for(
                Request(b"", 0, 1), sequence=schedule.candidate(0, 0, 1, 0), catalogue=catalogue, spec=spec, seed=0,
                arrays=arrays,
            )  # fmt: skip
            plain, cached = (decode_for(lease, lease.indices, catalogue.source, each)[0] for each in (None, cache))
            origins.append(cached.clip.origin)
            for name, array in make_sample(lease, plain).arrays.items():
                assert make_sample(lease, cached).arrays[name].tobytes() == array.tobytes()
    assert origins == ["", "", "cache", "cache"]

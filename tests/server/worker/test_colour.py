"""Frames in colour, and all frames, beside ``frames``; and transfer and bit depth: decoded, simulated and cached."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import cast

import av
import numpy as np
import numpy.typing as npt
import pytest
from av.video.frame import VideoFrame
from av.video.reformatter import ColorTrc
from av.video.stream import VideoStream
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.clips import panned_luma, write_clip
from tests.oracles.leases import open_leases, whole_sample
from tests.server.prepare.test_lossless_served import require_equal
from tests.server.prepare.test_prepare import run
from v2v_protocol.errors import UsageError, VideoError
from v2v_protocol.messages import Lease
from v2v_protocol.recipe import Recipe, preset
from v2v_protocol.sample import DEFAULT_ARRAYS, Sample
from v2v_protocol.spec import StreamSpec
from v2v_server.broker.leases import Request
from v2v_server.corpus.catalogue import Catalogue, open_catalogue
from v2v_server.corpus.scenes import picture_check
from v2v_server.corpus.sources.folder import Folder
from v2v_server.corpus_words import notes_of
from v2v_server.prepare import prepare
from v2v_server.schedule import VideoSequence
from v2v_server.simulation.intensity import light_table
from v2v_server.store.cache import Cache, make_cache
from v2v_server.store.planes.detail import detail_of, levels_of
from v2v_server.store.store_file import StoreFile
from v2v_server.video.picture import Signal, range_table
from v2v_server.video.rows import Rows
from v2v_server.worker.job import SampleJob
from v2v_server.worker.making.make import make_sample
from v2v_server.worker.making.read import Clips
from v2v_tools.motion import WholePictures
from v2v_tools.preview import _signal_note
from v2v_tools.remake import Remaker, lease_for
from v2v_tools.tradeoff.measures import Leases, seen, simulated

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
    path.parent.mkdir(exist_ok=True)
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


def test_a_prepared_folder_has_colour_with_chroma_alone_whatever_else_it_has(tmp_path: Path) -> None:
    source, prepared = tmp_path / "source", tmp_path / "prepared"
    for name in "ab":
        write_coloured(source / f"{name}.mp4", coloured(12))
    without = r"frames_rgb needs the plane chroma, .*: prepare .* with v2v-prepare --planes chroma, or serve"
    for planes in ((), ("chroma",), ("motion",)):
        with closing(open_catalogue(source, processes=0)) as catalogue:
            prepare(catalogue, prepared, "fast", processes=0, planes=planes)
        with closing(open_catalogue(prepared, processes=0)) as catalogue:
            if planes:
                catalogue.facts.require_arrays(("frames_rgb",))
            else:
                with pytest.raises(UsageError, match=without):
                    made(catalogue, RECIPE, ("frames", "frames_rgb"))
    with StoreFile(prepared / "a.mp4") as stored:
        assert stored.planes >= {"chroma", "motion"}
    (prepared / "b.mp4").unlink()
    with closing(open_catalogue(prepared, processes=0)) as catalogue:
        assert notes_of(catalogue)
        catalogue.facts.require_arrays(("frames_rgb",))


# --- transfer and bit depth, from the file to the sample --------------------------------------------------------------

SDR = preset("noise-free").replace(
    voxels_per_clip=2,
    bins=3,
    crop_height_px=48,
    crop_width_px=64,
    flip_probability=0.0,
    threshold=(0.1, 0.1),
    threshold_ratio=(1.0, 1.0),
)
DECLARED = SDR.replace(light="declared")
ARRAYS = ("voxels", "frames", "frames_u16")
LUMA = panned_luma(8, full_range=False)


@pytest.fixture(autouse=True)
def own_index(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("V2V_CACHE_DIR", str(tmp_path / "index"))


def lease_of(source: Path, recipe: Recipe, **fields: float) -> Lease:
    with open_leases(source, "full", StreamSpec(recipe=recipe, **fields)) as (_, leases):  # type: ignore[arg-type]
        return replace(next(leases), arrays=ARRAYS)


def sample_of(source: Path, recipe: Recipe, **fields: float) -> Sample:
    return whole_sample(lease_of(source, recipe, **fields), source)


def ten_bits(folder: Path, transfer: ColorTrc | None) -> npt.NDArray[np.uint16]:
    """Write ``folder``/a.mkv, and return its levels, 0 .. 1023: its lowest bits vary."""
    luma = LUMA.astype(np.uint16) * 4
    luma += np.arange(luma.shape[2], dtype=np.uint16) % 4
    write_clip(folder / "a.mkv", luma, codec="ffv1", pixel_format="yuv420p10le", transfer=transfer)
    levels: npt.NDArray[np.uint16] = np.clip((2046 * (luma.astype(np.int64) - 64) + 876) // 1752, 0, 1023).astype(
        np.uint16
    )
    return levels


@pytest.mark.slow  # another compiled kernel
@pytest.mark.parametrize(("transfer", "name"), [(None, ""), (ColorTrc.SMPTE2084, "pq"), (ColorTrc.ARIB_STD_B67, "hlg")])
def test_a_deep_clip_is_simulated_from_the_light_that_it_states(
    tmp_path: Path, transfer: ColorTrc | None, name: str
) -> None:
    levels, signal = ten_bits(tmp_path / "clips", transfer), Signal(10, name)
    sample = sample_of(tmp_path / "clips", DECLARED)
    assert sample.provenance.decoder == f"ffv1, 10 bits, {name.upper() or 'SDR'}"
    light = light_table(2.2, signal)
    before, after = np.log(1e-3 + light[levels[[0, 6]]])
    change = 0.1 * sample.arrays["voxels"].sum(axis=(0, 1), dtype=np.int64)
    # The residual at the start and that at the end are at most a threshold each.
    assert np.abs(change - (after - before)).max() < 0.2001
    shown = levels[[3, 6]][:, None]
    np.testing.assert_array_equal(sample.arrays["frames_u16"], np.floor(shown * (65535 / 1023) + 0.5))
    grey = 255.0 * np.minimum(light[shown], 1.0) ** (1 / 2.2)
    assert np.abs(sample.arrays["frames"] - grey).max() <= 0.5 + 1e-9
    assert sample_of(tmp_path / "clips", SDR).provenance.decoder == "ffv1"


def test_what_a_video_states_changes_no_name_that_does_not_ask_for_it(tmp_path: Path) -> None:
    """Recipes without it ignore a stated transfer, and clips of 8-bit SDR give the same arrays with it."""
    for name, transfer in (("plain", None), ("hlg", ColorTrc.ARIB_STD_B67)):
        write_clip(tmp_path / name / "a.mp4", LUMA, transfer=transfer)
    made = {
        (name, recipe.light): sample_of(tmp_path / name, recipe)
        for name in ("plain", "hlg")
        for recipe in (SDR, DECLARED)
    }
    first = made["plain", "sdr"].arrays
    for key in (("plain", "declared"), ("hlg", "sdr")):
        for name, array in first.items():
            np.testing.assert_array_equal(made[key].arrays[name], array)
    assert (made["hlg", "declared"].arrays["voxels"] != first["voxels"]).any()
    np.testing.assert_array_equal(made["hlg", "declared"].arrays["frames_u16"], first["frames_u16"])


@pytest.mark.parametrize("kind", ["colour", "transfer", pytest.param("bits", marks=pytest.mark.slow)])  # another kernel
def test_the_cache_keeps_what_a_stream_needs(tmp_path: Path, kind: str) -> None:
    """A piece of an older stream lacks it, so it is not used for one that needs it."""
    source = tmp_path / "clips"
    if kind == "colour":
        write_coloured(source / "a.mp4", coloured())
    elif kind == "transfer":
        write_clip(source / "a.mp4", LUMA, transfer=ColorTrc.ARIB_STD_B67)
    else:
        ten_bits(source, ColorTrc.SMPTE2084)
    plain = lease_of(source, SDR)
    full = replace(plain, arrays=(*ARRAYS, "frames_rgb")) if kind == "colour" else lease_of(source, DECLARED)
    make_cache(tmp_path / "cache")
    clips = Clips(Folder(source), Cache(tmp_path / "cache", 1 << 30))
    for lease, said in ((plain, "miss"), (plain, "hit"), (full, "miss"), (full, "hit")):
        job = SampleJob.of(lease)
        decoded, _ = clips.take(job.clip, lease.indices)
        assert clips.said_of_cache(decoded) == said
        if said == "hit":
            require_equal(make_sample(job, decoded), whole_sample(lease, source), "cache")


def test_preview_and_doctor_name_what_a_video_has(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(picture_check, "usable_cores", lambda: 0)  # without processes, which a busy machine delays
    ten_bits(tmp_path / "clips", ColorTrc.SMPTE2084)
    provenance = sample_of(tmp_path / "clips", SDR).provenance
    with closing(open_catalogue(tmp_path / "clips", processes=0)) as catalogue:
        assert _signal_note(catalogue, provenance, DECLARED) == "a.mkv has 10 bits, PQ"
        note = _signal_note(catalogue, provenance, SDR)
        lines = list(picture_check.look_at_pictures(catalogue, 7))
    assert note.startswith("a.mkv has 10 bits, PQ, and is read as 8 bits, SDR: --set light=declared")
    assert lines[-1][2] == "1 of 1 videos have other levels than 8 bits, SDR (a.mkv: 10 bits, PQ)"


@pytest.mark.slow  # another compiled kernel
def test_deep_clips_offline(tmp_path: Path) -> None:
    """The parts of preview and tradeoff that simulate by themselves."""
    ten_bits(tmp_path / "clips", ColorTrc.SMPTE2084)
    spec = StreamSpec(recipe=DECLARED)
    with closing(open_catalogue(tmp_path / "clips", processes=0)) as catalogue:
        remaker = Remaker(catalogue, spec)
        sample, job = remaker.sample(0, 0, 0), remaker.job(0, 0, 0)
        whole = WholePictures(catalogue).camera(job)
        sequence = VideoSequence(catalogue.videos[0], job.clip.start_frame)
        lease = lease_for(
            Request(b"", 0, 0), sequence=sequence, catalogue=catalogue, spec=spec, seed=0, arrays=DEFAULT_ARRAYS,
            siblings=(1,),
        )  # fmt: skip
        (view,) = seen(Leases(tmp_path / "clips", [lease]), 0)
    assert whole.voxels.any()
    voxels = simulated(view, sample.provenance.params).voxels
    np.testing.assert_array_equal(voxels, sample.arrays["voxels"])


def test_sub_steps_are_made_of_8_bits(tmp_path: Path) -> None:
    ten_bits(tmp_path / "clips", ColorTrc.SMPTE2084)
    assert sample_of(tmp_path / "clips", DECLARED, substep_px=0.5).provenance.decoder == "ffv1, 8 bits, PQ"


@given(bits=st.integers(9, 12), full_range=st.booleans())
@settings(deadline=None)
def test_detail_gives_every_level_back(bits: int, full_range: bool) -> None:
    signal = Signal(bits)
    grey, levels = range_table(bits, full_range)[None], range_table(bits, full_range, signal)[None]
    detail = detail_of(levels, grey, signal)
    assert np.abs(detail).max() <= 9
    np.testing.assert_array_equal(levels_of(grey, detail[0], signal), levels)


def test_a_clip_of_two_transfers_is_refused(tmp_path: Path) -> None:
    (tmp_path / "clips").mkdir()
    parts = [
        write_clip(tmp_path / f"{number}.h264", LUMA[:4], gop=4, transfer=transfer).read_bytes()
        for number, transfer in enumerate((ColorTrc.SMPTE2084, ColorTrc.ARIB_STD_B67))
    ]
    (tmp_path / "clips" / "a.h264").write_bytes(b"".join(parts))
    assert sample_of(tmp_path / "clips", SDR).arrays["voxels"].any()
    with pytest.raises(VideoError, match="different transfer characteristics"):
        sample_of(tmp_path / "clips", DECLARED)
    report = run(tmp_path / "clips", tmp_path / "store")
    assert "its transfer changes from pq" in str(report.failed)

"""Transfer and bit depth of a video, from the file to the sample: decoded, stored and cached."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from av.video.reformatter import ColorTrc
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.clips import panned_luma, write_clip
from tests.oracles.leases import open_leases, whole_sample
from tests.server.prepare.test_lossless_served import require_equal
from tests.server.prepare.test_prepare import run
from v2v_protocol.errors import VideoError
from v2v_protocol.messages import Lease
from v2v_protocol.recipe import Recipe, preset
from v2v_protocol.sample import Sample
from v2v_protocol.spec import StreamSpec
from v2v_server.corpus.catalogue import open_catalogue
from v2v_server.corpus.scenes.picture_check import look_at_pictures
from v2v_server.corpus.sources.folder import Folder
from v2v_server.simulation.intensity import light_table
from v2v_server.store.cache import Cache, make_cache
from v2v_server.store.planes.detail import detail_of, levels_of
from v2v_server.video.picture import Signal, range_table
from v2v_server.worker.process import Clips
from v2v_server.worker.produce import make_sample
from v2v_tools.motion import WholePictures, predicted_loss
from v2v_tools.preview import _signal_note
from v2v_tools.remake import Remaker
from v2v_tools.tradeoff.measures import Leases, seen, simulated

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


def leases_of(source: Path, recipe: Recipe, **fields: float) -> Iterator[tuple[Path, Lease]]:
    with open_leases(source, "full", StreamSpec(recipe=recipe, **fields)) as (root, leases):  # type: ignore[arg-type]
        yield root, replace(next(leases), arrays=ARRAYS)


def sample_of(source: Path, recipe: Recipe, **fields: float) -> Sample:
    with closing(leases_of(source, recipe, **fields)) as leases:
        root, lease = next(leases)
        return whole_sample(lease, root)


def ten_bits(folder: Path, transfer: ColorTrc | None) -> npt.NDArray[np.uint16]:
    """Write ``folder``/a.mkv, and return its levels, 0 .. 1023: its lowest bits vary."""
    folder.mkdir()
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
        (tmp_path / name).mkdir()
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
    assert "light" not in SDR.to_dict()
    assert Recipe.from_dict(DECLARED.to_dict()) == DECLARED


@pytest.mark.parametrize("is_deep", [False, pytest.param(True, marks=pytest.mark.slow)])  # another compiled kernel
def test_store_and_cache_keep_transfer_and_bits(tmp_path: Path, is_deep: bool) -> None:
    if is_deep:
        ten_bits(tmp_path / "clips", ColorTrc.SMPTE2084)
    else:
        (tmp_path / "clips").mkdir()
        write_clip(tmp_path / "clips" / "a.mp4", LUMA, transfer=ColorTrc.ARIB_STD_B67)
    assert run(tmp_path / "clips", tmp_path / "store").complete
    exact = sample_of(tmp_path / "clips", DECLARED)
    require_equal(sample_of(tmp_path / "store", DECLARED), exact, "store")
    for recipe, substep_px in ((SDR, 0.0), (DECLARED, 0.5), (DECLARED.replace(frame_stride=3, bins=1), 0.0)):
        other = sample_of(tmp_path / "clips", recipe, substep_px=substep_px)
        require_equal(sample_of(tmp_path / "store", recipe, substep_px=substep_px), other, "store")
    make_cache(tmp_path / "cache")
    clips = Clips(Folder(tmp_path / "clips"), Cache(tmp_path / "cache", 1 << 30))
    # A piece of an older stream does not state the transfer, so it is not used for one that needs it.
    for recipe, said in ((SDR, "miss"), (SDR, "hit"), (DECLARED, "miss"), (DECLARED, "hit")):
        with closing(leases_of(tmp_path / "clips", recipe)) as leases:
            _, lease = next(leases)
            decoded, _ = clips.take(lease)
            assert clips.said_of_cache(decoded) == said
    require_equal(make_sample(lease, decoded), exact, "cache")


def test_preview_and_doctor_name_what_a_video_has(tmp_path: Path) -> None:
    ten_bits(tmp_path / "clips", ColorTrc.SMPTE2084)
    provenance = sample_of(tmp_path / "clips", SDR).provenance
    with closing(open_catalogue(tmp_path / "clips", processes=0)) as catalogue:
        assert _signal_note(catalogue, provenance, DECLARED) == "a.mkv has 10 bits, PQ"
        note = _signal_note(catalogue, provenance, SDR)
        lines = list(look_at_pictures(catalogue, 7))
    assert note.startswith("a.mkv has 10 bits, PQ, and is read as 8 bits, SDR: --set light=declared")
    assert lines[-1][2] == "1 of 1 videos have other levels than 8 bits, SDR (a.mkv: 10 bits, PQ)"


@pytest.mark.slow  # another compiled kernel
def test_deep_clips_offline(tmp_path: Path) -> None:
    """The parts of preview and tradeoff that simulate by themselves."""
    ten_bits(tmp_path / "clips", ColorTrc.SMPTE2084)
    spec = StreamSpec(recipe=DECLARED)
    with closing(open_catalogue(tmp_path / "clips", processes=0)) as catalogue:
        remaker = Remaker(catalogue, spec)
        made = remaker.made(0, 0, 0)
        assert predicted_loss(made).loss().low >= 0
        whole = WholePictures(catalogue, spec).camera(remaker.sequence(0, 0, 0))
        (view,) = seen(Leases(tmp_path / "clips", [replace(made.lease, indices=(0, 1))]), 0)
    assert whole.voxels.any()
    voxels = simulated(view, made.sample.provenance.params)
    np.testing.assert_array_equal(voxels, made.sample.arrays["voxels"])


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

"""scene "auto" from end to end: a still, a dark and a fast clip, and one with a cut, streamed and remade."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from tests.clips import panned_luma, write_clip
from tests.stream.conftest import SMALL, SMALL_FLAGS
from v2v_client import V2VStreamDataset
from v2v_client.local_server import LocalServer
from v2v_protocol.errors import UsageError
from v2v_protocol.sample import Provenance, Sample
from v2v_protocol.spec import StreamSpec
from v2v_server.corpus.catalogue import Catalogue, open_catalogue
from v2v_server.corpus_words import corpus_summary
from v2v_server.schedule import SequenceTable
from v2v_server.worker.scene_choice import LEAN_METHOD
from v2v_tools.remake import remake

Luma = npt.NDArray[np.uint8]
ARRAYS = ("voxels", "frames", "flow", "flow_valid")
STEADY = SMALL.replace(pause_probability=0.0)
AUTO = StreamSpec(recipe=STEADY, scene="auto", shuffle=False, still_share=1.0)


@pytest.fixture(scope="module")
def scenes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("scenes")
    first, second = panned_luma(33, 96, 128, (0, 1)), panned_luma(33, 96, 128, (0, 1))[:, ::-1, ::-1] // 2
    for name, luma in {
        "a-still": np.repeat(first[:1], 42, axis=0),
        "b-dark": panned_luma(42, 96, 128, (0, 1)) // 17,
        "c-fast": panned_luma(42, 96, 128, (1, 4)),
        "d-cut": np.concatenate([first, second]),
        "e-black": np.zeros((42, 96, 128), np.uint8),
    }.items():
        write_clip(folder / f"{name}.mkv", luma, codec="ffv1", pixel_format="gray", gop=12, full_range=True)
    return folder


@pytest.fixture(scope="module")
def catalogue(scenes: Path) -> Iterator[Catalogue]:
    with closing(open_catalogue(scenes, scene=True, processes=0)) as opened:
        yield opened


def made(catalogue: Catalogue, spec: StreamSpec, count: int) -> list[Sample]:
    return [remake(catalogue, spec, seed=3, epoch=0, index=index, arrays=ARRAYS) for index in range(count)]


def test_a_still_a_dark_and_a_fast_clip_get_different_decisions(catalogue: Catalogue) -> None:
    samples = {sample.provenance.video: sample for sample in made(catalogue, AUTO, 6)}
    still, dark, fast = (samples[f"{name}.mkv"].provenance.scene for name in ("a-still", "b-dark", "c-fast"))
    assert still.startswith("still; flow none 4; motion 0.00 px a frame, at most 0.00; change 0.00")
    assert "(a dark scene)" in dark
    assert not dark.startswith("still")
    assert fast.startswith(f"moving; flow {LEAN_METHOD} 4; ")
    assert not samples["a-still.mkv"].arrays["flow"].any()
    assert samples["a-still.mkv"].arrays["flow_valid"].all()
    asked = StreamSpec(recipe=STEADY, shuffle=False, flow_method=LEAN_METHOD)
    by_name = remake(catalogue, asked, seed=3, epoch=0, index=4, arrays=ARRAYS)
    chosen = remake(catalogue, AUTO, seed=3, epoch=0, index=4, arrays=ARRAYS)
    assert chosen.provenance.video == by_name.provenance.video == "c-fast.mkv"
    np.testing.assert_array_equal(chosen.arrays["flow"], by_name.arrays["flow"])


def test_the_provenance_says_how_a_crop_was_drawn(catalogue: Catalogue) -> None:
    moving = dataclasses.replace(AUTO, moving_share=1.0)
    still, fast = (remake(catalogue, moving, seed=3, epoch=0, index=index).provenance for index in (0, 4))
    assert (still.video, fast.video) == ("a-still.mkv", "c-fast.mkv")
    assert still.scene.endswith("; crop drawn uniformly")
    assert fast.scene.endswith("; crop drawn by motion")


def test_a_start_says_how_many_videos_are_longer_than_what_is_analysed(
    catalogue: Catalogue, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("v2v_server.corpus_words.MOST_ANALYSED_FRAMES", 42)
    said = corpus_summary(catalogue, AUTO, SequenceTable(catalogue.videos, catalogue.rows, AUTO))
    assert any(line.startswith("1 video is longer than the 42 frames that are analysed") for line in said)


def test_no_sequence_holds_the_cut_or_shows_nothing(catalogue: Catalogue) -> None:
    found = [(item.provenance.video, item.provenance.start_frame) for item in made(catalogue, AUTO, 6)]
    assert found == [("a-still.mkv", 0), ("a-still.mkv", 20), ("b-dark.mkv", 0), ("b-dark.mkv", 20),
                     ("c-fast.mkv", 0), ("c-fast.mkv", 20)]  # fmt: skip
    rest = [remake(catalogue, AUTO, seed=3, epoch=0, index=index).provenance for index in (6, 7)]
    assert [(item.video, item.start_frame) for item in rest] == [("d-cut.mkv", 0), ("d-cut.mkv", 33)]
    with pytest.raises(UsageError, match="8 samples"):
        remake(catalogue, AUTO, seed=3, epoch=0, index=8)


def test_voxels_and_frames_are_those_of_scene_off(catalogue: Catalogue) -> None:
    """What a bin means does not depend on what is seen."""
    off = StreamSpec(recipe=STEADY, shuffle=False)
    for with_scene, without in zip(made(catalogue, AUTO, 6), made(catalogue, off, 6), strict=True):
        assert (with_scene.provenance.video, with_scene.provenance.start_frame) == (
            without.provenance.video, without.provenance.start_frame,
        )  # fmt: skip
        np.testing.assert_array_equal(with_scene.arrays["voxels"], without.arrays["voxels"])
        np.testing.assert_array_equal(with_scene.arrays["frames"], without.arrays["frames"])
        assert without.provenance.scene == ""
        assert "scene" not in without.provenance.to_dict()
        again = Provenance.from_dict(with_scene.provenance.to_dict())
        assert again == with_scene.provenance


def test_the_stream_is_what_is_remade_and_a_server_with_scenes_serves_both(scenes: Path, catalogue: Catalogue) -> None:
    flags = (*SMALL_FLAGS, "--set", "pause_probability=0", "--scene", "auto", "--no-shuffle")
    flags = (*flags, "--still-share", "1", "--moving-share", "0.5")
    spec = dataclasses.replace(AUTO, moving_share=0.5)
    with LocalServer(scenes, workers=1, flags=flags) as server:
        stream = V2VStreamDataset(server.address, batch_size=4, arrays=ARRAYS, seed=3)
        count = 0
        for batch in stream:
            for row, index in enumerate(batch.indices):
                sample = remake(catalogue, spec, seed=3, epoch=0, index=index, arrays=ARRAYS)
                assert batch.provenance[row] == sample.provenance
                for name in ARRAYS:
                    np.testing.assert_array_equal(getattr(batch, name)[row].numpy(), sample.arrays[name])
                count += 1
        assert count == 8
        assert stream.describe()["catalogue_digest"] == catalogue.scene_digest


def test_a_server_without_scenes_refuses_them(scenes: Path) -> None:
    with closing(open_catalogue(scenes, processes=0)) as plain, pytest.raises(UsageError, match="--scene auto"):
        remake(plain, AUTO, seed=3, epoch=0, index=0)


def boxed(luma: Luma) -> Luma:
    return np.pad(luma, ((0, 0), (16, 20), (0, 12)))


MOVING_LUMA = panned_luma(64, 96, 128, (1, 2))
DEFECTS = {
    "24 in 30": lambda luma: luma[np.arange(79) * 4 // 5],
    "twos with bars": lambda luma: boxed(luma[np.arange(126) // 2]),
}


@pytest.mark.parametrize(("name", "stride"), [("24 in 30", 1), ("twos with bars", 2)])
def test_a_cleaned_clip_has_the_voxels_of_the_clean_one(name: str, stride: int, tmp_path: Path) -> None:
    spec = dataclasses.replace(AUTO, recipe=STEADY.replace(frame_stride=stride), max_sequences_per_video=1)
    samples = []
    for folder, luma in {"clean": MOVING_LUMA, "spoilt": DEFECTS[name](MOVING_LUMA)}.items():
        (tmp_path / folder).mkdir()
        clip = tmp_path / folder / "clip.mkv"
        write_clip(clip, luma, codec="ffv1", pixel_format="gray", gop=12, full_range=True)
        with closing(open_catalogue(clip.parent, scene=True, processes=0, cache_dir=tmp_path / "index")) as opened:
            samples.append(made(opened, spec, 1)[0])
            kept = dataclasses.replace(spec, keep_defects="bars,duplicates")
            untouched = made(opened, kept, 1)[0]
    clean, cleaned = samples
    for array in ARRAYS:
        np.testing.assert_array_equal(cleaned.arrays[array], clean.arrays[array])
    assert ("dropped" in cleaned.provenance.scene) == ("24" in name or "twos" in name)
    assert ("bars left out: top 16, bottom 20, right 12 px" in cleaned.provenance.scene) == ("bars" in name)
    assert not np.array_equal(untouched.arrays["frames"], clean.arrays["frames"])
    assert "dropped" not in clean.provenance.scene + untouched.provenance.scene

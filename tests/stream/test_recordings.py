"""Prepared recordings are served, resumed, shared and refused as videos are."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.digests.clips import write_recordings
from tests.stream.conftest import SMALL, SMALL_FLAGS
from v2v_client import V2VStreamDataset
from v2v_client.local_server import LocalServer
from v2v_protocol.errors import CorpusError, SampleUnavailable, UsageError, V2VError
from v2v_protocol.spec import StreamSpec
from v2v_recordings.block_file import EventFileWriter
from v2v_recordings.items import EventChunk, SensorSize
from v2v_server.corpus.catalogue import open_catalogue
from v2v_server.kinds.registry import kind_from
from v2v_server.schedule import SequenceTable
from v2v_tools.remake import remake

RECIPE = {"preset": "recordings", "voxels_per_clip": 2, "crop_height_px": 32, "crop_width_px": 40}
FLAGS = (*SMALL_FLAGS, "--videos-kind", "recordings", "--preset", "recordings", "--set", "voxels_per_clip=2")
ARRAYS = ("voxels", "event_counts", "voxels_bilinear", "time_surface", "frames", "flow", "flow_valid")


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two recordings with pictures and flow: ten sequences."""
    return write_recordings(tmp_path_factory.mktemp("recordings") / "prepared")


@pytest.fixture(scope="module")
def server(compiled: None, recordings: Path) -> Iterator[LocalServer]:
    """A server over them that shares samples."""
    with LocalServer(recordings, workers=2, flags=(*FLAGS, "--share-gib", "0.1")) as running:
        yield running


def stream(server: LocalServer, **more: Any) -> V2VStreamDataset:
    options: dict[str, Any] = {"batch_size": 1, "arrays": ARRAYS, "seed": 3, "recipe": RECIPE}
    return V2VStreamDataset(server.address, **options | more)


def bytes_of(batch: Any) -> tuple[Any, ...]:
    return (*batch.indices, *(np.asarray(batch[name]).tobytes() for name in ARRAYS))


def test_a_stream_resumes_after_each_batch_with_equal_bytes(server: LocalServer) -> None:
    batches = list(stream(server))
    whole = [bytes_of(batch) for batch in batches]
    assert len(whole) == 10
    assert not any(each.unlabelled or each.refusals for batch in batches for each in batch.provenance)
    assert all(np.asarray(batch.voxels).any() and np.asarray(batch["flow"]).any() for batch in batches)
    assert [bytes_of(batch) for batch in stream(server, shared_memory=False)] == whole
    for number, batch in enumerate(batches[:-1]):
        again = stream(server)
        again.load_state_dict(batch.resume_state)
        first = next(iter(again))
        again.close()
        assert bytes_of(first) == whole[number + 1]


def test_two_equal_consumers_get_the_same_samples_at_once(server: LocalServer) -> None:
    pairs = list(zip(stream(server, seed=9), stream(server, seed=9), strict=True))
    assert len(pairs) == 10
    assert [bytes_of(one) for one, _ in pairs] == [bytes_of(other) for _, other in pairs]


@pytest.mark.parametrize(
    ("field", "value", "words"),
    [
        ("noise_sigma", 0.1, "recipe noise_sigma = .* is a field of the simulation"),
        ("threshold", 0.3, "recipe threshold = .* is a field of the simulation"),
        ("resize_scale", (0.5, 1.0), "recipe resize_scale"),
        ("light", "declared", "recipe light"),
        ("world_zoom", 0.1, "recipe world_zoom"),
        ("leak_hz", 0.1, "recipe leak_hz"),
        ("grids_per_frame", 0, "set grids_per_frame 1, or voxel_seconds"),
        ("added_sigma", 0.1, "added noise is no whole number, and voxel_dtype is int8"),
    ],
)
def test_fields_that_cannot_hold_are_refused_by_name(field: str, value: Any, words: str, server: LocalServer) -> None:
    with pytest.raises(V2VError, match=words):
        next(iter(stream(server, recipe=RECIPE | {field: value})))


def test_fields_of_recordings_are_refused_for_videos(server: LocalServer, clips: Path) -> None:
    words = "fields bin_span and added_.* are for recordings, these are videos"
    with closing(open_catalogue(clips, processes=0)) as catalogue, pytest.raises(V2VError, match=words):
        SequenceTable(catalogue.videos, catalogue.rows, StreamSpec(SMALL.replace(bin_span="events")))


@pytest.mark.parametrize("change", ["damaged", "gone"])
def test_a_recording_that_cannot_be_read_is_refused_and_another_stands_in(
    change: str, compiled: None, tmp_path: Path
) -> None:
    folder = write_recordings(tmp_path / "prepared")
    with LocalServer(folder, workers=1, flags=(*FLAGS, "--cache-dir", str(tmp_path))) as running:
        path = folder / "a.v2ve"
        if change == "gone":
            path.unlink()
        else:  # in the middle: size, head and tail stay
            with path.open("r+b") as file:
                size = file.seek(0, os.SEEK_END)
                file.seek(70_000)
                file.write(bytes(size - 140_000))
            with pytest.raises(SampleUnavailable, match=r"a\.v2ve: is no intact prepared recording"):
                list(stream(running, on_bad_video="raise"))
        batches = list(stream(running))
    assert len(batches) == 10
    origins = [each for batch in batches for each in batch.provenance]
    assert "b.v2ve" in {each.video for each in origins}
    reasons = {(refusal.video, refusal.reason) for each in origins for refusal in each.refusals}
    assert {video for video, _ in reasons} == {"a.v2ve"}
    if change == "damaged":
        assert all("prepare the recording again" in reason for _, reason in reasons)


@pytest.fixture
def without_pictures(tmp_path: Path) -> Path:
    """A recording of events alone, with a pause that is longer than a block can hold."""
    at = np.arange(2000)
    times = 1_000_000 * at + 5_000_000_000 * (at > 1000)
    with EventFileWriter(tmp_path / "a.v2ve", source="a", fingerprint="") as writer:
        writer.add(SensorSize(64, 48))
        writer.add(EventChunk(times, at % 64, at % 48, at % 2 == 1))
    return tmp_path


@pytest.mark.parametrize(
    ("flags", "marks", "words"),
    [
        ({}, 0, "has fewer than two pictures for marks at pictures: give --rate or --marks"),
        ({"marks": "flow"}, 0, "has fewer than two flow for marks at flow: give --rate or --marks"),
        ({"marks": "2000events"}, 0, "has too few events for marks at 2000events"),
        ({"marks": "500events"}, 4, ""),
        ({"rate": 10.0}, 70, ""),
    ],
)
def test_marks_are_what_the_user_states(
    flags: dict[str, Any], marks: int, words: str, without_pictures: Path, tmp_path: Path
) -> None:
    kind = kind_from({"videos_kind": "recordings"} | flags)
    if words:
        with pytest.raises(CorpusError, match=words):
            open_catalogue(without_pictures, cache_dir=tmp_path / "cache", processes=0, kind=kind)
        return
    with closing(open_catalogue(without_pictures, cache_dir=tmp_path / "cache", processes=0, kind=kind)) as catalogue:
        assert [video.frames for video in catalogue.videos] == [marks]
        sample = remake(
            catalogue, StreamSpec.from_dict({"recipe": RECIPE, "shuffle": False}), seed=1, epoch=0, index=0,
            arrays=("event_counts", "frames", "flow"),
        )  # fmt: skip
        assert sample.arrays["event_counts"].any()
        assert set(sample.provenance.unlabelled) == {"frames", "flow"}
        assert "has no pictures" in sample.provenance.unlabelled["frames"]


@pytest.mark.parametrize("text", ["often", "0events", "1e4events", "picture", "-5events"])
def test_marks_of_another_form_are_refused(text: str) -> None:
    with pytest.raises(UsageError, match="give pictures, flow, or a number and events"):
        kind_from({"videos_kind": "recordings", "marks": text})


def test_a_mixture_of_simulated_and_recorded_batches(server: LocalServer, clips: Path) -> None:
    """The forms are equal, so a trainer needs to know of neither."""
    with LocalServer(clips, workers=1, flags=SMALL_FLAGS) as running:
        size = {name: value for name, value in RECIPE.items() if name != "preset"}
        arrays = {"arrays": ("voxels", "frames")}
        simulated = V2VStreamDataset(running.address, batch_size=1, recipe=size, seed=1, **arrays)
        mixture = V2VStreamDataset.mix({simulated: 0.6, stream(server, **arrays): 0.4})
        batches = list(mixture)
        kinds = [batch.provenance[0].video.endswith(".v2ve") for batch in batches]
        assert 0.3 < np.mean(kinds) < 0.5
        assert {(batch.voxels.shape, batch.voxels.dtype) for batch in batches} == {
            (batches[0].voxels.shape, batches[0].voxels.dtype)
        }
        again = V2VStreamDataset.mix({simulated: 0.6, stream(server, **arrays): 0.4})
        again.load_state_dict(batches[4].resume_state)
        assert [np.asarray(batch.voxels).tobytes() for batch in again] == [
            np.asarray(batch.voxels).tobytes() for batch in batches[5:]
        ]
        other = stream(server, **arrays, recipe=RECIPE | {"bins": 3})
        with pytest.raises(UsageError, match="samples differ in form"):
            list(V2VStreamDataset.mix({simulated: 0.6, other: 0.4}))

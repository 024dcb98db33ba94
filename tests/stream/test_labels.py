"""Labels and colour in a stream: equal bytes on every way, no effect on other arrays, and a state that resumes."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
import torch
from PIL import Image

from tests.clips import write_clip
from tests.server.worker.test_labels import boxes_text, pictures
from v2v_client import Batch, V2VDataset, V2VStreamDataset
from v2v_client.local_server import LocalServer
from v2v_protocol.errors import SampleUnavailable, UsageError

PLAIN = ("voxels", "frames")
LABELS = ("boxes", "frames_rgb", "frames_all")
ARRAYS = (*PLAIN, *LABELS)
FLAGS = [
    "--set=voxels_per_clip=3", "--set=bins=2", "--set=crop_height_px=16", "--set=crop_width_px=24",
    "--set=resize_scale=[0.8, 1.5]", "--set=max_boxes=4",
]  # fmt: skip


@pytest.fixture(scope="module")
def corpus(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("labelled")
    write_clip(folder / "a.mp4", pictures(200))
    shutil.copy(folder / "a.mp4", folder / "b.mp4")
    for name in "ab":
        (folder / f"{name}.boxes.json").write_text(boxes_text((4, 9, 30, 7)))
    return folder


def by_index(batches: list[Batch]) -> dict[int, bytes]:
    return {
        index: b"".join(batch[name][row].numpy().tobytes() for name in batch.arrays if name not in PLAIN)
        for batch in batches
        for row, index in enumerate(batch.indices)
    }


@pytest.mark.slow
def test_labels_travel_alike_and_resume(corpus: Path, tmp_path: Path) -> None:
    with LocalServer(corpus, workers=2, flags=[*FLAGS, "--cache", str(tmp_path / "cache")]) as server:

        def stream(arrays: tuple[str, ...] = ARRAYS, **more: object) -> V2VStreamDataset:
            return V2VStreamDataset(server.address, 2, arrays, seed=5, **more)  # type: ignore[arg-type]

        batches, plain = list(stream()), list(stream(PLAIN))
        for batch, bare in zip(batches, plain, strict=True):
            assert batch.indices == bare.indices
            assert all(torch.equal(batch[name], bare[name]) for name in PLAIN)
            assert [each.params for each in batch.provenance] == [each.params for each in bare.provenance]
            assert batch.labelled == (True, True)
            assert [len(clip) for clip in batch.boxes] == [3, 3]
            for row, clip in enumerate(batch.boxes):
                for time, boxes in enumerate(clip):
                    assert torch.equal(batch["boxes"][row, time, : len(boxes)], boxes)
                    assert boxes.shape[1] == 7
                    assert (batch["boxes"][row, time, len(boxes) :] == -1).all()
        assert any(each.boxes_dropped for batch in batches for each in batch.provenance)
        expected = by_index(batches)
        assert by_index(list(stream(shared_memory=False))) == expected
        assert by_index(list(stream(shared_memory=False, compress=True))) == expected
        resumed = stream()
        resumed.load_state_dict(batches[0].resume_state)
        assert by_index(list(resumed)) == by_index(batches[1:])
        dataset = V2VDataset(corpus, batches[0].resume_state["spec"]["recipe"], ARRAYS, seed=5)
        for index in batches[0].indices:
            sample = dataset[index]
            assert b"".join(sample.arrays[name].tobytes() for name in LABELS) == expected[index]


def test_the_option_is_checked() -> None:
    with pytest.raises(UsageError, match='labels = \'never\': choose "required" or "optional"'):
        V2VStreamDataset("tcp://127.0.0.1:1", labels="never")  # type: ignore[arg-type]


@pytest.mark.slow
def test_for_labels_no_video_is_refused(corpus: Path, tmp_path: Path) -> None:
    """Labels beyond the limits, of another size, or changed under the server."""
    folder = tmp_path / "videos"
    for name in "abc":
        (folder / f"{name}.masks").mkdir(parents=True)
        shutil.copy(corpus / "a.mp4", folder / f"{name}.mp4")
        for frame, picture in enumerate(pictures(3)):
            Image.fromarray(picture).save(folder / f"{name}.masks" / f"{frame}.png")
    with (folder / "a.boxes.json").open("wb") as large:
        large.truncate(40 << 30)
    (folder / "b.boxes.txt").write_text("1,1,2,3,4,5,1,1,1\n1000,1,2,3,4,5,1,1,1\n")
    Image.new("L", (8, 8)).save(folder / "b.masks" / "0.png")
    with LocalServer(folder, workers=1, flags=FLAGS) as server:
        stream = V2VStreamDataset(server.address, 2, ("boxes", "masks"), labels="optional")
        reasons = dict[str, dict[str, str]]()
        for origin in (origin for batch in stream for origin in batch.provenance):
            assert not origin.refusals
            reasons[origin.video] = dict(origin.unlabelled)
        assert set(reasons) == {"a.mp4", "b.mp4", "c.mp4"}
        assert "42949672960 bytes or more" in reasons["a.mp4"]["boxes"]
        assert "frames 1 to 1000: the video has frames 1 to 40" in reasons["b.mp4"]["boxes"]
        assert "0.png has 8x8 px: the video has 64x48 px" in reasons["b.mp4"]["masks"]
        assert "is missing" in reasons["c.mp4"]["boxes"]
        assert "masks" not in reasons["a.mp4"].keys() | reasons["c.mp4"].keys()
        for name in "abc":
            for frame in range(40):
                Image.new("L", (64, 48)).save(folder / f"{name}.masks" / f"{frame}.png")
        with pytest.raises(SampleUnavailable, match=r"its sidecar \.masks/: changed since it was catalogued: \d+\.png"):
            list(V2VStreamDataset(server.address, 2, ("masks",), labels="optional", seed=1))
        assert not any(
            origin.refusals for batch in V2VStreamDataset(server.address, 2, PLAIN) for origin in batch.provenance
        )

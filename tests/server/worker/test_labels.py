"""Boxes and masks of whole samples: they lie where the pictures show their object, and never change other arrays."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image

from tests.clips import write_clip
from v2v_client import Batch
from v2v_protocol.recipe import Recipe
from v2v_protocol.sample import ARRAYS, ArrayForm, Needs, Provenance, Sample
from v2v_protocol.spec import StreamSpec
from v2v_server.corpus.catalogue import Catalogue, open_catalogue
from v2v_server.video.rows import Rows
from v2v_server.worker.arrays.context import ARRAY_BUILDERS, SampleContext, fill_rows
from v2v_tools.remake import Remaker

FRAMES, HEIGHT_PX, WIDTH_PX, SIDE_PX = 40, 48, 64, 14
RECIPE = Recipe(
    voxels_per_clip=4, bins=2, crop_height_px=24, crop_width_px=32, lead_frames=1, frame_stride=2,
    pause_probability=0.3, pause_stay_probability=0.5, resize_scale=(0.6, 1.6),
)  # fmt: skip


def place(frame: int) -> tuple[int, int]:
    """Where the square of that frame begins: column and row."""
    return 2 + frame % 41, 4 + frame % 23


def pictures(value: int) -> np.ndarray:
    drawn = np.zeros((FRAMES, HEIGHT_PX, WIDTH_PX), np.uint8)
    for frame in range(FRAMES):
        left, top = place(frame)
        drawn[frame, top : top + SIDE_PX, left : left + SIDE_PX] = value
    return drawn


def boxes_text(extra: tuple[int, ...] = ()) -> str:
    images = [{"id": frame, "frame_id": frame} for frame in range(FRAMES)]
    boxes = [
        {"image_id": frame, "bbox": [*place(frame), side, side], "category_id": 3, "instance_id": number}
        for frame in range(FRAMES)
        for number, side in enumerate((SIDE_PX, *extra))
    ]
    return json.dumps({"images": images, "annotations": boxes})


@pytest.fixture(scope="module")
def corpus(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A bright square that moves over black, with its labels."""
    folder = tmp_path_factory.mktemp("squares")
    write_clip(folder / "a.mp4", pictures(255), options={"qp": "0"}, full_range=True)
    (folder / "a.boxes.json").write_text(boxes_text())
    (folder / "a.masks").mkdir()
    for frame, picture in enumerate(pictures(3)):
        Image.fromarray(picture).save(folder / "a.masks" / f"{frame:05}.png")
    return folder


@pytest.fixture(scope="module")
def catalogue(corpus: Path) -> Iterator[Catalogue]:
    with closing(open_catalogue(corpus, processes=0, rows=Rows.parse("0.1:0.9"))) as opened:
        yield opened


def made(catalogue: Catalogue, recipe: Recipe, seed: int, arrays: tuple[str, ...]) -> Sample:
    return Remaker(catalogue, StreamSpec(recipe=recipe), arrays).sample(seed, 0, 0)


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(seed=st.integers(0, 2**32))
def test_labels_follow_crop_resize_flip_pauses_and_stride(catalogue: Catalogue, seed: int) -> None:
    sample = made(catalogue, RECIPE, seed, ("voxels", "frames", "boxes", "masks"))
    plain = made(catalogue, RECIPE, seed, ("voxels", "frames"))
    for name in plain.arrays:
        assert sample.arrays[name].tobytes() == plain.arrays[name].tobytes()
    assert sample.provenance.params == plain.provenance.params
    assert sample.provenance.labelled
    assert set(sample.provenance.sidecars) == {".boxes.json", ".masks/"}
    height, width = RECIPE.crop_px
    for frame, boxes, mask in zip(*(sample.arrays[name] for name in ("frames", "boxes", "masks")), strict=True):
        picture, mask = frame[0], mask[0]
        assert np.all(mask[picture > 0.76 * 255] == 3)
        assert np.all(mask[picture < 0.24 * 255] == 0)
        assert np.all(boxes[1:] == -1)
        x0, y0, x1, y1, category, track, visible = boxes[0]
        lit = picture >= 128
        if category == -1:
            # Too small a part: a tenth of the square, or a side of less than 2 px.
            assert lit.sum() <= max(0.15 * (SIDE_PX * 1.6) ** 2, 3 * SIDE_PX * 1.6)
            continue
        assert (category, track) == (3, 0)
        assert 0.1 <= visible <= 1
        assert 0 <= x0 < x1 <= width
        assert 0 <= y0 < y1 <= height
        rows, columns = np.flatnonzero(lit.any(axis=1)), np.flatnonzero(lit.any(axis=0))
        np.testing.assert_allclose([columns[0], rows[0], columns[-1] + 1, rows[-1] + 1], [x0, y0, x1, y1], atol=0.6)


def test_a_toy_label_with_a_cap_needs_no_field_of_its_own(
    corpus: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Points, three a frame, of which two fit: a line and a function, as ``docs/extending.md`` says."""

    def points(context: SampleContext, out: np.ndarray) -> int:
        text = context.clip.sidecars[".points.txt"].read_text()
        found = np.array([line.split() for line in text.splitlines()], np.float32)
        return fill_rows("points", out, (found[found[:, 0] == frame, 1:] for frame in context.target_frames))

    needs = Needs(sidecars=(".points.txt",))
    form = ArrayForm(lambda recipe, _: ("float32", (5, recipe.max_boxes, 2)), needs, empty=-1)
    monkeypatch.setitem(ARRAYS, "points", form)
    monkeypatch.setitem(ARRAY_BUILDERS, "points", points)
    (tmp_path / "a.mp4").symlink_to(corpus / "a.mp4")
    lines = [f"{frame} {frame} {row}" for frame in range(FRAMES) for row in range(3 if frame % 3 < 2 else 1)]
    (tmp_path / "a.points.txt").write_text("\n".join(lines))
    with closing(open_catalogue(tmp_path, processes=0)) as catalogue:
        sample = made(catalogue, RECIPE.replace(max_boxes=2), 3, ("frames", "points"))
        plain = made(catalogue, RECIPE.replace(max_boxes=2), 3, ("frames",))
    frames = sample.arrays["points"][:, 0, 0].astype(int)
    dropped = int((frames % 3 < 2).sum())
    assert sample.provenance.dropped == ({"points": dropped} if dropped else {})
    assert 0 < dropped < 5
    assert Provenance.from_dict(sample.provenance.to_dict()) == sample.provenance
    assert "dropped" not in plain.provenance.to_dict()
    arrays = {name: torch.from_numpy(array[None].copy()) for name, array in sample.arrays.items()}
    batch = Batch(arrays, (0,), 0, (sample.provenance,), {}, 0.0, 0.0, 1, Recipe())
    for frame, rows in zip(frames, batch.rows("points")[0], strict=True):
        assert rows.tolist() == [[frame, 0], [frame, 1]][: 2 if frame % 3 < 2 else 1]
    assert batch.points is batch["points"]


@pytest.mark.parametrize(
    ("array", "labels", "reason"),
    [
        ("boxes", {}, r"its sidecar \.boxes\.json or \.boxes\.txt or \.boxes/: is missing: add it beside the video"),
        ("boxes", {".boxes.json": "{"}, r"its sidecar \.boxes\.json: .*line 1"),
        ("boxes", {".boxes.txt": "1,2\n"}, r"its sidecar \.boxes\.txt: line 1 has 2 values"),
        ("boxes", {".boxes.json": '{"images": [{"id": 0, "frame_id": 0}], "annotations": []}'}, "has no frame"),
        ("boxes", {".boxes.txt": "", ".boxes.json": "{}"}, r"\.boxes\.json or \.boxes\.txt: there are 2: keep one"),
        ("masks", {".masks/0.png": None}, "has no file of frame"),
    ],
)
def test_a_video_without_sound_labels_gives_an_unlabelled_sample(
    corpus: Path, tmp_path: Path, array: str, labels: dict[str, str | None], reason: str
) -> None:
    (tmp_path / "a.mp4").symlink_to(corpus / "a.mp4")
    for ending, text in labels.items():
        (tmp_path / f"a{ending}").parent.mkdir(exist_ok=True)
        if text is None:
            (tmp_path / f"a{ending}").symlink_to(corpus / "a.masks" / "00000.png")
        else:
            (tmp_path / f"a{ending}").write_text(text)
    with closing(open_catalogue(tmp_path, processes=0)) as catalogue:
        sample, plain = (made(catalogue, RECIPE, 7, arrays) for arrays in (("frames", array), ("frames",)))
    assert np.all(sample.arrays[array] == {"boxes": -1, "masks": 255}[array])
    assert not sample.provenance.labelled
    (text,) = sample.provenance.unlabelled.values()
    assert re.search(reason, text)
    assert sample.arrays["frames"].tobytes() == plain.arrays["frames"].tobytes()
    assert (sample.provenance.video, sample.provenance.params) == (plain.provenance.video, plain.provenance.params)

"""The three formats of boxes say the same, and each error names its line and what to write."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from v2v_server.labels.boxes import Box, BoxTable
from v2v_server.labels.formats import READERS, numbered_files

PICTURE_PX = (60, 80)
Boxes = list[tuple[int, int, int, int, int, int, int]]
box = st.tuples(
    st.integers(0, 9), st.integers(-8, 70), st.integers(-8, 50), st.integers(1, 40), st.integers(1, 40),
    st.integers(0, 90), st.integers(0, 5),
)  # fmt: skip


def write_coco(path: Path, boxes: Boxes, frames: int = 10) -> Path:
    images = [{"id": 7 + frame, "frame_id": frame} for frame in range(frames)]
    annotations = [
        {"image_id": 7 + frame, "bbox": list(place), "category_id": category, "instance_id": track}
        for frame, *place, category, track in boxes
    ]
    path.write_text(json.dumps({"videos": [{"id": 1}], "images": images, "annotations": annotations}))
    return path


def write_mot(path: Path, boxes: Boxes) -> Path:
    lines = [
        f"{frame + 1},{track},{left + 1},{top + 1},{width},{height},1,{category},0.5"
        for frame, left, top, width, height, category, track in boxes
    ]
    path.write_text("\n".join([*lines, "1,9,1,1,5,5,0,1,1.0", ""]))  # confidence 0: to be ignored
    return path


def write_yolo(folder: Path, boxes: Boxes) -> Path:
    folder.mkdir(exist_ok=True)
    for frame in range(10):
        lines = [
            f"{category} {(left + width / 2) / 80!r} {(top + height / 2) / 60!r} {width / 80!r} {height / 60!r} {track}"
            for number, left, top, width, height, category, track in boxes
            if number == frame
        ]
        (folder / f"clip_{frame:04}.txt").write_text("\n".join(lines))
    return folder


def read(ending: str, path: Path) -> BoxTable:
    return READERS[ending](path, PICTURE_PX)


@given(boxes=st.lists(box, max_size=12))
def test_all_formats_give_the_same_boxes(tmp_path_factory: pytest.TempPathFactory, boxes: Boxes) -> None:
    folder = tmp_path_factory.mktemp("labels")
    tables = [
        read(".boxes.json", write_coco(folder / "a.boxes.json", boxes)),
        read(".boxes.txt", write_mot(folder / "a.boxes.txt", boxes)),
        read(".boxes/", write_yolo(folder / "a.boxes", boxes)),
    ]
    for frame in range(10):
        here = [each for each in boxes if each[0] == frame]
        corners = [[left, top, left + width, top + height] for _, left, top, width, height, *_ in here]
        for table in tables:
            found, numbers = table.at(frame)
            np.testing.assert_allclose(found, np.array(corners, float).reshape(-1, 4), atol=1e-9)
            assert numbers.tolist() == [list(each[5:]) for each in here]


def test_a_frame_that_coco_does_not_list_has_no_labels(tmp_path: Path) -> None:
    table = read(".boxes.json", write_coco(tmp_path / "a.boxes.json", [(2, 0, 0, 4, 4, 1, 1)], frames=3))
    assert len(table.at(1)[0]) == 0
    with pytest.raises(ValueError, match="has no frame 3"):
        table.at(3)


GOOD = {"images": [{"id": 1, "frame_id": 0}], "annotations": []}


@pytest.mark.parametrize(
    ("ending", "content", "message"),
    [
        (".boxes.json", "{", "line 1"),
        (".boxes.json", "[]", "is not a JSON object"),
        (".boxes.json", {"images": []}, "has no list 'annotations'"),
        (".boxes.json", GOOD | {"videos": [{}, {}]}, "describes 2 videos: write one file for each"),
        (".boxes.json", {"images": [{"id": 1}], "annotations": []}, r"images\[0\].frame_id is None"),
        (".boxes.json", GOOD | {"annotations": [{"image_id": 2}]}, r"annotations\[0\]: images has no id 2"),
        (".boxes.json", GOOD | {"annotations": [3]}, r"annotations\[0\] is 3"),
        (
            ".boxes.json",
            GOOD | {"annotations": [{"image_id": 1, "bbox": [1, 2, 3], "category_id": 1}]},
            r"annotations\[0\].bbox is \[1, 2, 3\]: it must be \[left, top, width, height\]",
        ),
        (
            ".boxes.json",
            GOOD | {"annotations": [{"image_id": 1, "bbox": [1, 2, -3, 4], "category_id": 1}]},
            r"annotations\[0\]: box .* width and height are at least 0",
        ),
        (".boxes.txt", "1,1,2,3\n", "line 1 has 4 values: give frame, track"),
        (".boxes.txt", "1,1,2,3,4,5\n\n2,1,2,x,4,5\n", "line 3: could not convert"),
        (".boxes.txt", "0,1,2,3,4,5\n", "line 1: frame 0: MOT counts frames from 1"),
        (".boxes.txt", "1.5,1,2,3,4,5\n", "line 1: 1.5 is not a whole number"),
        (".boxes.txt", "1,1,nan,3,4,5\n", "line 1: box .*: coordinates are at most"),
        (".boxes.txt", "1,99999999,2,3,4,5\n", "line 1: track 99999999: give"),
    ],
)
def test_errors_name_the_place_and_the_remedy(
    tmp_path: Path, ending: str, content: str | Mapping[str, Any], message: str
) -> None:
    path = tmp_path / f"a{ending}"
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    with pytest.raises(ValueError, match=message):
        read(ending, path)


def test_files_are_numbered_by_the_end_of_their_names(tmp_path: Path) -> None:
    for name in ("a2_07.txt", ".hidden.txt", "notes.md", "11.TXT"):
        (tmp_path / name).write_text("5 0.5 0.5 2 2\n")
    assert {number: file.name for number, file in numbered_files(tmp_path, ".txt").items()} == {
        7: "a2_07.txt", 11: "11.TXT",
    }  # fmt: skip
    assert read(".boxes/", tmp_path).at(7)[1].tolist() == [[5, -1]]
    (tmp_path / "7.txt").write_text("5 0.5\n")
    with pytest.raises(ValueError, match=r"7\.txt and a2_07\.txt are both of frame 7: keep one"):
        read(".boxes/", tmp_path)
    (tmp_path / "a2_07.txt").unlink()
    with pytest.raises(ValueError, match=r"7\.txt line 1 has 2 values: give class, centre x"):
        read(".boxes/", tmp_path)
    (tmp_path / "classes.txt").write_text("person\n")
    with pytest.raises(ValueError, match=r"classes\.txt: give it a name that ends with the number"):
        read(".boxes/", tmp_path)


def test_boxes_of_a_frame_keep_their_order() -> None:
    boxes = [Box(frame, float(number), 0.0, 1.0, 1.0, number, -1) for number, frame in enumerate((3, 1, 3, 1))]
    table = BoxTable.of(boxes)
    assert table.at(1)[1][:, 0].tolist() == [1, 3]
    assert table.at(3)[1][:, 0].tolist() == [0, 2]
    assert len(table.at(2)[0]) == 0
